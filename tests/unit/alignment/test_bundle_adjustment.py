"""Equations of the bundle adjustment, and when a clock's drift counts."""

import numpy as np
import pytest

from aomgen.alignment.bundle_adjustment import drifts
from aomgen.alignment.scan_information import structure_rows
from aomgen.alignment.silhouette_fit import move_similarity
from aomgen.core.camera import Camera, camera_in_world, look_at
from aomgen.core.clock import Clock
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, similarity, transform

CAMERA = Camera(
    fx=300.0, fy=310.0, cx=160.0, cy=121.0, width=320, height=240,
    T_world_cam=look_at([-1.5, -1.0, 0.9], [0.0, 0.0, 0.3]),
)  # fmt: skip


def test_structure_rows_match_finite_differences() -> None:
    rng = np.random.default_rng(1)
    S = similarity(0.4, matrix_from_rotvec([0.3, -0.8, 1.9]), [0.2, -0.1, 0.5])
    points_recon = apply(np.linalg.inv(S), rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.6], (30, 3)))
    camera_recon = camera_in_world(np.array(np.linalg.inv(S), np.float64), CAMERA)
    pivot = np.array([0.1, -0.1, 0.3])
    J, r = structure_rows(CAMERA, camera_recon, points_recon, S, pivot)
    assert r == pytest.approx(0, abs=1e-6)
    for column in range(13):
        step = np.zeros(13)
        step[column] = 1e-6
        R = matrix_from_rotvec(step[:3])
        D = transform(R, pivot + step[3:6] - R @ pivot)
        moved = CAMERA.moved(invert(D) @ CAMERA.T_world_cam)
        shifted = structure_rows(
            moved, camera_recon, points_recon, move_similarity(S, step[6:], pivot), pivot
        )[1]
        assert (shifted - r) / 1e-6 == pytest.approx(-J[:, column], rel=1e-3, abs=0.05)


@pytest.mark.parametrize(
    ("rate", "rate_sd", "seconds", "drifting"),
    [
        (0.02, 0.001, 8.0, True),
        (-0.02, 0.001, 8.0, True),
        # Half a step between drifts tried is no knowledge.
        (0.0114, 0.0057, 8.7, False),
        # Too little to shift the ends of the film.
        (0.004, 0.0001, 8.0, False),
        (0.0, 0.0, 8.0, False),
    ],
)
def test_a_drift_counts_when_it_matters_and_is_known(rate, rate_sd, seconds, drifting) -> None:
    clock = Clock(offset_s=0.2, sd_s=0.001, rate=rate, rate_sd=rate_sd)
    assert drifts(clock, seconds) is drifting
