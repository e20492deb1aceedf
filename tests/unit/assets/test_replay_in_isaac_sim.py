"""The script for Isaac Sim reads what an episode's folder holds, with numpy alone; the simulator itself was never there."""

import ast
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.assets.usd_write import REPLAY_SCRIPT, write_for_replay
from aomgen.core.transforms import matrix_from_rotvec, quat_from_matrix, transform
from aomgen.io.episode_folder import commit_episode
from aomgen.io.video import encode_video
from drawer_episode import corner_camera, drawer_episode

JOINTS = np.random.default_rng(0).normal(size=(3, 6))


@pytest.fixture
def script(tmp_path: Path) -> ModuleType:
    """The script as it lies beside an object's USD."""
    write_for_replay(make_asset("drawer", 1), tmp_path / "asset.usda")
    spec = importlib.util.spec_from_file_location("replay_script", tmp_path / REPLAY_SCRIPT.name)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def episode(tmp_path: Path) -> Path:
    video = encode_video(np.zeros((3, 48, 64, 3), np.uint8), 10)
    thetas = np.array([0.15, 0.1, 0.0])
    item = drawer_episode(7, JOINTS, thetas, {"front": corner_camera(64, 48)}, {}, {})
    return commit_episode(tmp_path, item, {"front": video})


def test_it_needs_numpy_alone_until_the_simulator_starts() -> None:
    tree = ast.parse(REPLAY_SCRIPT.read_text("utf-8"))
    imported = {node.module for node in tree.body if isinstance(node, ast.ImportFrom)}
    imported |= {item.name for node in tree.body if isinstance(node, ast.Import) for item in node.names}
    names = {str(name).split(".")[0] for name in imported}
    assert names - set(sys.stdlib_module_names) == {"numpy"}
    assert "never run in Isaac Sim" in (ast.get_docstring(tree) or "")


def test_it_reads_a_committed_episode(script: ModuleType, episode: Path) -> None:
    assert {script.EPISODE_FILE, script.FRAMES_FILE} < {path.name for path in episode.iterdir()}
    recording = script.read_recording(episode)
    assert recording.usd == episode.resolve() / "asset.usda"
    assert (recording.fps, recording.joint_names) == (10, list("abcdef"))
    np.testing.assert_array_equal(recording.commands[:, :-1], JOINTS[[0, 0, 1, 2]])
    np.testing.assert_array_equal(recording.thetas, [0.15, 0.1, 0.0])


def test_it_stands_and_then_goes_straight_from_action_to_action(script: ModuleType, episode: Path) -> None:
    recording = script.read_recording(episode)
    recording = recording._replace(
        commands=np.column_stack([recording.commands[:, :-1], [0.0, 0.0, 0.5, 1.0]])
    )
    targets, velocities = script.plan_control(recording, (0.1, 0.9), 130)
    settled = len(targets) - 3 * 13 - 1
    assert settled == 26
    np.testing.assert_array_equal(targets[:settled, :-1], np.tile(JOINTS[0], (settled, 1)))
    np.testing.assert_allclose(targets[settled::13, :-1], recording.commands[:, :-1])
    np.testing.assert_allclose(targets[settled::13, -1], [0.1, 0.1, 0.5, 0.9])
    np.testing.assert_allclose(velocities[-2, :-1], 10 * (JOINTS[2] - JOINTS[1]))
    np.testing.assert_allclose(np.cumsum(velocities, 0)[-1] / 130, targets[-1] - targets[0], atol=1e-9)


def test_the_object_is_fixed_where_the_episode_has_it(script: ModuleType, tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdPhysics

    T = transform(matrix_from_rotvec(np.array([0.3, -0.5, 2.0])), np.array([0.6, -0.1, 0.05]))
    np.testing.assert_allclose(script.quaternion_wxyz(T[:3, :3]), quat_from_matrix(T[:3, :3]), atol=1e-12)
    stage = Usd.Stage.CreateInMemory()
    root = stage.DefinePrim(script.OBJECT_PRIM)
    root.GetReferences().AddReference(str(tmp_path / "asset.usda"))
    script._fix_to_world(root, T)
    fixed = UsdPhysics.FixedJoint(stage.GetPrimAtPath(f"{script.OBJECT_PRIM}Base"))
    (link,) = fixed.GetBody1Rel().GetTargets()
    placed = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath(link))
    np.testing.assert_allclose(np.array(placed).T, T, atol=1e-9)
    np.testing.assert_allclose(fixed.GetLocalPos0Attr().Get(), T[:3, 3], atol=1e-6)
    turn = fixed.GetLocalRot0Attr().Get()
    np.testing.assert_allclose([turn.GetReal(), *turn.GetImaginary()], quat_from_matrix(T[:3, :3]), atol=1e-6)
