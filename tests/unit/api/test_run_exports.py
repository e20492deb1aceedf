"""Files of the finished run: USD looks as `aomgen render`, and MJCF episodes open their object in plain MuJoCo."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import Usd, UsdValidation

import aomgen as ag
from aomgen.io.gaussian_files import read_gaussians
from aomgen.lighting.shadowed_twin import render_state
from aomgen.splatting.metrics import psnr
from aomgen.splatting.rasterizer import render
from finished_run import VARIABLE, copy_finished_run
from usd_scene_reader import camera_of, choose, gaussians_at

# Episodes of the run that are replayed; each takes seconds.
EPISODES = 2


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ag.Run:
    out = copy_finished_run(tmp_path_factory.mktemp("run"))
    if out is None:
        pytest.skip(f"{VARIABLE} names no finished run; `make api-test` does")
    return ag.Run.open(out)


def test_usd_of_the_recording(run: ag.Run, tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(run.export(tmp_path / "twin.usdc")))
    registry = UsdValidation.ValidationRegistry()
    assert not UsdValidation.ValidationContext(registry.GetOrLoadAllValidators()).Validate(stage)
    demo, camera = run.demonstration, run.cameras["front"]
    state = run.twin.state(joints=demo.joints[0], gripper=float(demo.gripper[0]), theta=float(demo.thetas[0]))
    wanted = render_state(run.twin.model, run.robot, state, camera).rgb
    for motion in ("physics", "demonstration"):
        choose(stage, motion)
        view = camera_of(stage, "/World/Cameras/front")
        assert psnr(render(gaussians_at(stage), view).rgb, wanted) >= 60


@pytest.mark.parametrize(("suffix", "least_db"), [(".ply", 60), (".glb", 60), (".spz", 35)])
def test_gaussians_of_a_state(run: ag.Run, tmp_path: Path, suffix: str, least_db: float) -> None:
    found = read_gaussians(run.export(tmp_path / f"twin{suffix}", joint=0.4))
    if suffix != ".ply":
        # y up, z towards the viewer: back to z up.
        found = found.transform(np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]))
    camera = run.cameras["front"]
    wanted = render_state(run.twin.model, run.robot, run.twin.state(theta=0.4), camera).rgb
    assert psnr(render(found, camera).rgb, wanted) >= least_db


def test_mjcf_opens_the_object(run: ag.Run, tmp_path: Path) -> None:
    for item in run.episodes[:EPISODES]:
        made = item.episode
        model = mujoco.MjModel.from_xml_path(str(run.export(tmp_path / "scene.xml", episode=made.index)))
        data = mujoco.MjData(model)
        table = np.loadtxt(tmp_path / "scene_controls.csv", delimiter=",", skiprows=1)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        for row in table:
            data.ctrl[:] = row[1:]
            mujoco.mj_step(model, data, round(table[1, 0] / model.opt.timestep))
        assert data.joint("object_joint").qpos[0] >= 0.9 * made.thetas[-1]
