"""The curve of a training ends where training ends, and looking at it changes nothing."""

import time
from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import silent
from aomgen.gaussians.depth_fusion import Samples
from aomgen.gaussians.train import GaussiansParams, TrainingViews, coarse, evaluate_view, initial_gaussians
from aomgen.splatting.rasterizer import render
from aomgen.splatting.training import train
from benchmarks.training import Clock, gain_fitted_psnr, training_curve


def views_and_held_out() -> tuple[TrainingViews, list[tuple[Camera, np.ndarray]]]:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    surface = Samples(
        points_recon=0.5 * directions,
        normals_recon=directions,
        colors_srgb=np.full((300, 3), 128, np.uint8),
        footprints=np.full(300, 0.06),
        detail=np.ones(300),
        weights=np.ones(300),
    )
    initial = initial_gaussians(surface, surface.select(np.zeros(300, bool)))
    ball = Gaussians(
        means=initial.means,
        quats=initial.quats,
        scales=initial.scales,
        opacities=np.full(300, 0.95),
        sh=rng.normal(size=(300, 1, 3)),
    )
    cameras = [
        Camera(fx=60, fy=60, cx=24, cy=18, width=48, height=36, T_world_cam=look_at(eye, [0, 0, 0]))
        for eye in ([2, 0, 0.6], [1.6, 1, 0.6], [1, 1.7, 0.6], [0, 2, 0.6], [1.8, 0.5, 0.7])
    ]
    images = [(render(ball, camera).rgb * 255).round().astype(np.uint8) for camera in cameras]
    views = TrainingViews(
        surface=surface.points_recon, initial=initial, cameras=cameras[:4], images_srgb=images[:4], test=["4"]
    )
    return views, [(cameras[4], images[4])]


def test_the_curve_ends_where_training_does() -> None:
    views, held_out = views_and_held_out()
    params = coarse(GaussiansParams())
    training = replace(params.training, iterations=60, max_gaussians=400)
    params = replace(params, training=training, near_share=0.0)
    curve = training_curve(views, held_out, params, every_seconds=1e-6)
    assert len(curve) > 2
    assert [point["iteration"] for point in curve] == sorted({point["iteration"] for point in curve})
    assert [point["seconds"] for point in curve] == sorted(point["seconds"] for point in curve)
    assert curve[-1]["iteration"] == 60
    assert curve[-1]["psnr"] > curve[0]["psnr"]
    rng = np.random.default_rng(params.seed)
    trained = train(views.initial, views.cameras, views.images_srgb, training, silent, rng)
    assert curve[-1]["psnr"] == pytest.approx(evaluate_view(trained, *held_out[0])[0], abs=1e-6)


def test_a_gain_is_fitted_for_every_channel() -> None:
    image = np.random.default_rng(0).integers(50, 200, (20, 30, 3)).astype(np.uint8)
    darker = np.round(image * [0.8, 0.9, 0.7]).astype(np.uint8)
    assert gain_fitted_psnr(darker, image) > 50
    assert gain_fitted_psnr(image[::-1], image) < 20


def test_the_clock_stands_still_between_stop_and_start() -> None:
    clock = Clock()
    clock.stop()
    before = clock.wall
    begin = time.monotonic()
    while time.monotonic() - begin < 0.02:
        pass
    clock.start()
    clock.stop()
    assert clock.wall - before < 0.01
    begin = time.monotonic()
    while time.monotonic() - begin < 0.02:
        pass
    clock.stop()
    assert clock.wall - before > 0.02
