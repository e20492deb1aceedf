"""One contract for every rasterizer of tensors: the engine's, gsplat's on a GPU, and gsplat's twin.

The twin is gsplat with its compiled functions in torch (`gsplat_twin`), so that all that is Python, ours
and gsplat's, runs without a GPU wherever gsplat is installed. Each is held to a float64 reference with its
own rules for very opaque Gaussians; how far the rules lie apart is a test of its own.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

import tensor_reference as reference
from aomgen.core.camera import Camera, look_at
from aomgen.errors import BackendError
from aomgen.splatting.compute import make_rasterizer, torch_image_loss
from aomgen.splatting.differentiable import (
    CpuRasterizer,
    GaussianTensors,
    PartTensors,
    RasterOptions,
    TensorRendering,
)
from aomgen.splatting.gsplat_backend import GsplatRasterizer
from aomgen.splatting.gsplat_inputs import check_version, load_gsplat

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh", "features")
IMAGES = ("rgb", "depth", "alpha", "features")
OPTIONS = RasterOptions(sh_degree=3, background=(0.2, 0.4, 0.6))


@pytest.fixture(scope="module", autouse=True)
def _one_torch_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class Contract:
    """A rasterizer, the device its tensors are on, the rules that it follows, and how exactly.

    gsplat's backward pass starts from one minus alpha, of which float32 keeps three digits where a pixel
    is full.
    """

    def __init__(self, draw: Callable, device: str, rules: reference.Rules) -> None:
        self.draw, self.device, self.rules = draw, device, rules
        self.image_tolerance, self.gradient_tolerance = (1e-4, 3e-3) if device == "cuda" else (3e-5, 1e-4)

    def leaves(self, gaussians: GaussianTensors) -> GaussianTensors:
        return mapped(gaussians, self.leaf)

    def move(self, gaussians: GaussianTensors) -> GaussianTensors:
        return mapped(gaussians, lambda tensor: tensor.to(self.device))

    def leaf(self, tensor: torch.Tensor) -> torch.Tensor:
        return tensor.to(self.device).detach().clone().requires_grad_()


@pytest.fixture(params=["engine", "gsplat-twin", "gsplat-cuda"])
def contract(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Contract:
    if request.param == "engine":
        return Contract(CpuRasterizer(), "cpu", reference.ENGINE)
    if request.param == "gsplat-twin":
        gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed (pip install 'aomgen[gpu]')")
        import gsplat_twin

        gsplat_twin.install(gsplat, monkeypatch)
        return Contract(GsplatRasterizer(gsplat), "cpu", reference.GSPLAT)
    return Contract(cuda_rasterizer(), "cuda", reference.GSPLAT)


def cuda_rasterizer() -> GsplatRasterizer:
    try:
        return GsplatRasterizer()
    except BackendError as error:
        pytest.skip(str(error))


def mapped(gaussians: GaussianTensors, change: Callable) -> GaussianTensors:
    values = {field.name: getattr(gaussians, field.name) for field in fields(gaussians)}
    return GaussianTensors(
        **{name: None if value is None else change(value) for name, value in values.items()}
    )


def make_camera(width: int = 70, height: int = 50) -> Camera:
    """Off-centre principal point, unequal focal lengths, size that is no multiple of a tile."""
    pose = look_at([0.9, -1.2, 0.8], [0.0, 0.0, 0.1])
    return Camera(fx=75.0, fy=71.0, cx=33.0, cy=27.5, width=width, height=height, T_world_cam=pose)


def make_gaussians(count: int, degree: int = 3, features: int = 5, seed: int = 0) -> GaussianTensors:
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal(size=(count, 3)) * [0.5, 0.5, 0.3],
        "quats": rng.normal(size=(count, 4)),
        "log_scales": rng.normal(np.log(0.05), 0.7, (count, 3)),
        "logit_opacities": rng.normal(0.5, 2.0, count),
        "sh": rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
        "features": rng.normal(size=(count, features)),
    }
    tensors = {name: torch.tensor(array.astype(np.float32)) for name, array in arrays.items()}
    return GaussianTensors(**{**tensors, "features": tensors["features"] if features else None})


def make_parts(count: int, seed: int = 3) -> PartTensors:
    """Three parts, of which the last two are turned and moved."""
    rng = np.random.default_rng(seed)
    Ts = np.tile(np.eye(4), (3, 1, 1))
    for T in Ts[1:]:
        T[:] = look_at(rng.normal(size=3) * 0.2, rng.normal(size=3))
    return PartTensors(
        indices=torch.tensor(rng.integers(0, 3, count).astype(np.int32)),
        Ts_world_part=torch.tensor(Ts, dtype=torch.float32),
    )


def close(have: torch.Tensor | None, want: torch.Tensor | None, tolerance: float, name: str = "") -> None:
    """Equal within a share of the largest value that is wanted."""
    assert have is not None
    assert want is not None
    have, want = have.detach().cpu().double(), want.detach().double()
    assert have.shape == want.shape, name
    size = want.abs().max().item()
    assert size > 0, name
    np.testing.assert_allclose(have, want, atol=tolerance * size, rtol=0, err_msg=name)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize(("degree", "antialiased"), [(0, False), (1, True), (2, False), (3, True)])
def test_images_and_gradients(contract: Contract, degree: int, antialiased: bool, moving: bool) -> None:
    camera = make_camera()
    gaussians = make_gaussians(180, degree, seed=degree)
    parts = make_parts(180) if moving else None
    options = replace(OPTIONS, sh_degree=degree, antialiased=antialiased)
    pose = torch.tensor(camera.T_cam_world, dtype=torch.float32)
    results = []
    for exact in (True, False):
        cast = (lambda t: t.double().requires_grad_()) if exact else contract.leaf
        leaves, T_cam_world = mapped(gaussians, cast), cast(pose)
        moved = parts and PartTensors(
            indices=parts.indices if exact else parts.indices.to(contract.device),
            Ts_world_part=cast(parts.Ts_world_part),
        )
        if exact:
            drawn, blend = reference.render(leaves, camera, options, T_cam_world, moved, contract.rules)
            weights = random_weights(drawn, blend.clear)
        else:
            drawn = contract.draw(leaves, camera, options, T_cam_world=T_cam_world, parts=moved)
        images = {name: getattr(drawn, name) for name in IMAGES}
        sum((image * image.new_tensor(weights[name])).sum() for name, image in images.items()).backward()
        gradients = {name: getattr(leaves, name).grad for name in NAMES}
        for name, T in (("camera", T_cam_world), ("parts", moved and moved.Ts_world_part)):
            if T is not None:
                gradients[name] = reference.twists(T.detach().cpu(), T.grad.cpu())
        results.append((images, gradients))
    (want, want_gradients), (have, have_gradients) = results
    clear = blend.clear
    assert clear.double().mean() > 0.98
    for name, image in have.items():
        assert (image.dtype, image.device.type) == (torch.float32, contract.device)
        close(clear_only(image, clear), clear_only(want[name], clear), contract.image_tolerance, name)
    for name, gradient in have_gradients.items():
        close(gradient, want_gradients[name], contract.gradient_tolerance, name)
        flat = gradient.cpu().double().flatten(), want_gradients[name].flatten()
        assert torch.cosine_similarity(*flat, dim=0) > 0.999, name


def random_weights(drawn: TensorRendering, clear: torch.Tensor) -> dict[str, np.ndarray]:
    """Weights of a loss, zero at the pixels that float32 may decide otherwise."""
    rng = np.random.default_rng(99)
    shapes = {name: getattr(drawn, name).shape for name in IMAGES}
    pixels = {name: clear[..., None] if name == "features" else clear for name in IMAGES}
    return {name: rng.normal(size=shapes[name]) / 1000 * pixels[name].numpy() for name in IMAGES}


def clear_only(image: torch.Tensor, clear: torch.Tensor) -> torch.Tensor:
    """Pixels of an image (H, W), (H, W, D) or (3, H, W)."""
    return image.cpu()[clear] if image.shape[:2] == clear.shape else image.cpu()[:, clear]


def test_median_depth_and_largest_contribution(contract: Contract) -> None:
    camera, gaussians, parts = make_camera(), make_gaussians(180), make_parts(180)
    options = replace(OPTIONS, with_ids=True)
    on_device = PartTensors(
        indices=parts.indices.to(contract.device), Ts_world_part=parts.Ts_world_part.to(contract.device)
    )
    have = contract.draw(contract.move(gaussians), camera, options, parts=on_device)
    exact, pose = mapped(gaussians, torch.Tensor.double), torch.tensor(camera.T_cam_world)
    parts = replace(parts, Ts_world_part=parts.Ts_world_part.double())
    want, blend = reference.render(exact, camera, options, pose, parts, contract.rules)
    assert have.max_id.dtype == torch.int32
    assert have.median_depth.dtype == torch.float32
    two = blend.weights.topk(2, 0).values
    clear = blend.clear & ((two[0] - two[1] > 1e-4) | (two[0] == 0))
    assert clear.double().mean() > 0.5
    assert len(want.max_id.unique()) > 20
    np.testing.assert_array_equal(have.max_id.cpu()[clear], want.max_id[clear])
    clear = blend.clear & ((blend.left - 0.5).abs().amin(0) > 1e-4)
    assert 0.2 < (want.median_depth > 0).double().mean() < 1
    np.testing.assert_allclose(have.median_depth.cpu()[clear], want.median_depth[clear], atol=1e-5)


@pytest.mark.parametrize("features", [0, 1, 40])
def test_any_number_of_features(contract: Contract, features: int) -> None:
    camera, gaussians = make_camera(33, 20), make_gaussians(60, 0, features)
    options = replace(OPTIONS, sh_degree=0)
    have = contract.draw(contract.move(gaussians), camera, options)
    assert have.median_depth is None
    assert have.max_id is None
    exact, pose = mapped(gaussians, torch.Tensor.double), torch.tensor(camera.T_cam_world)
    want, blend = reference.render(exact, camera, options, pose, None, contract.rules)
    for name in IMAGES if features else IMAGES[:3]:
        images = [clear_only(getattr(drawn, name), blend.clear) for drawn in (have, want)]
        close(images[0], images[1], contract.image_tolerance, name)
    assert (have.features is None) == (features == 0)


def test_a_lower_degree_ignores_the_rest(contract: Contract) -> None:
    camera, gaussians = make_camera(40, 30), make_gaussians(60, degree=3, features=0)
    options = replace(OPTIONS, sh_degree=1)
    leaves = contract.leaves(gaussians)
    have = contract.draw(leaves, camera, options)
    have.rgb.sum().backward()
    want = contract.draw(contract.move(replace(gaussians, sh=gaussians.sh[:, :4])), camera, options)
    close(have.rgb, want.rgb.cpu(), contract.image_tolerance)
    assert leaves.sh.grad[:, 4:].abs().max() == 0
    assert leaves.sh.grad[:, :4].abs().max() > 0


@pytest.mark.parametrize("count", [0, 7])
def test_nothing_to_draw(contract: Contract, count: int) -> None:
    """No Gaussians, and Gaussians that are all behind the camera."""
    camera, gaussians = make_camera(20, 18), make_gaussians(count)
    behind = camera.center - 9 * camera.T_world_cam[:3, 2]
    gaussians = replace(gaussians, means=gaussians.means + torch.tensor(behind, dtype=torch.float32))
    leaves = contract.leaves(gaussians)
    drawn = contract.draw(leaves, camera, replace(OPTIONS, with_ids=True))
    want = torch.tensor(OPTIONS.background)[:, None, None].expand(3, 18, 20)
    assert torch.equal(drawn.rgb.detach().cpu(), want)
    for image in (drawn.depth, drawn.alpha, drawn.features, drawn.median_depth):
        assert image.detach().abs().max() == 0
    assert (drawn.max_id == -1).all()
    assert drawn.features.shape == (18, 20, 5)
    (drawn.rgb.sum() + drawn.depth.sum()).backward()
    assert leaves.means.grad.shape == (count, 3)
    assert leaves.means.grad.abs().sum() == 0


@pytest.mark.parametrize("name", NAMES[:5])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_gaussians_that_are_no_numbers_are_left_out(contract: Contract, name: str, value: float) -> None:
    if name == "logit_opacities" and value > 0:
        pytest.skip("an infinite logit is an opacity of one")
    camera, gaussians = make_camera(40, 30), make_gaussians(80)
    broken = mapped(gaussians, torch.Tensor.clone)
    getattr(broken, name)[5].view(-1)[-1] = value
    rest = mapped(gaussians, lambda tensor: torch.cat([tensor[:5], tensor[6:]]))
    results = []
    for given in (broken, rest):
        leaves = contract.leaves(given)
        drawn = contract.draw(leaves, camera, OPTIONS)
        (drawn.rgb.sum() + drawn.depth.sum() + drawn.features.sum()).backward()
        results.append((drawn, leaves))
    (have, have_leaves), (want, want_leaves) = results
    close(have.rgb, want.rgb.cpu(), contract.image_tolerance)
    for parameter in NAMES:
        have_gradient, want_gradient = (getattr(x, parameter).grad.cpu() for x in (have_leaves, want_leaves))
        assert have_gradient[5].abs().max() == 0, parameter
        close(
            torch.cat([have_gradient[:5], have_gradient[6:]]),
            want_gradient,
            contract.gradient_tolerance,
            parameter,
        )


def test_a_gaussian_at_the_camera_spoils_nothing(contract: Contract) -> None:
    camera = replace(make_camera(40, 30), T_world_cam=np.eye(4))
    gaussians = make_gaussians(50)
    gaussians = replace(gaussians, means=gaussians.means + torch.tensor([0.0, 0.0, 2.0]))
    gaussians.means[3] = 0
    leaves = contract.leaves(gaussians)
    drawn = contract.draw(leaves, camera, OPTIONS)
    drawn.rgb.sum().backward()
    for name in NAMES[:5]:
        assert getattr(leaves, name).grad.isfinite().all(), name


@pytest.mark.parametrize("count", [1, 3, 40])
def test_contribution_weights(contract: Contract, count: int) -> None:
    if not isinstance(contract.draw, GsplatRasterizer):
        pytest.skip("the engine's weights are tested with its numpy interface")
    camera, gaussians = make_camera(), make_gaussians(120)
    masks = torch.tensor(np.random.default_rng(1).normal(size=(count, 50, 70)), dtype=torch.float32)
    exact, pose = mapped(gaussians, torch.Tensor.double), torch.tensor(camera.T_cam_world)
    blend = reference.blend(exact, camera, OPTIONS, pose, None, contract.rules)
    masks = masks * blend.clear
    have = contract.draw.contribution_weights(
        contract.leaves(gaussians), camera, masks.to(contract.device), OPTIONS
    )
    assert not have.requires_grad
    close(have, torch.einsum("nhw,mhw->nm", blend.weights, masks.double()), contract.gradient_tolerance)


def test_bad_scenes_are_refused(contract: Contract) -> None:
    if not isinstance(contract.draw, GsplatRasterizer):
        pytest.skip("the engine's refusals are tested with its C interface")
    gaussians = contract.move(make_gaussians(9, degree=1))
    camera, options = make_camera(), replace(OPTIONS, sh_degree=1)
    draw = contract.draw
    with pytest.raises(BackendError, match="SH degree 2 of 4 coefficients"):
        draw(gaussians, camera, replace(options, sh_degree=2))
    with pytest.raises(BackendError, match="an image of 0 x 50 pixels"):
        draw(gaussians, replace(camera, width=0), options)
    with pytest.raises(TypeError, match="quats: expected float32"):
        draw(replace(gaussians, quats=gaussians.quats.double()), camera, options)
    with pytest.raises(ValueError, match=r"log_scales have shape \(8, 3\), expected \(9, 3\)"):
        draw(replace(gaussians, log_scales=gaussians.log_scales[:8]), camera, options)
    Ts = torch.eye(4, device=contract.device)[None]
    rows = torch.zeros(9, dtype=torch.int32, device=contract.device)
    for row in (-1, 1):
        rows[4] = row
        with pytest.raises(BackendError, match=r"part indices -?\d to \d of 1 transforms"):
            draw(gaussians, camera, options, parts=PartTensors(indices=rows, Ts_world_part=Ts))
    with pytest.raises(ValueError, match=r"masks have shape \(1, 3, 3\), expected \(M, 50, 70\)"):
        draw.contribution_weights(gaussians, camera, torch.zeros(1, 3, 3, device=contract.device), options)


def test_engine_and_gsplat_learn_the_same(contract: Contract) -> None:
    """Very opaque Gaussians too, where the rules differ: pictures and gradients stay close."""
    if isinstance(contract.draw, CpuRasterizer):
        pytest.skip("compared with itself")
    count, size, scale = (20_000, (640, 480), 0.25) if contract.device == "cuda" else (600, (120, 80), 1.0)
    camera, gaussians = make_camera().resize(*size), make_gaussians(count, features=0)
    logits = gaussians.logit_opacities + 2 * (gaussians.logit_opacities > 2)
    assert (logits.sigmoid() > 0.99).double().mean() > 0.1
    scales = gaussians.log_scales + np.log(scale)
    gaussians = replace(gaussians, logit_opacities=logits, log_scales=scales)
    target = torch.tensor(np.random.default_rng(0).random((3, *size[::-1])), dtype=torch.float32)
    engine, results = Contract(CpuRasterizer(), "cpu", reference.ENGINE), []
    for one in (engine, contract):
        leaves = one.leaves(gaussians)
        drawn = one.draw(leaves, camera, OPTIONS)
        torch_image_loss(drawn.rgb, target.to(one.device)).backward()
        gradients = {name: getattr(leaves, name).grad.cpu().flatten() for name in NAMES[:5]}
        results.append((drawn.rgb.detach().cpu().clamp_max(1), gradients))
    (engine_rgb, engine_gradients), (rgb, gradients) = results
    psnr = -10 * (rgb - engine_rgb).square().mean().log10()
    assert psnr > 60
    for name, gradient in gradients.items():
        want = engine_gradients[name]
        assert torch.cosine_similarity(gradient, want, dim=0) > 0.999, name
        assert (gradient - want).norm() < 0.02 * want.norm(), name


@pytest.mark.parametrize(("device", "kind"), [("cpu", CpuRasterizer), ("cuda", GsplatRasterizer)])
def test_every_device_has_its_rasterizer(device: str, kind: type) -> None:
    if device == "cuda":
        cuda_rasterizer()
    assert isinstance(make_rasterizer(device), kind)


def test_unknown_devices_are_refused() -> None:
    with pytest.raises(BackendError, match="device 'tpu' is unknown; choose one of: cpu, cuda"):
        make_rasterizer("tpu")


@pytest.mark.parametrize("version", ["1.5.2", "1.4", "2.0.0", "unknown"])
def test_other_versions_of_gsplat_are_refused(version: str) -> None:
    with pytest.raises(BackendError, match=f"version {version}, expected 1.5.3 or later and before 2; pip"):
        check_version(version)


@pytest.mark.parametrize("version", ["1.5.3", "1.5.3+pt24cu121", "1.6.0rc1", "1.10"])
def test_known_versions_of_gsplat_are_taken(version: str) -> None:
    check_version(version)


def test_missing_cuda_is_an_error_with_a_remedy() -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    with pytest.raises(BackendError, match=r"no CUDA device is found by torch .*; use a machine with"):
        load_gsplat()
