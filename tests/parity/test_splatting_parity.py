"""The native engine against its float64 twin, on every instruction set of this machine."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

import splatting_reference as reference
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.splatting import native
from aomgen.splatting.compute import image_loss
from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, PartTensors, RasterOptions
from aomgen.splatting.rasterizer import contribution_weights, render

BACKGROUND = (0.2, 0.4, 0.6)
NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")


@pytest.fixture(scope="module", autouse=True)
def _one_torch_thread() -> Iterator[None]:
    """The reference runs thousands of tiny operations, which threads only slow down."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def make_camera(width: int = 70, height: int = 50) -> Camera:
    """Off-centre principal point, unequal focal lengths, size that is no multiple of a tile."""
    pose = look_at([0.9, -1.2, 0.8], [0.0, 0.0, 0.1])
    return Camera(fx=75.0, fy=71.0, cx=33.0, cy=27.5, width=width, height=height, T_world_cam=pose)


def make_parameters(count: int, degree: int, seed: int) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal(size=(count, 3)) * [0.5, 0.5, 0.3],
        "quats": rng.normal(size=(count, 4)),
        "log_scales": rng.normal(np.log(0.05), 0.7, (count, 3)),
        "logit_opacities": rng.normal(0.5, 2.0, count),
        "sh": rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
    }
    return {name: torch.tensor(array.astype(np.float32)) for name, array in arrays.items()}


def as_gaussians(parameters: dict[str, torch.Tensor]) -> Gaussians:
    quats = torch.nn.functional.normalize(parameters["quats"], dim=-1)
    return Gaussians(
        means=parameters["means"].numpy(),
        quats=quats.numpy(),
        scales=parameters["log_scales"].exp().numpy(),
        opacities=parameters["logit_opacities"].sigmoid().numpy(),
        sh=parameters["sh"].numpy(),
    )


def double(parameters: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.double().requires_grad_() for name, tensor in parameters.items()}


@pytest.fixture(scope="module", params=[0, 1, 2, 3])
def expected(request: pytest.FixtureRequest) -> dict:
    """A scene of one SH degree with the reference's images and gradients."""
    degree, camera = request.param, make_camera()
    parameters = make_parameters(180, degree, seed=degree)
    exact = double(parameters)
    images = reference.render(exact, camera, degree, BACKGROUND)
    rng = np.random.default_rng(99)
    weights = [torch.tensor(rng.normal(size=image.shape) / 1000) for image in images]
    loss = sum((image * weight).sum() for image, weight in zip(images, weights, strict=True))
    loss.backward()
    return {
        "degree": degree,
        "camera": camera,
        "parameters": parameters,
        "images": [image.detach().numpy() for image in images],
        "weights": [weight.float() for weight in weights],
        "gradients": {name: exact[name].grad.numpy() for name in NAMES},
    }


@pytest.mark.parametrize("isa", native.instruction_sets())
def test_images_and_gradients_match_float64(expected: dict, isa: str) -> None:
    context = native.Context(instruction_set=isa)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in expected["parameters"].items()}
    options = RasterOptions(sh_degree=expected["degree"], background=BACKGROUND)
    drawn = CpuRasterizer(context)(GaussianTensors(**leaves), expected["camera"], options)
    images = (drawn.rgb, drawn.depth, drawn.alpha)
    for have, want in zip(images, expected["images"], strict=True):
        np.testing.assert_allclose(have.detach().numpy(), want, atol=2e-5)
    loss = sum((image * w).sum() for image, w in zip(images, expected["weights"], strict=True))
    loss.backward()
    for name in NAMES:
        have, want = leaves[name].grad.numpy(), expected["gradients"][name]
        assert np.abs(want).max() > 0
        np.testing.assert_allclose(have, want, atol=5e-5 * np.abs(want).max(), err_msg=name)


def rotation_about(axis: torch.Tensor) -> torch.Tensor:
    """Rotation matrix (3, 3) of a rotation vector (3,)."""
    zero = torch.zeros_like(axis[0])
    rows = [[zero, -axis[2], axis[1]], [axis[2], zero, -axis[0]], [-axis[1], axis[0], zero]]
    return torch.matrix_exp(torch.stack([torch.stack(row) for row in rows]))


def rigid(motion: torch.Tensor) -> torch.Tensor:
    """Transform (4, 4) of a rotation vector and a translation (6,)."""
    upper = torch.cat([rotation_about(motion[:3]), motion[3:, None]], 1)
    return torch.cat([upper, torch.tensor([[0, 0, 0, 1]], dtype=motion.dtype)])


