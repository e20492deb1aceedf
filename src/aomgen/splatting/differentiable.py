"""Gaussians as torch tensors, and differentiable rendering of them.

`Rasterizer` is the interface that training requires; `CpuRasterizer` implements it with the engine.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from aomgen.core.camera import Camera
from aomgen.splatting import native
from aomgen.splatting.rasterizer import NEAR_DEPTH, image_shape, native_view


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussianTensors:
    """N Gaussians in the parametrization of the optimizer, float32.

    Attributes:
        means: Means (N, 3), [m].
        quats: Rotations (N, 4) wxyz; the rasterizer normalizes them.
        log_scales: Logarithms of the standard deviations (N, 3).
        logit_opacities: Logits of the opacities (N,).
        sh: Spherical harmonics (N, K, 3), K = 1, 4, 9 or 16.
        features: Features (N, D), which are blended like colors, or None. Gradients require D <= 256.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor
    features: Tensor | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PartTensors:
    """Rigid parts of a set of Gaussians; each Gaussian is given in the frame of its part.

    Attributes:
        indices: Part of each Gaussian (N,) int32, 0..P-1.
        Ts_world_part: Rigid poses of the parts (P, 4, 4) float32, differentiable.
    """

    indices: Tensor
    Ts_world_part: Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterOptions:
    """Options of the rasterizer.

    Attributes:
        sh_degree: SH degree that is evaluated, at most that of the coefficients.
        background: sRGB color 0..1 behind the Gaussians.
        antialiased: Reduce the opacity of Gaussians smaller than a pixel.
        with_ids: Also compute median depth and the Gaussian with the largest weight.
        near_depth: Gaussians at or before this depth are not rendered, [m].
    """

    sh_degree: int
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialiased: bool = False
    with_ids: bool = False
    near_depth: float = NEAR_DEPTH


@dataclass(frozen=True, slots=True, kw_only=True)
class TensorRendering:
    """Images on the device of the Gaussians; rgb, depth, alpha and features are differentiable.

    Attributes:
        rgb: Colors (3, H, W) float32, sRGB, not limited to 1.
        depth: Sum of weight times depth (H, W), not divided by alpha, [m].
        alpha: Accumulated alpha (H, W), 0..1.
        features: Sum of weight times feature (H, W, D); None without features.
        median_depth: Depth of the Gaussian that reduces the transmittance below one half (H, W), [m]; 0 if it remains
            above. None without `RasterOptions.with_ids`.
        max_id: Index of the Gaussian with the largest weight (H, W) int32, -1 for none. None without
            `RasterOptions.with_ids`.
    """

    rgb: Tensor
    depth: Tensor
    alpha: Tensor
    features: Tensor | None = None
    median_depth: Tensor | None = None
    max_id: Tensor | None = None


class Rasterizer(Protocol):
    """Function that renders Gaussians to images, differentiably."""

    def __call__(
        self,
        gaussians: GaussianTensors,
        camera: Camera,
        options: RasterOptions,
        *,
        T_cam_world: Tensor | None = None,
        parts: PartTensors | None = None,
    ) -> TensorRendering:
        """Render Gaussians.

        Args:
            gaussians: Gaussians in the world frame of the camera, or in the frames of `parts`.
            camera: Intrinsic parameters, image size and pose.
            options: Options of the rasterizer.
            T_cam_world: Rigid pose (4, 4) float32 that replaces the camera's, differentiable.
            parts: Parts of the Gaussians.

        Raises:
            BackendError: The backend is missing or refuses the scene.
            TypeError, ValueError: Tensors have the wrong type, device or shape; see `check_tensors`.
        """
        ...


class CpuRasterizer:
    """Rasterizer that uses the engine on the CPU; implements `Rasterizer`.

    Args:
        context: Context of the engine; None creates a new one. The backward pass of an image must precede the rendering of
            the next image with the same context.
    """

    def __init__(self, context: native.Context | None = None) -> None:
        self.context = context or native.Context()

    def __call__(
        self,
        gaussians: GaussianTensors,
        camera: Camera,
        options: RasterOptions,
        *,
        T_cam_world: Tensor | None = None,
        parts: PartTensors | None = None,
    ) -> TensorRendering:
        """Render as described in `Rasterizer`."""
        check_tensors(gaussians, torch.device("cpu"))
        if T_cam_world is None:
            T_cam_world = torch.tensor(camera.T_cam_world, dtype=torch.float32)
        Ts = T_cam_world[None] if parts is None else T_cam_world @ parts.Ts_world_part
        indices = None if parts is None else parts.indices.to(torch.int32).contiguous()
        count = len(gaussians.means)
        if indices is not None and indices.shape != (count,):
            raise ValueError(f"part indices have shape {tuple(indices.shape)}, expected ({count},)")
        if Ts.ndim != 3 or Ts.shape[1:] != (4, 4) or Ts.dtype != torch.float32 or Ts.device.type != "cpu":
            raise ValueError(
                f"poses are {tuple(Ts.shape)} {Ts.dtype} on {Ts.device}, expected (P, 4, 4) float32 on cpu"
            )
        g = gaussians
        tensors = (g.means, g.quats, g.log_scales, g.logit_opacities, g.sh, Ts[:, :3])
        images = _Rasterize.apply(self.context, camera, options, indices, g.features, *tensors)
        rgb, depth, alpha, features, median, max_id = images  # type: ignore[misc]
        return TensorRendering(
            rgb=rgb, depth=depth, alpha=alpha, features=features, median_depth=median, max_id=max_id
        )


