"""Files of Gaussians in a state: what is drawn from them, and which state."""

import re
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.transforms import invert
from aomgen.errors import ConfigError
from aomgen.exports.posed_gaussians import Y_UP, choose_state, write_posed_gaussians
from aomgen.exports.scene_motion import SceneMotion
from aomgen.io.gaussian_files import Y_UP_SUFFIXES, read_gaussians
from aomgen.lighting.shadowed_twin import render_state
from aomgen.splatting.metrics import psnr
from aomgen.splatting.rasterizer import render


@pytest.mark.parametrize(("suffix", "least_db"), [(".ply", 60), (".glb", 60), (".spz", 35), (".splat", 20)])
def test_drawn_as_the_twin(motion: SceneMotion, tmp_path: Path, suffix: str, least_db: float) -> None:
    path, camera = tmp_path / f"state{suffix}", motion.cameras["front"].resize(320, 240)
    write_posed_gaussians(motion, path, joint=0.1, time_s=None)
    found = read_gaussians(path)
    if suffix in Y_UP_SUFFIXES:
        found = found.transform(invert(Y_UP))
    state = choose_state(motion, 0.1, None)
    wanted = render_state(motion.twin, motion.robot, state, camera).rgb
    assert len(found) == len(motion.twin.gaussians)
    assert psnr(render(found, camera).rgb, wanted) >= least_db


@pytest.mark.parametrize(
    ("joint", "time_s", "said"),
    [
        (np.nan, None, "--joint: is nan m; choose a value between 0.000 and"),
        (50.0, None, "--joint: is 50 m"),
        (-0.1, None, "--joint: is -0.1 m"),
        (None, 5000.0, "--time: is 5000 s; choose a value between 0.000 and"),
        (None, np.nan, "--time: is nan s"),
    ],
)
def test_values_outside_of_their_range_are_refused(
    motion: SceneMotion, tmp_path: Path, joint: float | None, time_s: float | None, said: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        write_posed_gaussians(motion, tmp_path / "state.ply", joint=joint, time_s=time_s)
    assert list(tmp_path.iterdir()) == []


def test_states(motion: SceneMotion) -> None:
    assert choose_state(motion, None, None).theta == motion.trajectory.thetas[0]
    late = choose_state(motion, None, 99.0)
    np.testing.assert_allclose(late.joints, motion.trajectory.joints[-1])
    assert choose_state(motion, 0.03, 99.0).theta == 0.03
    between = choose_state(motion, None, 0.15)
    np.testing.assert_allclose(between.joints, motion.trajectory.joints[1:3].mean(0))
