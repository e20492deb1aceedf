"""Gaussians to images on the CPU, without gradients."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import BackendError
from aomgen.splatting import native

# Accumulated alpha below which a pixel has no depth.
MIN_ALPHA = 1e-3
# Longest side of an image, [px]; the engine's indices hold it.
MAX_SIDE = 16384
# Gaussians nearer to the camera than this are not drawn, [m].
NEAR_DEPTH = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Rendering:
    """Images of one camera.

    Attributes:
        rgb: (H, W, 3), sRGB 0..1, blended over the background.
        alpha: (H, W), 0..1.
        depth: (H, W), blended depth divided by alpha, [m]; 0 where alpha is about 0.
        median_depth: (H, W), depth of the Gaussian at which less than half of the light is left,
            [m]; 0 where half is never reached. Only with `with_ids`.
        max_id: (H, W), index of the Gaussian with the largest weight, -1 for none. Only with `with_ids`.
        features: (H, W, D), blended (not divided by alpha). Only with features.
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32] | None = None
    max_id: NDArray[np.int32] | None = None
    features: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidParts:
    """Gaussians that move in rigid groups: each is given in the frame of its part.

    Attributes:
        indices: Part of every Gaussian, 0..P-1.
        Ts_world_part: Rigid poses of the parts.
    """

    indices: Annotated[NDArray[np.int32], "_"]
    Ts_world_part: Annotated[Array, "_ 4 4"]

    __post_init__ = freeze_arrays


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    features: NDArray[np.float32] | None = None,
    parts: RigidParts | None = None,
    antialiased: bool = False,
    with_ids: bool = False,
    threads: int | None = None,
) -> Rendering:
    """Draw Gaussians; bitwise the same for any number of threads.

    Gaussians with NaN or infinite values are left out.

    Args:
        gaussians: In the frame that `camera.T_world_cam` maps to, or in the frames of `parts`.
        camera: Camera of the image.
        background: sRGB color 0..1 behind everything.
        features: (N, D) values to blend like colors.
        parts: Poses of the scene's parts; their view-dependent colors turn along.
        antialiased: Lower the opacity of Gaussians smaller than a pixel, as Mip-Splatting does.
        with_ids: Also give median depth and the most contributing Gaussian.
        threads: None for all processors of the process.

    Raises:
        BackendError: The engine is missing, or refuses the scene or camera.
    """
    images = empty_images(camera, with_ids)
    if features is not None:
        features = np.ascontiguousarray(features, np.float32)
        if features.ndim != 2 or len(features) != len(gaussians):
            raise ValueError(f"features have shape {features.shape}, expected ({len(gaussians)}, D)")
        images["features"] = np.empty((*images["depth"].shape, features.shape[1]), np.float32)
    poses = cam_from_parts(camera, parts)
    view = native_view(camera, poses, background=background, antialiased=antialiased)
    context = native.scratch_context()
    context.configure(threads)
    outputs = native.Images(interleaved=1, **addresses_of(images))
    context.forward(native_scene(gaussians, features, parts), view, outputs)
    settle(images)
    return Rendering(**images)


def contribution_weights(
    gaussians: Gaussians, camera: Camera, masks: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Contribution of each Gaussian to every mask: sums (N, M) of blended weight times mask value.

    Args:
        gaussians: N Gaussians.
        camera: View of the masks.
        masks: (M, H, W), any real values, 1 <= M.

    Raises:
        BackendError: The engine is missing, or refuses the scene or camera.
    """
    masks = np.ascontiguousarray(masks, np.float32)
    if masks.ndim != 3 or masks.shape[1:] != (camera.height, camera.width):
        raise ValueError(f"masks have shape {masks.shape}, expected (M, {camera.height}, {camera.width})")
    weights = np.zeros((len(gaussians), len(masks)), np.float32)
    context = native.scratch_context()
    context.configure()
    poses = cam_from_parts(camera)
    scene, view = native_scene(gaussians), native_view(camera, poses)
    context.contribution_weights(scene, view, len(masks), masks.ctypes.data, weights.ctypes.data)
    return weights


def empty_images(camera: Camera, with_ids: bool) -> dict[str, NDArray]:
    """The arrays of a `Rendering` by name, for the engine to write into."""
    shape = image_shape(camera)
    images: dict[str, NDArray] = {"rgb": np.empty((*shape, 3), np.float32)}
    images |= {name: np.empty(shape, np.float32) for name in ("alpha", "depth")}
    if with_ids:
        images["median_depth"] = np.empty(shape, np.float32)
        images["max_id"] = np.empty(shape, np.int32)
    return images


def addresses_of(arrays: Mapping[str, NDArray]) -> dict[str, int]:
    """Addresses of the arrays, those without elements left out."""
    return {name: array.ctypes.data for name, array in arrays.items() if array.size}


def settle(images: Mapping[str, NDArray]) -> None:
    """In place, from the engine's sums to what `Rendering` holds: colors up to 1, depth divided by alpha."""
    rgb, alpha, depth = (images[name] for name in ("rgb", "alpha", "depth"))
    np.minimum(rgb, 1, out=rgb)
    np.divide(depth, alpha, out=depth, where=alpha > MIN_ALPHA)
    depth[~(alpha > MIN_ALPHA)] = 0


def image_shape(camera: Camera) -> tuple[int, int]:
    """Height and width of a camera's images, refused before anyone allocates more than `MAX_SIDE` pixels a side."""
    shape = (camera.height, camera.width)
    if not all(1 <= side <= MAX_SIDE for side in shape):
        raise BackendError(
            "splatting engine",
            f"an image of {camera.width} x {camera.height} pixels cannot be drawn, limit 1 to {MAX_SIDE}",
            "check the camera's width and height",
        )
    return shape


def native_scene(
    gaussians: Gaussians, features: NDArray[np.float32] | None = None, parts: RigidParts | None = None
) -> native.NativeScene:
    """The engine's view of arrays, which must stay alive while it is used."""
    if parts is not None and len(parts.indices) != len(gaussians):
        raise ValueError(f"{len(parts.indices)} part indices for {len(gaussians)} Gaussians")
    return native.NativeScene(
        count=len(gaussians),
        sh_coefficients=gaussians.sh.shape[1],
        sh_degree=gaussians.sh_degree,
        feature_count=0 if features is None else features.shape[1],
        means=gaussians.means.ctypes.data,
        quats=gaussians.quats.ctypes.data,
        scales=gaussians.scales.ctypes.data,
        opacities=gaussians.opacities.ctypes.data,
        sh=gaussians.sh.ctypes.data,
        features=None if features is None else features.ctypes.data,
        parts=None if parts is None else parts.indices.ctypes.data,
    )


def cam_from_parts(camera: Camera, parts: RigidParts | None = None) -> NDArray[np.float32]:
    """Upper rows (P, 3, 4) of the transforms from each part, or from the world, to the camera."""
    Ts = camera.T_cam_world[None] if parts is None else camera.T_cam_world @ parts.Ts_world_part
    return np.ascontiguousarray(Ts[:, :3], np.float32)


def native_view(
    camera: Camera,
    poses: NDArray[np.float32],
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    antialiased: bool = False,
    near_depth: float = NEAR_DEPTH,
) -> native.NativeView:
    """The engine's view of a camera; `poses` (P, 3, 4) must stay alive while it is used."""
    height, width = image_shape(camera)
    return native.NativeView(
        width=width,
        height=height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        near_depth=near_depth,
        antialiased=antialiased,
        background=tuple(float(value) for value in background),
        part_count=len(poses),
        cam_from_part=poses.ctypes.data,
    )