@pytest.fixture(scope="module", params=[False, True], ids=["classic", "antialiased"])
def moving(request: pytest.FixtureRequest) -> dict:
    """Parts with poses, a differentiable camera and features: the reference's images and gradients."""
    camera, degree, rng = make_camera(), 3, np.random.default_rng(8)
    parameters = make_parameters(150, degree, seed=21)
    if request.param:  # smaller than a pixel, where compensation matters
        parameters["log_scales"] -= 1.5
    parameters["features"] = torch.tensor(rng.normal(size=(150, 7)).astype(np.float32))
    parts = torch.tensor(rng.integers(0, 4, 150).astype(np.int32))
    motions = torch.tensor(rng.normal(size=(5, 6)) * 0.3)
    exact = double(parameters)
    exact["motions"] = motions.clone().requires_grad_()
    Ts_part = torch.stack([rigid(motion) for motion in exact["motions"][:4]])
    T_cam_world = rigid(exact["motions"][4] * 0.1) @ torch.tensor(camera.T_cam_world)
    Ts_cam_part = (T_cam_world @ Ts_part)[parts.long()]
    images = reference.render(exact, camera, degree, BACKGROUND, Ts_cam_part, request.param)
    weights = [torch.tensor(rng.normal(size=image.shape) / 1000) for image in images]
    sum((image * weight).sum() for image, weight in zip(images, weights, strict=True)).backward()
    return {
        "antialiased": request.param,
        "camera": camera,
        "parameters": parameters,
        "parts": parts,
        "motions": motions,
        "images": [image.detach().numpy() for image in images],
        "weights": [weight.float() for weight in weights],
        "gradients": {name: tensor.grad.numpy() for name, tensor in exact.items()},
    }


@pytest.mark.parametrize("isa", native.instruction_sets())
def test_features_poses_and_parts_match_float64(moving: dict, isa: str) -> None:
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in moving["parameters"].items()}
    leaves["motions"] = moving["motions"].clone().requires_grad_()
    Ts_part = torch.stack([rigid(motion) for motion in leaves["motions"][:4]]).float()
    T_cam_world = rigid(leaves["motions"][4] * 0.1) @ torch.tensor(moving["camera"].T_cam_world)
    gaussians = GaussianTensors(**{name: leaves[name] for name in (*NAMES, "features")})
    drawn = CpuRasterizer(native.Context(instruction_set=isa))(
        gaussians,
        moving["camera"],
        RasterOptions(sh_degree=3, background=BACKGROUND, antialiased=moving["antialiased"]),
        T_cam_world=T_cam_world.float(),
        parts=PartTensors(indices=moving["parts"], Ts_world_part=Ts_part),
    )
    images = (drawn.rgb, drawn.depth, drawn.alpha, drawn.features)
    for have, want in zip(images, moving["images"], strict=True):
        np.testing.assert_allclose(have.detach().numpy(), want, atol=5e-5)
    sum((image * w).sum() for image, w in zip(images, moving["weights"], strict=True)).backward()
    for name, want in moving["gradients"].items():
        assert np.abs(want).max() > 0
        have = leaves[name].grad.numpy()
        np.testing.assert_allclose(have, want, atol=1e-4 * np.abs(want).max(), err_msg=name)


@pytest.mark.parametrize("isa", native.instruction_sets())
def test_ids_are_those_of_the_numpy_images(isa: str) -> None:
    parameters, camera = make_parameters(90, 1, seed=6), make_camera()
    options = RasterOptions(sh_degree=1, with_ids=True)
    rasterizer = CpuRasterizer(native.Context(instruction_set=isa))
    drawn = rasterizer(GaussianTensors(**parameters), camera, options)
    want = render(as_gaussians(parameters), camera, with_ids=True)
    assert want.max_id is not None
    assert (drawn.max_id.numpy() != want.max_id).mean() < 2e-3  # ties
    np.testing.assert_allclose(
        np.median(np.abs(drawn.median_depth.numpy() - want.median_depth)), 0, atol=1e-6
    )


def test_a_lower_degree_ignores_the_rest() -> None:
    parameters, camera = make_parameters(60, 3, seed=5), make_camera()
    low = dict(parameters, sh=parameters["sh"][:, :4].contiguous())
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}
    options = RasterOptions(sh_degree=1)
    drawn = CpuRasterizer()(GaussianTensors(**leaves), camera, options)
    want = CpuRasterizer()(GaussianTensors(**low), camera, options)
    assert torch.equal(drawn.rgb, want.rgb)
    drawn.rgb.sum().backward()
    assert leaves["sh"].grad[:, 4:].abs().max() == 0
    assert leaves["sh"].grad[:, :4].abs().max() > 0


