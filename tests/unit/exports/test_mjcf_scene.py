"""The MJCF of an episode: plain MuJoCo opens it from an empty folder, and its controls open the drawer by contact."""

import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from aomgen.errors import ConfigError
from aomgen.exports.mjcf_scene import write_mjcf
from aomgen.exports.scene_motion import SceneMotion
from aomgen.exports.simulated_scene import describe_nominal, simulate_motion_scene
from aomgen.results import Results

# Without AOMGen: the snippet of docs/exports.md, which prints the value of the object's joint and the largest force on it.
REPLAY = Path(__file__).parents[3] / "docs" / "exports.md"


@pytest.fixture(scope="module")
def folder(results: Results, motion: SceneMotion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made, moved = tmp_path_factory.mktemp("mjcf"), tmp_path_factory.mktemp("moved") / "empty"
    write_mjcf(results, motion, made / "scene.xml")
    shutil.move(made, moved)
    return moved


def snippet() -> str:
    """The program of the documentation that replays an episode."""
    blocks = REPLAY.read_text("utf-8").split("```python\n")[1:]
    return next(block.split("```")[0] for block in blocks if "scene_controls.csv" in block)


def test_what_is_written(folder: Path) -> None:
    assert {item.name for item in folder.iterdir()} == {"scene.xml", "scene_meshes", "scene_controls.csv"}
    assert {item.suffix for item in (folder / "scene_meshes").iterdir()} == {".obj", ".png", ".json"}


def test_only_a_folder_of_aomgen_is_replaced(
    folder: Path, results: Results, motion: SceneMotion, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Passed(Exception):
        """The folder was accepted."""

    def stop(*_: object) -> None:
        raise Passed

    monkeypatch.setattr("aomgen.exports.mjcf_scene.simulate_motion_scene", stop)
    meshes = tmp_path / "panda_meshes"

    def accepts() -> bool:
        with pytest.raises((Passed, ConfigError)) as caught:
            write_mjcf(results, motion, tmp_path / "panda.xml")
        return caught.type is Passed

    assert accepts()
    meshes.mkdir()
    assert accepts()
    (meshes / "link.obj").write_text("v 0 0 0")
    assert not accepts()
    shutil.rmtree(meshes)
    shutil.copytree(folder / "scene_meshes", meshes)
    assert accepts()
    shutil.rmtree(meshes)
    meshes.write_text("mine")
    assert not accepts()


def test_the_controls_open_the_drawer_in_plain_mujoco(folder: Path, motion: SceneMotion) -> None:
    done = subprocess.run(
        [sys.executable, "-I", "-c", snippet()], cwd=folder, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    value, forced = (float(word) for word in done.stdout.split())
    assert value >= 0.9 * motion.trajectory.thetas[-1]
    assert forced > 5.0
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    joint = model.joint("object_joint").id
    assert joint not in model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]


def test_the_model_is_that_of_the_verification(folder: Path, results: Results, motion: SceneMotion) -> None:
    found = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    scene = simulate_motion_scene(results, motion)
    wanted = describe_nominal(results, scene, motion).compile()
    for name in ("body_pos", "body_mass", "jnt_range", "dof_damping", "dof_frictionloss", "geom_pos", "geom_friction", "mesh_texcoord"):  # fmt: skip
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-4, err_msg=name)
    # Drives may exceed their largest torque for a moment, as in the verification.
    np.testing.assert_allclose(found.actuator_forcerange, scene.model.actuator_forcerange, rtol=1e-5)
    pixels = wanted.tex_data.size
    np.testing.assert_array_equal(found.tex_data[:pixels], wanted.tex_data)


def test_time_steps_fit_the_controls(folder: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    table = np.loadtxt(folder / "scene_controls.csv", delimiter=",", skiprows=1)
    steps = table[1, 0] / model.opt.timestep
    assert abs(steps - round(steps)) < 1e-4
    assert table.shape[1] == 1 + model.nu
    np.testing.assert_allclose(model.key_ctrl[0], table[0, 1:], atol=1e-5)
