"""Rendering of Gaussians on the CPU, without gradients."""

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

# Accumulated alpha up to which a pixel has no depth.
MIN_ALPHA = 1e-3
# Longest side of an image, [px]; the engine's indices support this size.
MAX_SIDE = 16384
# Gaussians at or before this depth are not rendered, [m].
NEAR_DEPTH = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Rendering:
    """Images of one camera.

    Attributes:
        rgb: Colors (H, W, 3), sRGB 0..1, blended over the background.
        alpha: Accumulated alpha (H, W), 0..1.
        depth: Blended depth divided by alpha (H, W), [m]; 0 where alpha is at most `MIN_ALPHA`.
        median_depth: Depth of the Gaussian that reduces the transmittance below one half (H, W), [m]; 0 if it remains
            above. None without `with_ids`.
        max_id: Index of the Gaussian with the largest weight (H, W), -1 for none. None without `with_ids`.
        features: Blended features (H, W, D), not divided by alpha. None without features.
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32] | None = None
    max_id: NDArray[np.int32] | None = None
    features: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidParts:
    """Rigid parts of a set of Gaussians; each Gaussian is given in the frame of its part.

    Attributes:
        indices: Part of each Gaussian (N,), 0..P-1.
        Ts_world_part: Rigid poses of the parts (P, 4, 4).
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
    """Render Gaussians; the result is bitwise equal for any number of threads.

    Gaussians with NaN or infinite values are omitted.

    Args:
        gaussians: Gaussians in the world frame of the camera, or in the frames of `parts`.
        camera: Camera of the image.
        background: sRGB color 0..1 behind the Gaussians.
        features: Features (N, D), which are blended like colors.
        parts: Parts of the Gaussians; view-dependent colors rotate with them.
        antialiased: Reduce the opacity of Gaussians smaller than a pixel, as Mip-Splatting does.
        with_ids: Also compute median depth and the Gaussian with the largest weight.
        threads: Number of threads; None uses all processors available to the process.

    Raises:
        BackendError: The engine is missing, or refuses the scene or camera.
        ValueError: Features or parts do not match the number of Gaussians.
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
    """Compute the contribution of each Gaussian to each mask.

    Args:
        gaussians: N Gaussians in the world frame of the camera.
        camera: Camera of the masks.
        masks: Masks (M, H, W) of any real values, M >= 1.

    Returns:
        Sums over the pixels of blended weight times mask value (N, M).

    Raises:
        BackendError: The engine is missing, or refuses the scene or camera.
        ValueError: The masks do not have the size of the camera.
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
    """Allocate the arrays of a `Rendering`, by name, as output arrays of the engine."""
    shape = image_shape(camera)
    images: dict[str, NDArray] = {"rgb": np.empty((*shape, 3), np.float32)}
    images |= {name: np.empty(shape, np.float32) for name in ("alpha", "depth")}
    if with_ids:
        images["median_depth"] = np.empty(shape, np.float32)
        images["max_id"] = np.empty(shape, np.int32)
    return images


def addresses_of(arrays: Mapping[str, NDArray]) -> dict[str, int]:
    """Return the addresses of arrays, by name; arrays without elements are omitted."""
    return {name: array.ctypes.data for name, array in arrays.items() if array.size}


def settle(images: Mapping[str, NDArray]) -> None:
    """Convert the engine's sums to the values of `Rendering` in place: limit colors to 1, divide depth by alpha."""
    rgb, alpha, depth = (images[name] for name in ("rgb", "alpha", "depth"))
    np.minimum(rgb, 1, out=rgb)
    np.divide(depth, alpha, out=depth, where=alpha > MIN_ALPHA)
    depth[~(alpha > MIN_ALPHA)] = 0


def image_shape(camera: Camera) -> tuple[int, int]:
    """Return height and width of a camera's images, [px].

    Raises:
        BackendError: A side is outside 1..`MAX_SIDE`.
    """
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
    """Build the engine's description of Gaussians; it refers to the arrays, which must outlive it."""
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
    """Compute the upper rows (P, 3, 4) of the transforms from each part to the camera; without parts, from the world (P = 1)."""
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
    """Build the engine's description of a camera; it refers to `poses` (P, 3, 4), see `cam_from_parts`, which must outlive it."""
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
