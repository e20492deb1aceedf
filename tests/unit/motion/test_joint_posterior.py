"""The posterior of noise scales."""

import numpy as np
import pytest

from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.motion.ee_path import GraspGuess, thin_path
from aomgen.motion.joint_models import make_models
from aomgen.motion.joint_posterior import LinearizedModel
from aomgen.motion.part_shape import UNIFORM_PRIOR
from aomgen.motion.path_noise import SCALES, NoisePrior, PathNoise


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_slopes_of_the_posterior_are_its_differences(kind: str) -> None:
    angles = np.linspace(0, 0.9, 8)
    R = matrix_from_rotvec(angles[:, None] * [0.1, 0.0, 1.0])
    points = 0.3 * np.stack([np.cos(angles), np.sin(angles), 0.02 * angles**2], 1)
    path = thin_path(transform(R, points), GraspGuess(point_ee=np.zeros(3)), nodes=7)
    doors, drawer = make_models(path, np.inf)
    model = doors[0] if kind == "revolute" else drawer
    noise = PathNoise.of(path.points_world, NoisePrior())
    found = LinearizedModel.of(model, noise, UNIFORM_PRIOR, model.first())
    steps = np.linspace(1.5, -0.5, len(SCALES))
    ahead, behind = (
        [found.log_posterior(steps + sign * row) for row in 1e-4 * np.eye(len(SCALES))] for sign in (1, -1)
    )
    differences = (np.array(ahead) - behind) / 2e-4
    np.testing.assert_allclose(found.log_posterior_slopes(steps), differences, rtol=1e-5, atol=1e-5)