_NAMES = ("means", "quats", "scales", "opacities", "sh")


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        context: native.Context,
        camera: Camera,
        options: RasterOptions,
        parts: Tensor | None,
        features: Tensor | None,
        *tensors: Tensor,
    ) -> tuple[Tensor | None, ...]:
        *inputs, poses = (tensor.detach().contiguous() for tensor in tensors)
        features = None if features is None else features.detach().contiguous()
        height, width = image_shape(camera)
        rgb = torch.empty((3, height, width))
        depth, alpha = torch.empty((height, width)), torch.empty((height, width))
        drawn = None if features is None else torch.empty((height, width, features.shape[1]))
        median = torch.empty((height, width)) if options.with_ids else None
        max_id = torch.empty((height, width), dtype=torch.int32) if options.with_ids else None
        scene = native.NativeScene(
            count=len(inputs[0]),
            sh_coefficients=inputs[4].shape[1],
            sh_degree=options.sh_degree,
            encoded=1,
            feature_count=0 if features is None else features.shape[1],
            features=_address(features),
            parts=_address(parts),
            **{name: tensor.data_ptr() for name, tensor in zip(_NAMES, inputs, strict=True)},
        )
        view = native_view(
            camera,
            poses.numpy(),
            background=options.background,
            antialiased=options.antialiased,
            near_depth=options.near_depth,
        )
        images = native.Images(
            rgb=rgb.data_ptr(),
            differentiable=1,
            depth=depth.data_ptr(),
            alpha=alpha.data_ptr(),
            median_depth=_address(median),
            max_id=_address(max_id),
            features=_address(drawn),
        )
        context.forward(scene, view, images)
        ctx.context, ctx.forward_number = context, context.forward_number
        # The engine reads these arrays again in the backward pass, so they must stay alive even if hooks replace saved tensors.
        ctx.arrays_of_scene = (inputs, features, parts)
        ctx.shape_of_rgb = rgb.shape
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(*(image for image in (median, max_id) if image is not None))
        ctx.save_for_backward(*inputs, poses, features, drawn)
        return rgb, depth, alpha, drawn, median, max_id

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple:  # type: ignore[override]
        *inputs, poses, features, drawn = ctx.saved_tensors
        by_rgb, by_depth, by_alpha, by_features = (
            None if grad is None else grad.contiguous() for grad in grads[:4]
        )
        if by_rgb is None:
            by_rgb = torch.zeros(ctx.shape_of_rgb)
        results = [torch.empty_like(tensor) for tensor in inputs]
        by_poses = torch.empty_like(poses) if ctx.needs_input_grad[-1] else None
        # The engine requires this array also for constant features, which still affect the gradients of the Gaussians.
        result_features = None if features is None else torch.empty_like(features)
        images = native.ImageGradients(
            rgb=by_rgb.data_ptr(),
            depth=_address(by_depth),
            alpha=_address(by_alpha),
            features=_address(by_features),
            drawn_features=_address(drawn),
        )
        gradients = native.SceneGradients(
            features=_address(result_features),
            cam_from_part=_address(by_poses),
            **{name: result.data_ptr() for name, result in zip(_NAMES, results, strict=True)},
        )
        ctx.context.backward(images, gradients, ctx.forward_number)
        return None, None, None, None, result_features, *results, by_poses


def check_tensors(gaussians: GaussianTensors, device: torch.device) -> None:
    """Check that the tensors of Gaussians are float32, on a device and of consistent shapes.

    Rasterizers access memory by address; on a GPU, an invalid index terminates the process.

    Raises:
        TypeError: A tensor is not float32 or not on the device.
        ValueError: The shapes are not consistent.
    """
    count, features, sh = len(gaussians.means), gaussians.features, gaussians.sh
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "logit_opacities": (count,),
        "sh": (count, sh.shape[1] if sh.ndim == 3 else 1, 3),
        "features": None if features is None else (count, features.shape[-1]),
    }
    for name, shape in shapes.items():
        tensor: Tensor | None = getattr(gaussians, name)
        if tensor is None:
            continue
        if tensor.dtype != torch.float32 or tensor.device != device:
            raise TypeError(f"{name}: expected float32 on {device}, got {tensor.dtype} on {tensor.device}")
        if tensor.shape != shape:
            raise ValueError(f"{name} have shape {tuple(tensor.shape)}, expected {shape}")


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None or not tensor.numel() else tensor.data_ptr()
