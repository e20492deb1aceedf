"""Training finds a small scene again; the optimizer and the growth do what they say."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import silent
from aomgen.errors import ConfigError
from aomgen.splatting.compute import Compute, NativeCompute, TorchCompute
from aomgen.splatting.differentiable import CpuRasterizer
from aomgen.splatting.metrics import psnr, ssim
from aomgen.splatting.optimizer import RATES, error_shares, gaussians_of, parameters_of, relocate_and_grow
from aomgen.splatting.rasterizer import render
from aomgen.splatting.training import (
    TrainingParams,
    choose_error_views,
    finish_training,
    learning,
    scene_extent,
    start_training,
    train,
)
from aomgen.splatting.training_views import clip_to_sensor
from small_scene import checkered, photograph, ring, start


def held_out_psnr(trained: Gaussians, scene: Gaussians) -> float:
    cameras = ring(5, height=0.9, shift=0.37)
    return float(np.mean([psnr(render(trained, c).rgb, render(scene, c).rgb) for c in cameras]))


# Colors start far off and there is little time: higher rates than for a scene seeded from its images.
PARAMS = TrainingParams(
    rates={**RATES, "color": 0.03, "sh": 0.003},
    iterations=240,
    sh_degree=1,
    max_gaussians=2500,
    grow_every=30,
    background=(0, 0, 0),
    downsampling=((0.0, 2), (0.3, 1)),
)


def test_a_small_scene_is_found_again() -> None:
    scene, cameras = checkered(4000, 0), ring(12)
    initial = start(scene, 1500)
    reports: list[float] = []
    trained = train(
        initial,
        cameras,
        photograph(scene, cameras),
        PARAMS,
        lambda share, text: reports.append(share),
        np.random.default_rng(0),
    )
    before, after = held_out_psnr(initial, scene), held_out_psnr(trained, scene)
    assert before < 18
    assert after > 29
    assert len(initial) < len(trained) <= 2500
    assert trained.sh_degree == 1
    assert reports == sorted(reports)
    assert reports[-1] == 1


def test_the_same_seed_gives_the_same_gaussians() -> None:
    scene, cameras = checkered(800, 1), ring(4)
    images = photograph(scene, cameras)
    params = TrainingParams(
        iterations=40, background=(0, 0, 0), max_gaussians=700, grow_every=10, downsampling=((0.0, 1),)
    )
    runs = [
        train(start(scene, 500), cameras, images, params, silent, np.random.default_rng(5)) for _ in range(2)
    ]
    assert np.array_equal(runs[0].means, runs[1].means)
    assert np.array_equal(runs[0].sh, runs[1].sh)
    other = train(start(scene, 500), cameras, images, params, silent, np.random.default_rng(6))
    assert not np.array_equal(runs[0].means[: len(other)], other.means[: len(runs[0])])


def test_exposure_gains_take_up_brightness() -> None:
    """Half of the images are darker; with gains the colors are learned as if none were."""
    scene, cameras = checkered(1500, 2), ring(8)
    bright = photograph(scene, cameras)
    mixed = [(image * (0.8 if i % 2 else 1.0)).astype(np.uint8) for i, image in enumerate(bright)]
    losses = {}
    for exposure in (False, True):
        params = TrainingParams(
            iterations=160,
            sh_degree=0,
            max_gaussians=1000,
            background=(0, 0, 0),
            rates={**RATES, "color": 0.03, "gain": 0.01},
            exposure=exposure,
            downsampling=((0.0, 1),),
        )
        seen: list[float] = []
        train(
            start(scene, 1000),
            cameras,
            mixed,
            params,
            lambda share, text, seen=seen: seen.append(float(text.split()[-1])),
            np.random.default_rng(0),
        )
        losses[exposure] = np.mean(seen[-4:])
    assert losses[True] < 0.8 * losses[False]


def test_clipped_highlights_neither_bend_gains_nor_colors() -> None:
    """Photographs with a gain clip the bright squares; their exposure is found from the others."""
    scene, cameras = checkered(3000, 2), ring(10)
    true_gains = np.where(np.arange(10) % 2, 1.25, 0.8)
    images = [
        np.clip(render(scene, camera).rgb * gain * 255, 0, 255).round().astype(np.uint8)
        for camera, gain in zip(cameras, true_gains, strict=True)
    ]
    params = replace(
        PARAMS, iterations=400, sh_degree=0, rates={**PARAMS.rates, "gain": 0.02}, downsampling=((0.0, 1),)
    )
    initial = start(scene, 1500)
    state = start_training(initial, cameras, params, np.random.default_rng(0))
    for _ in learning(state, cameras, images, params, scene_extent(initial, cameras)):
        pass
    red = state.exposure.values[:, 0].numpy()
    assert red[1::2].mean() - red[::2].mean() == pytest.approx(np.log(1.25 / 0.8), abs=0.015)
    view = ring(1, height=0.9, shift=0.37)[0]
    drawn, true = render(finish_training(state, params), view).rgb[..., 0], render(scene, view).rgb[..., 0]
    assert abs((drawn - true)[true > 0.8].mean()) < 0.015  # 0.035 too dark without


def test_saturated_pixels_ask_for_no_less_than_white() -> None:
    target = torch.tensor([1.0, 1.0, 0.5, 0.5])[None, None].repeat(3, 1, 1)
    rendered = torch.tensor([1.2, 0.7, 1.2, 0.2])[None, None].repeat(3, 1, 1).requires_grad_()
    gains = torch.tensor([1.0, 1.1, 0.9], requires_grad=True)
    seen = clip_to_sensor(rendered, target, gains)
    shown = seen * gains[:, None, None]
    torch.testing.assert_close(shown[:, 0, 0], torch.ones(3))
    torch.testing.assert_close(shown[:, 0, 1:], (rendered * gains[:, None, None])[:, 0, 1:])
    shown[:, 0, 0].sum().backward()
    assert rendered.grad is not None
    assert not rendered.grad.any()
    assert gains.grad is not None
    assert gains.grad.abs().max() < 1e-6


def test_inputs_that_do_not_fit_are_refused() -> None:
    scene, cameras = checkered(100, 0), ring(2)
    images = photograph(scene, cameras)
    for bad_cameras, bad_images in ((cameras[:1], images), (cameras, [images[0], images[1][:-1]]), ([], [])):
        with pytest.raises(ValueError, match="image"):
            train(scene, bad_cameras, bad_images, PARAMS, silent, np.random.default_rng(0))


@pytest.mark.parametrize("compute", [NativeCompute(), TorchCompute("cpu", CpuRasterizer())])
def test_the_optimizer_is_adam(compute: Compute) -> None:
    rng = np.random.default_rng(0)
    parameters = parameters_of(checkered(50, 0), 1)
    shapes = {name: tuple(value.shape) for name, value in parameters.values.items()}
    rates = {name: rng.random(math.prod(shape[1:])).astype(np.float32) for name, shape in shapes.items()}
    want = {name: value.double().numpy().copy() for name, value in parameters.values.items()}
    averages, squares = ({name: np.zeros(shape) for name, shape in shapes.items()} for _ in range(2))
    for step in range(1, 4):
        gradients = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
        for name, gradient in gradients.items():
            averages[name] = 0.9 * averages[name] + 0.1 * gradient
            squares[name] = 0.999 * squares[name] + 0.001 * gradient.astype(np.float64) ** 2
            direction = averages[name] / (1 - 0.9**step) / np.sqrt(squares[name] / (1 - 0.999**step))
            want[name] -= rates[name].reshape(shapes[name][1:]) * direction
        tensors = {name: torch.tensor(gradient) for name, gradient in gradients.items()}
        parameters.step(tensors, {name: torch.tensor(rate) for name, rate in rates.items()}, compute)
    for name, value in parameters.values.items():
        np.testing.assert_allclose(value.numpy(), want[name], atol=2e-5, err_msg=name)


def test_far_gaussians_move_as_far_in_the_image() -> None:
    """A step of the optimizer is a length times the reach; halves of a split keep it."""
    scene = checkered(40, 0)
    reach = np.where(np.arange(40) < 20, 1.0, 500.0)
    parameters = parameters_of(scene, 0, reach)
    rates = {name: torch.full((math.prod(v.shape[1:]),), 0.01) for name, v in parameters.values.items()}
    gradients = {name: torch.ones_like(value) for name, value in parameters.values.items()}
    before = parameters.values["means"].clone()
    parameters.step(gradients, rates, NativeCompute())
    moved = (before - parameters.values["means"]).numpy()
    np.testing.assert_allclose(moved[:20], 0.01, rtol=1e-4)
    np.testing.assert_allclose(moved[20:], 5.0, rtol=1e-4)
    grown, _ = relocate_and_grow(
        parameters, np.where(reach > 1, 1.0, 0.0), 45, 0.01, np.random.default_rng(0)
    )
    assert (grown.reach == 500).sum() == 25


def test_growth_splits_where_the_error_is_and_drops_the_faint() -> None:
    scene = checkered(200, 0)
    opacities = np.full(200, 0.9, np.float32)
    opacities[:20] = 0.001
    faint = Gaussians(
        means=scene.means, quats=scene.quats, scales=scene.scales, opacities=opacities, sh=scene.sh
    )
    shares = np.zeros(200)
    shares[:60] = 1.0
    grown, _ = relocate_and_grow(parameters_of(faint, 0), shares, 210, 0.01, np.random.default_rng(0))
    assert len(grown) == 210
    result = gaussians_of(grown)
    assert result.opacities.min() > 0.5
    untouched = scene.means[60:]
    distances = np.linalg.norm(result.means[:, None] - untouched[None], axis=2).min(0)
    assert distances.max() == 0
    kept = {row.tobytes() for row in scene.means[20:]}
    moved = np.array([row.tobytes() not in kept for row in result.means])
    assert moved.sum() == 60  # thirty parents, two halves each


def test_error_is_laid_to_the_gaussians_that_paint_it() -> None:
    scene, cameras = checkered(600, 0), ring(3)
    recolored = np.array(scene.sh)
    recolored[:50] += 1.5
    wrong = Gaussians(
        means=scene.means, quats=scene.quats, scales=scene.scales, opacities=scene.opacities, sh=recolored
    )
    targets = [render(scene, c).rgb.transpose(2, 0, 1) for c in cameras]
    shares = error_shares(wrong, cameras, targets)
    assert shares[:50].mean() > 3 * shares[50:].mean()


def test_metrics() -> None:
    rng = np.random.default_rng(0)
    image = rng.random((40, 50, 3))
    assert psnr(image, image) == math.inf
    assert psnr(np.zeros((4, 4, 3)), np.full((4, 4, 3), 0.1)) == pytest.approx(20)
    assert ssim(image, image) == pytest.approx(1)
    noisy = [ssim(image, np.clip(image + s * rng.normal(size=image.shape), 0, 1)) for s in (0.05, 0.2, 0.5)]
    assert noisy == sorted(noisy, reverse=True)
    with pytest.raises(ValueError, match="shapes"):
        ssim(image, image[:-1])


def test_every_view_is_looked_at_before_any_twice() -> None:
    for views, count in ((56, 8), (12, 4), (5, 8), (9, 2)):
        turns = -(-views // min(count, views))
        seen = np.concatenate([choose_error_views(views, count, turn) for turn in range(turns)])
        assert set(seen) == set(range(views))
        assert len(seen) == turns * min(count, views)


@pytest.mark.parametrize("downsampling", [(), ((0.1, 2),), ((0.0, 2), (0.5, 1), (0.3, 1)), ((0.0, 0),)])
def test_schedules_without_a_size_for_each_iteration_are_refused(
    downsampling: tuple[tuple[float, int], ...],
) -> None:
    with pytest.raises(ConfigError, match="downsampling"):
        TrainingParams(downsampling=downsampling)


def test_a_training_keeps_to_its_limit_from_the_start() -> None:
    """Every third Gaussian is kept and widened, so that surface and shell keep their shares."""
    scene, cameras = checkered(300, 0), ring(3)
    initial = start(scene, 300)
    params = replace(PARAMS, iterations=6, grow_every=2, max_gaussians=100)
    state = start_training(initial, cameras, params, np.random.default_rng(0))
    kept = gaussians_of(state.parameters)
    assert np.allclose(kept.means, initial.means[::3])
    assert np.allclose(kept.scales, np.sqrt(3) * initial.scales[::3], rtol=1e-4)
    trained = train(initial, cameras, photograph(scene, cameras), params, silent, np.random.default_rng(0))
    assert len(trained) <= 100