def test_a_context_used_again_refuses_the_old_backward() -> None:
    parameters, camera = make_parameters(20, 0, seed=1), make_camera()
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}
    rasterizer, options = CpuRasterizer(), RasterOptions(sh_degree=0)
    first = rasterizer(GaussianTensors(**leaves), camera, options)
    rasterizer(GaussianTensors(**leaves), camera, options)
    with pytest.raises(native.BackendError, match="overwritten"):
        first.rgb.sum().backward()


@pytest.fixture(params=native.instruction_sets())
def any_isa(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Functions without a choice of instruction set run on each in turn."""
    context = native.Context(instruction_set=request.param)

    def fixed() -> native.Context:
        monkeypatch.setattr(
            context,
            "configure",
            lambda threads=None: native.Context.configure(context, threads, request.param),
        )
        return context

    monkeypatch.setattr(native, "scratch_context", fixed)
    return request.param


@pytest.mark.usefixtures("any_isa")
def test_numpy_images_match_float64() -> None:
    parameters, camera = make_parameters(150, 2, seed=11), make_camera()
    rng = np.random.default_rng(0)
    features = rng.normal(size=(150, 5)).astype(np.float32)
    drawn = render(as_gaussians(parameters), camera, background=BACKGROUND, features=features, with_ids=True)
    order, weights, left, s = reference.blend_weights(double(parameters), camera, 2)
    weights, left = weights.detach().numpy(), left.detach().numpy()
    depths, colors = s["depth"].detach().numpy()[order], s["color"].detach().numpy()[order]
    rgb = np.einsum("nhw,nc->hwc", weights, colors) + left[..., None] * BACKGROUND
    np.testing.assert_allclose(drawn.rgb, np.minimum(rgb, 1), atol=2e-5)
    np.testing.assert_allclose(drawn.features, np.einsum("nhw,nd->hwd", weights, features[order]), atol=5e-5)
    alpha = 1 - left
    depth = np.where(alpha > 1e-3, np.einsum("nhw,n->hw", weights, depths) / np.maximum(alpha, 1e-3), 0)
    np.testing.assert_allclose(drawn.depth, depth, atol=1e-4)
    best = np.where(weights.max(0) > 0, np.array(order)[weights.argmax(0)], -1)
    top_two = np.sort(weights, axis=0)[-2:]
    clear = top_two[1] - top_two[0] > 1e-4
    assert clear.mean() > 0.5
    np.testing.assert_array_equal(drawn.max_id[clear], best[clear])
    below_half = 1 - np.cumsum(weights, 0) < 0.5
    median = np.where(below_half.any(0), depths[below_half.argmax(0)], 0)
    clear = np.abs(1 - np.cumsum(weights, 0) - 0.5).min(0) > 1e-4
    np.testing.assert_allclose(drawn.median_depth[clear], median[clear], atol=1e-5)


@pytest.mark.usefixtures("any_isa")
@pytest.mark.parametrize("count", [1, 3, 19])
def test_contribution_weights_match_float64(count: int) -> None:
    parameters, camera = make_parameters(120, 0, seed=3), make_camera()
    masks = np.random.default_rng(1).random((count, camera.height, camera.width)).astype(np.float32)
    have = contribution_weights(as_gaussians(parameters), camera, masks)
    order, weights, _, _ = reference.blend_weights(double(parameters), camera, 0)
    want = np.zeros((120, count))
    want[order] = np.einsum("nhw,mhw->nm", weights.detach().numpy(), masks)
    assert want.max() > 1
    np.testing.assert_allclose(have, want, rtol=1e-3, atol=2e-3)


@pytest.mark.parametrize("isa", native.instruction_sets())
@pytest.mark.parametrize("size", [(37, 53), (8, 5), (16, 16)])
def test_image_loss_matches_float64(isa: str, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    target = torch.tensor(rng.random((3, *size)))
    rendered = (target + 0.2 * torch.tensor(rng.normal(size=(3, *size)))).requires_grad_()
    gains = torch.tensor([0.9, 1.0, 1.2], dtype=torch.float64, requires_grad=True)
    want = reference.image_loss(rendered, target, gains, 0.2)
    want.backward()
    x, g = rendered.detach().float().requires_grad_(), gains.detach().float().requires_grad_()
    context = native.Context(instruction_set=isa)
    have = image_loss(x, target.float(), gains=g, dssim_weight=0.2, context=context)
    have.backward()
    assert have.item() == pytest.approx(want.item(), abs=1e-5)
    np.testing.assert_allclose(x.grad, rendered.grad, atol=2e-4 * rendered.grad.abs().max().item())
    np.testing.assert_allclose(g.grad, gains.grad, rtol=1e-4, atol=1e-6)
