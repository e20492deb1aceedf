"""Input at the edge, drawn in child processes: a crash there fails a test instead of ending the run."""

import multiprocessing
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.errors import AomgenError, BackendError

CAMERA = Camera(
    fx=60.0, fy=58.0, cx=24.0, cy=17.0, width=50, height=37, T_world_cam=look_at([1.0, -1.4, 0.9], [0, 0, 0])
)
FIELDS = ("means", "quats", "scales", "opacities", "sh")


def scatter(count: int, degree: int = 1, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=rng.normal(size=(count, 3)) * 0.3,
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(-3, 0.6, (count, 3))),
        opacities=rng.uniform(0.05, 1, count),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
    )


def run_in_child(function: Callable[..., None], *arguments: object, timeout_s: float = 60) -> None:
    """Fails with the child's exit code, which is negative where a signal ended it."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch", "aomgen.splatting.differentiable"])  # imported once for all
    child = context.Process(target=function, args=arguments)
    child.start()
    child.join(timeout_s)
    if child.is_alive():
        child.kill()
        pytest.fail(f"{function.__name__} takes longer than {timeout_s} s")
    assert child.exitcode == 0, f"{function.__name__} ended with {child.exitcode}"


def _tensors(gaussians: Gaussians) -> dict:
    import torch

    with np.errstate(all="ignore"):
        odds = np.log(gaussians.opacities / (1 - gaussians.opacities))
        arrays = {
            "means": gaussians.means,
            "quats": gaussians.quats,
            "log_scales": np.log(gaussians.scales),
            "logit_opacities": odds,
            "sh": gaussians.sh,
            "features": np.ones((len(gaussians), 2)),
        }
    return {name: torch.tensor(np.array(a, np.float32)).requires_grad_() for name, a in arrays.items()}


def draw_and_pull(gaussians: Gaussians, camera: Camera) -> dict[str, np.ndarray]:
    """Every output of both interfaces is finite; gradients by name."""
    import torch

    from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, RasterOptions
    from aomgen.splatting.rasterizer import contribution_weights, render

    drawn = render(gaussians, camera, with_ids=True, antialiased=True)
    for image in (drawn.rgb, drawn.alpha, drawn.depth, drawn.median_depth):
        assert np.isfinite(image).all()
    masks = np.ones((2, camera.height, camera.width), np.float32)
    assert np.isfinite(contribution_weights(gaussians, camera, masks)).all()
    leaves = _tensors(gaussians)
    options = RasterOptions(sh_degree=gaussians.sh_degree, with_ids=True)
    images = CpuRasterizer()(GaussianTensors(**leaves), camera, options)
    shown = (images.rgb, images.depth, images.alpha, images.features)
    assert all(torch.isfinite(image).all() for image in shown)
    sum(image.sum() for image in shown).backward()
    return {name: leaf.grad.numpy() for name, leaf in leaves.items()}


def _no_and_single_gaussians() -> None:
    for count in (0, 1):
        gradients = draw_and_pull(scatter(count), CAMERA)
        assert all(len(gradient) == count for gradient in gradients.values())
        assert all(np.isfinite(gradient).all() for gradient in gradients.values())
    centred = replace(scatter(1), means=np.zeros((1, 3)), opacities=np.array([0.9]))
    gradients = draw_and_pull(centred, CAMERA)
    assert all(np.abs(gradients[name]).max() > 0 for name in gradients)


def test_no_gaussians_and_a_single_one() -> None:
    run_in_child(_no_and_single_gaussians)


def _broken_numbers() -> None:
    good = scatter(60)
    for field in FIELDS:
        for value in (np.nan, np.inf, -np.inf, 3e38, 1e20, 1e-40, 0.0):
            array = np.array(getattr(good, field))
            array.reshape(60, -1)[::4, -1] = value
            gradients = draw_and_pull(replace(good, **{field: array}), CAMERA)
            if not np.isfinite(value) and field != "opacities":  # an infinite logit is an opacity of 1
                assert all(np.isfinite(g).all() for g in gradients.values()), (field, value)
                assert not gradients["means"][::4].any(), (field, value)
                assert gradients["means"].any()


def test_broken_and_extreme_parameters() -> None:
    run_in_child(_broken_numbers)


def _degenerate_shapes_from_within() -> None:
    inside = CAMERA.move(look_at([0.0, 0.0, 0.0], [1.0, 0.2, 0.1]))
    for scales in ((0, 0, 0), (1e-20, 1e-20, 1e-20), (1e20, 1e20, 1e20), (1e4, 1e-6, 1e-6), (1e3, 1e3, 0)):
        for camera in (CAMERA, inside):
            g = replace(scatter(300), scales=np.tile(scales, (300, 1)))
            gradients = draw_and_pull(g, camera)
            assert all(np.isfinite(g).all() for g in gradients.values()), scales
    gradients = draw_and_pull(scatter(3000), inside)
    assert all(np.isfinite(g).all() for g in gradients.values())


def test_degenerate_scales_and_a_camera_inside_the_scene() -> None:
    run_in_child(_degenerate_shapes_from_within)


def expect(error: type[Exception], call: Callable[[], object]) -> None:
    with pytest.raises(error):
        call()


SIZES = [(0, 5), (5, 0), (0, 0), (-1, 5), (5, -7), (16385, 1), (10**6, 10**6), (2**32 + 4, 4)]


def _impossible_images(sizes: Sequence[tuple[int, int]]) -> None:
    import torch

    from aomgen.splatting.compute import image_loss
    from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, RasterOptions
    from aomgen.splatting.rasterizer import contribution_weights, render
    from aomgen.splatting.session import RenderSession

    g = scatter(5)
    for width, height in sizes:
        camera = replace(CAMERA, width=width, height=height)
        expect(BackendError, lambda: render(g, camera))  # noqa: B023
        expect(BackendError, lambda: RenderSession(g, camera))  # noqa: B023
        tensors = GaussianTensors(**_tensors(g))
        options = RasterOptions(sh_degree=1)
        expect(BackendError, lambda: CpuRasterizer()(tensors, camera, options))  # noqa: B023
    empty = replace(CAMERA, width=0, height=4)
    expect(BackendError, lambda: contribution_weights(g, empty, np.ones((1, 4, 0), np.float32)))
    expect(BackendError, lambda: image_loss(torch.zeros(3, 0, 5), torch.zeros(3, 0, 5)))


def test_images_of_impossible_size_are_refused_before_memory_is_taken() -> None:
    run_in_child(_impossible_images, SIZES)


def _tensors_of_another_kind() -> None:
    """The engine reads by address: another type would be read beyond its end."""
    import torch

    from aomgen.splatting.compute import image_loss

    x = torch.zeros(3, 300, 400)
    for bad in (x.half(), x.double(), x.to(torch.uint8)):
        expect(TypeError, lambda: image_loss(bad, bad))  # noqa: B023
        expect(TypeError, lambda: image_loss(x, bad))  # noqa: B023
    expect(ValueError, lambda: image_loss(x, x, gains=torch.ones(1)))
    expect(TypeError, lambda: image_loss(x, x, gains=torch.ones(3, dtype=torch.float64)))


def test_images_of_another_type_are_refused() -> None:
    run_in_child(_tensors_of_another_kind)


def _pictures_of_another_kind() -> None:
    from aomgen.splatting.session import RenderSession

    session = RenderSession(scatter(5), CAMERA)
    image, changed = session.picture(scatter(5))
    for bad in (
        (image[:, :-1], changed),
        (np.repeat(image, 2, 1)[:, ::2], changed),
        (image.astype(np.float32), changed),
        (image, changed[:1]),
        (image, changed[:, ::-1]),
    ):
        expect(ValueError, lambda: session.picture(scatter(5), into=bad))  # noqa: B023


def test_pictures_that_are_no_picture_of_the_session_are_refused() -> None:
    run_in_child(_pictures_of_another_kind)


def _little_memory(threads: int) -> None:
    """Far more pairs than memory, which some thread of the engine finds out."""
    from aomgen.splatting.rasterizer import render

    count = 60_000
    g = replace(scatter(count, degree=0), scales=np.full((count, 3), 1e3))
    camera = replace(CAMERA, width=2048, height=2048, fx=1000.0, fy=1000.0, cx=1024.0, cy=1024.0)
    render(scatter(10), camera, threads=threads)  # the threads are there before memory gets short
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (400 << 20), used + (400 << 20)))
    expect(BackendError, lambda: render(g, camera, threads=threads))
    render(scatter(10), replace(camera, width=64, height=64), threads=threads)


@pytest.mark.parametrize("threads", [1, 4])
def test_too_little_memory_is_an_error(threads: int) -> None:
    run_in_child(_little_memory, threads)


def _gigantic_splats() -> None:
    """More pairs than the engine takes on are refused, before they fill the memory."""
    from aomgen.splatting.rasterizer import render
    from aomgen.splatting.session import RenderSession

    g = replace(scatter(30_000, degree=0), scales=np.full((30_000, 3), 1e3))
    camera = replace(CAMERA, width=2048, height=2048, fx=1000.0, fy=1000.0, cx=1024.0, cy=1024.0)
    with pytest.raises(AomgenError, match="too large on the image"):
        render(g, camera)
    session = RenderSession(scatter(10), camera)
    with pytest.raises(AomgenError, match="too large on the image"):
        session.draw(g)
    assert session.draw(scatter(10)).alpha.max() > 0
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    assert peak_bytes < 2.5e9, f"{peak_bytes / 1e9:.2f} GB"


@pytest.mark.slow
def test_too_many_pairs_are_refused_in_bounded_memory() -> None:
    run_in_child(_gigantic_splats)


def _three_million() -> None:
    from aomgen.splatting.rasterizer import render

    count, rng = 3_000_000, np.random.default_rng(0)
    g = Gaussians(
        means=rng.random((count, 3), np.float32) - 0.5,
        quats=rng.random((count, 4), np.float32),
        scales=rng.random((count, 3), np.float32) * 0.004,
        opacities=rng.random(count, np.float32),
        sh=rng.random((count, 1, 3), np.float32),
    )
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    start = time.process_time()
    drawn = render(g, CAMERA.resize(320, 240))
    seconds = time.process_time() - start
    more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10) - before
    assert drawn.alpha.max() > 0.9
    assert np.isfinite(drawn.rgb).all()
    print(f"3 M Gaussians: {seconds:.2f} CPU-s, {more / 1e6:.0f} MB")
    assert seconds < 8
    assert more < 1.5e9, f"{more / 1e9:.2f} GB"


@pytest.mark.slow
def test_three_million_gaussians() -> None:
    run_in_child(_three_million)
