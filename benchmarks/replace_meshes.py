"""Accuracy of Gaussians for a mesh, unlit, compared with MuJoCo's rasterizer from all directions."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from aomgen.assets.choice import MAKERS, OTHER_MAKERS, load_asset, make_asset
from aomgen.assets.usd_write import write_usd
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.light import hemisphere_light
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.lighting.light_estimation import SceneLight, ToneCurve
from aomgen.lighting.reflection import show_in_light
from aomgen.replacement.asset_renderer import AssetRenderer
from aomgen.replacement.asset_surfels import fit_surfels
from aomgen.splatting.metrics import psnr
from aomgen.splatting.rasterizer import render
from aomgen.splatting.surfels import Surfels
from benchmarks.other_objects import make_object

VIEWS: Final = 20
SIZES: Final = (256, 512)
# The object fills at least this share of every image.
FILLED: Final = 0.4
# Focal length over the image's width, and the elevation of a camera, [rad].
FOCAL, ELEVATIONS = 1.2, (0.0, 1.1)
# Colors are compared inside the silhouette and within this distance around it, [px].
AROUND_PX: Final = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshView:
    """A camera in the asset's frame, and the joint value."""

    camera: Camera
    theta: float


def _truth(renderer: AssetRenderer, view: MeshView) -> tuple[Array, Array]:
    """Render color (H, W, 3) and coverage (H, W), 0..1; black for the background."""
    drawn = renderer.draw(view.camera, view.theta).astype(np.float64)
    return drawn[..., :3], drawn[..., 3]


def draw_views(asset: ArticulatedAsset, rng: np.random.Generator) -> list[MeshView]:
    """Draw views from all directions, near enough that the object fills the image."""
    views = []
    size = SIZES[0]
    with AssetRenderer(asset, size) as renderer:
        for _ in range(VIEWS):
            theta = float(rng.uniform(0.0, asset.joint.upper))
            points = apply(
                asset.joint.motion(theta), np.concatenate([m.vertices for m in asset.moving.meshes])
            )
            points = np.concatenate([points, *(m.vertices for m in asset.static.meshes)])
            middle = (points.min(0) + points.max(0)) / 2
            azimuth, up = rng.uniform(-np.pi, np.pi), rng.uniform(*ELEVATIONS)
            way = np.array([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)])
            radius = float(np.linalg.norm(points - middle, axis=1).max())
            distance, filled = 3.0 * radius, 0.0
            # A flat object never fills the image: the camera is then as near as for the sphere around it.
            while filled < FILLED and distance > radius:
                distance *= 0.93
                camera = Camera(
                    fx=FOCAL * size, fy=FOCAL * size, cx=size / 2, cy=size / 2, width=size, height=size,
                    T_world_cam=look_at(middle + distance * way, middle),
                )  # fmt: skip
                view = MeshView(camera=camera, theta=theta)
                filled = float(_truth(renderer, view)[1].mean())
            views.append(view)
    return views


def score_views(
    asset: ArticulatedAsset, static: Gaussians, moving: Gaussians, views: list[MeshView]
) -> dict[str, float]:
    """Compute medians over the views: PSNR of colors at each size, and IoU of silhouettes at the first."""
    psnrs: dict[int, list[float]] = {size: [] for size in SIZES}
    ious = []
    with AssetRenderer(asset, max(SIZES)) as renderer:
        for view in views:
            posed = concatenate([static, moving.transform(asset.joint.motion(view.theta))])
            for size in SIZES:
                sized = MeshView(camera=view.camera.resize(size, size), theta=view.theta)
                true, cover = _truth(renderer, sized)
                drawn = render(posed, sized.camera)
                near = binary_dilation(cover > 0, iterations=AROUND_PX)
                psnrs[size].append(psnr(np.clip(drawn.rgb, 0, 1)[near], true[near]))
                if size == SIZES[0]:
                    ious.append(_iou(drawn.alpha > 0.5, cover > 0.5))
    return {
        **{f"psnr_{size}": float(np.median(found)) for size, found in psnrs.items()},
        "iou": float(np.median(ious)),
    }


def _iou(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    return float((one & other).sum() / (one | other).sum())


def run_meshes(assets: list[ArticulatedAsset], seed: int, notify: Callable[[str], None]) -> dict[str, Any]:
    """Compute metrics of all assets: medians, worst, and one row each."""
    rows = []
    for number, asset in enumerate(assets):
        rng = np.random.default_rng([seed, number])
        views = draw_views(asset, rng)
        started = time.perf_counter()
        static, moving = fit_surfels(asset, rng)
        seconds = time.perf_counter() - started
        scores = score_views(asset, static.gaussians, moving.gaussians, views)
        count = len(static.gaussians) + len(moving.gaussians)
        rows.append(
            {
                "asset": asset.name,
                **scores,
                "gaussians": count,
                "seconds": seconds,
                "asset_seconds": seconds + _other_seconds(asset, (static, moving)),
            }
        )
        notify(f"{asset.name}: {scores['psnr_256']:.1f} dB, {seconds:.0f} s")
    good = {"gaussians": max, "seconds": max, "asset_seconds": max}
    names = [name for name in rows[0] if name != "asset"]
    found = {name: [row[name] for row in rows] for name in names}
    return {
        **{name: float(np.median(values)) for name, values in found.items()},
        **{f"{name}_worst": good.get(name, min)(values) for name, values in found.items()},
        "assets": rows,
    }


def _other_seconds(asset: ArticulatedAsset, links: tuple[Surfels, Surfels]) -> float:
    """Measure the time of reading an asset's USD file and lighting its Gaussians."""
    light = SceneLight(hemisphere_light(np.ones(3), np.full(3, 0.5)), ToneCurve(), "scene")
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "asset.usda"
        write_usd(asset, path)
        started = time.perf_counter()
        load_asset(str(path))
        for link in links:
            show_in_light(link, light, np.eye(3))
        return time.perf_counter() - started


def made_assets(seed: int) -> list[ArticulatedAsset]:
    """Make two assets of each generated category, and two of other makers."""
    made = [make_asset(category, seed + k) for category in (MAKERS | OTHER_MAKERS) for k in range(2)]
    return [*made, make_object("oven", seed), make_object("cupboard", seed)]
