"""Assets as Gaussians look like their meshes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from aomgen.assets.choice import make_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.mesh import sample_surface
from aomgen.core.transforms import apply
from aomgen.replacement import asset_surfels as module
from aomgen.replacement.asset_renderer import AssetRenderer
from aomgen.replacement.asset_surfels import fit_surfels
from aomgen.splatting.metrics import psnr
from aomgen.splatting.rasterizer import render
from aomgen.splatting.surfels import Surfels, surfels_of

SIZE = 128


@pytest.fixture(scope="module")
def asset() -> ArticulatedAsset:
    return make_asset("microwave", 3)


@pytest.fixture(scope="module")
def fitted(asset: ArticulatedAsset) -> tuple[Surfels, Surfels]:
    return small_fit(asset)


def small_fit(asset: ArticulatedAsset, pictures: int = 24, size: int = SIZE) -> tuple[Surfels, Surfels]:
    """A small one, as far as small pictures tell."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {
            "DISCS": 8000,
            "MAX_GAUSSIANS": 12000,
            "IMAGES": pictures,
            "IMAGE_PX": size,
        }.items():
            patch.setattr(module, name, value)
        return fit_surfels(asset, np.random.default_rng(0))


def view(azimuth: float) -> Camera:
    eye = np.array([1.4 * np.cos(azimuth), 1.4 * np.sin(azimuth), 0.8])
    f, c = 1.3 * SIZE, SIZE / 2
    T = look_at(eye, (0, 0, 0.12))
    return Camera(fx=f, fy=f, cx=c, cy=c, width=SIZE, height=SIZE, T_world_cam=T)


def difference(asset: ArticulatedAsset, static: Gaussians, moving: Gaussians) -> tuple[float, float]:
    """From the meshes, in views that were not fitted: PSNR of colors, and the share of pixels covered otherwise."""
    psnrs, covers = [], []
    with AssetRenderer(asset, SIZE) as renderer:
        for azimuth, theta in ((-1.2, 0.0), (-2.0, 0.7), (0.4, 1.3), (2.5, 0.3)):
            truth = renderer.draw(view(azimuth), theta)
            drawn = render(concatenate([static, moving.transform(asset.joint.motion(theta))]), view(azimuth))
            psnrs.append(psnr(np.clip(drawn.rgb, 0, 1), truth[..., :3]))
            covers.append(np.mean((drawn.alpha > 0.5) != (truth[..., 3] > 0.5)))
    return float(np.median(psnrs)), float(np.median(covers))


def test_fitted_gaussians_look_more_like_the_meshes_than_discs(
    asset: ArticulatedAsset, fitted: tuple[Surfels, Surfels]
) -> None:
    rng = np.random.default_rng(0)
    discs = [surfels_of(link.meshes, 6000, rng).gaussians for link in (asset.static, asset.moving)]
    before, after = difference(asset, *discs), difference(asset, *(item.gaussians for item in fitted))
    assert after[0] > max(before[0] + 4, 24)
    assert after[1] < min(before[1] / 2, 0.01)


def test_gaussians_stay_on_the_link_that_they_belong_to(
    asset: ArticulatedAsset, fitted: tuple[Surfels, Surfels]
) -> None:
    for surfels, link in zip(fitted, (asset.static, asset.moving), strict=True):
        rng = np.random.default_rng(0)
        surface = np.concatenate([sample_surface(m.vertices, m.faces, 20_000, rng)[0] for m in link.meshes])
        distances, _ = cKDTree(surface).query(surfels.gaussians.means)
        assert np.quantile(distances, 0.99) < 0.02
        assert np.allclose(np.linalg.norm(surfels.normals, axis=1), 1, atol=1e-4)
    assert len(fitted[0].gaussians) + len(fitted[1].gaussians) <= 12_000


@pytest.mark.slow
def test_what_lies_behind_a_window_shows_through(asset: ArticulatedAsset) -> None:
    """The door's panes, one behind the other, each let 60 % through: 36 % of a white background."""
    meshes = tuple(replace(m, opacity=0.4) if "window" in m.name else m for m in asset.moving.meshes)
    clear = replace(asset, moving=replace(asset.moving, meshes=meshes))
    theta, middle = 1.5, np.mean([m.vertices.mean(0) for m in meshes if "window" in m.name], 0)
    middle = apply(asset.joint.motion(theta), middle)
    # Along the front, past the body.
    eye = middle + [0.9 * np.sign(middle[0]), 0.0, 0.0]
    camera = replace(view(0.0), T_world_cam=look_at(eye, middle))
    with AssetRenderer(clear, SIZE) as renderer:
        truth = renderer.draw(camera, theta)
    block = slice(SIZE // 2 - 4, SIZE // 2 + 4)
    np.testing.assert_allclose(truth[block, block, 3], 0.64, atol=0.02)
    static, moving = small_fit(clear, 40, 2 * SIZE)
    posed = concatenate([static.gaussians, moving.gaussians.transform(asset.joint.motion(theta))])
    drawn = render(posed, camera)
    np.testing.assert_allclose(drawn.alpha[block, block].mean(), 0.64, atol=0.1)
    np.testing.assert_allclose(
        drawn.rgb[block, block].mean((0, 1)), truth[block, block, :3].mean((0, 1)), atol=0.03
    )


def test_what_is_lit_is_what_was_fitted(fitted: tuple[Surfels, Surfels]) -> None:
    for surfels in fitted:
        assert surfels.albedo_linear.min() >= 0
        assert surfels.albedo_linear.max() <= 1
        assert len(surfels.transfer) == len(surfels.gaussians) == len(surfels.albedo_linear)
