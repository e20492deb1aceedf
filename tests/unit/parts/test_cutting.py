"""Gaussians cut at the faces of boxes: what is cut, that weight and picture stay, and the way back."""

import numpy as np
import pytest
from scipy.stats import norm

from aomgen.conventions import MOVING, STATIC
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians, gaussians_of
from aomgen.core.parts import no_cut
from aomgen.core.transforms import matrix_from_quat
from aomgen.parts.cutting import MIN_SHARE, cut_at_faces
from aomgen.parts.panel import Panel
from aomgen.splatting.rasterizer import render

# A drawer's front in the left half of a body, both facing +z.
PANEL = Panel(
    T_world_panel=np.eye(4), low=[-0.5, -0.5, -0.02], high=[0.0, 0.5, 0.05],
    T_panel_body=np.eye(4), body_low=[-0.5, -0.5, -0.5], body_high=[0.5, 0.5, 0.0],
)  # fmt: skip


def spread_gaussians(count: int, width: float, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return gaussians_of(
        means=rng.uniform([-0.4, -0.4, -0.015], [0.4, 0.4, -0.005], (count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=width * rng.uniform(0.1, 1.0, (count, 3)),
        opacities=rng.uniform(0.2, 0.9, count),
        sh=rng.uniform(-1, 1, (count, 1, 3)),
    )


def cut_all(gaussians: Gaussians) -> tuple:
    cut = cut_at_faces(gaussians, PANEL, np.ones(len(gaussians), bool))
    return cut, cut.applied(gaussians), cut.origins(len(gaussians))


def weights(gaussians: Gaussians) -> np.ndarray:
    return gaussians.opacities * gaussians.scales.astype(np.float64).prod(1)


def test_a_gaussian_across_a_seam_is_cut_and_one_beside_it_is_not():
    both = gaussians_of(
        means=[[0.01, 0, -0.01], [-0.2, 0, -0.01]], quats=[[1, 0, 0, 0]] * 2, scales=[[0.03, 0.02, 0.001]] * 2,
        opacities=[0.5, 0.5], sh=np.zeros((2, 1, 3)),
    )  # fmt: skip
    cut, pieces, origins = cut_all(both)
    assert list(cut.sources) == [0, 0]
    assert list(origins) == [1, 0, 0]
    assert sorted(PANEL.labels(pieces.means[1:])) == [STATIC, MOVING]


def test_pieces_have_the_moments_of_their_gaussian():
    """Weight, mean and covariance of all pieces together are those of what was cut."""
    gaussians = spread_gaussians(300, 0.05)
    cut, pieces, origins = cut_all(gaussians)
    assert len(cut.sources) > 50
    for index in np.unique(cut.sources):
        own = pieces.select(origins == index)
        shares = weights(own) / weights(gaussians)[index]
        assert shares.sum() == pytest.approx(1, abs=1e-4)
        mean = shares @ own.means
        assert mean == pytest.approx(gaussians.means[index], abs=1e-5)
        axes = matrix_from_quat(own.quats) * own.scales[:, None, :]
        apart = own.means - mean
        spread = np.einsum(
            "m,mij->ij", shares, axes @ axes.swapaxes(1, 2) + apart[:, :, None] * apart[:, None]
        )
        whole = matrix_from_quat(gaussians.quats[index]) * gaussians.scales[index]
        assert spread == pytest.approx(whole @ whole.T, abs=2e-6)


def test_pieces_keep_to_their_side():
    """Of a Gaussian cut in the middle, each half has a tenth of its weight beyond the face at most."""
    gaussians = spread_gaussians(500, 0.04)
    cut, pieces, _ = cut_all(gaussians)
    halves = pieces.select(slice(len(gaussians) - len(np.unique(cut.sources)), None))
    widths = np.linalg.norm(halves.scales * matrix_from_quat(halves.quats)[:, 0], axis=1)
    crossing = np.abs(halves.means[:, 0]) < widths
    beyond = norm.cdf(-np.abs(halves.means[:, 0]) / widths)
    assert np.mean(crossing) < 0.05
    assert np.median(beyond) < MIN_SHARE


def test_the_picture_stays():
    # Flat ones, as trained surfaces are, behind one another by 0.1 mm.
    count = 400
    rng = np.random.default_rng(1)
    flat = gaussians_of(
        means=np.c_[rng.uniform(-0.4, 0.4, (count, 2)), np.linspace(-0.03, -0.001, count)],
        quats=np.tile([1.0, 0, 0, 0], (count, 1)), scales=np.tile([0.05, 0.03, 0.0005], (count, 1)),
        opacities=np.full(count, 0.6), sh=rng.uniform(-1, 1, (count, 1, 3)),
    )  # fmt: skip
    _, pieces, _ = cut_all(flat)
    T_world_cam = np.diag([1.0, -1, -1, 1])
    T_world_cam[2, 3] = 1.5
    camera = Camera(fx=300, fy=300, cx=160, cy=120, width=320, height=240, T_world_cam=T_world_cam)
    before, after = (render(item, camera).rgb for item in (flat, pieces))
    assert len(pieces) > len(flat) + 20
    assert 10 * np.log10(1 / np.mean((before - after) ** 2)) > 33


def test_what_is_not_free_is_not_cut():
    gaussians = spread_gaussians(100, 0.05)
    assert len(cut_at_faces(gaussians, PANEL, np.zeros(100, bool)).sources) == 0


def test_no_cut_changes_nothing():
    gaussians = spread_gaussians(20, 0.05)
    cut = no_cut(gaussians)
    assert np.array_equal(cut.origins(20), np.arange(20))
    assert np.array_equal(cut.applied(gaussians).means, gaussians.means)
