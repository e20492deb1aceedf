"""Rendering of many frames from a fixed camera: static Gaussians are rendered once, then only tiles that change.

A frame equals `render` of static and moving Gaussians together.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array, freeze_arrays
from aomgen.splatting import native
from aomgen.splatting.rasterizer import (
    Rendering,
    RigidParts,
    addresses_of,
    cam_from_parts,
    empty_images,
    native_scene,
    native_view,
    settle,
)

# Side of the engine's tiles, [px].
TILE = 16
# Additional axes of outputs with several channels, and element types of the outputs.
_CHANNELS = {"rgb8": (3,)}
_TYPES = {"rgb8": np.uint8, "alpha": np.float32, "median_depth": np.float32, "max_id": np.int32}


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Poses and colors of moving Gaussians in T frames.

    Attributes:
        parts: Part of each moving Gaussian (N,), 0..P-1; each Gaussian is given in the frame of its part.
        Ts_world_part: Rigid poses of the parts (T, P, 4, 4).
        colors: sRGB colors (T, M, 3) of the last M moving Gaussians, which replace the constant terms of their spherical
            harmonics; None changes no colors.
    """

    parts: Annotated[NDArray[np.int32], "_"]
    Ts_world_part: Annotated[Array, "T P 4 4"]
    colors: Annotated[NDArray[np.float32], "T M 3"] | None = None

    __post_init__ = freeze_arrays

    def __len__(self) -> int:
        return len(self.Ts_world_part)


class RenderSession:
    """Rendering of static Gaussians by a static camera; it is immutable, and any number of threads may share it.

    Args:
        static: Static Gaussians, world frame.
        camera: Static camera.
        background: sRGB color 0..1 behind the Gaussians.
        antialiased: See `render`.
        threads: Number of threads of all methods; None uses all processors available to the process.
        instruction_set: Instruction set of this rendering, one of `native.instruction_sets()`; None selects the fastest.

    Raises:
        BackendError: The engine is missing, or refuses the scene or camera.
    """

    def __init__(
        self,
        static: Gaussians,
        camera: Camera,
        *,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        antialiased: bool = False,
        threads: int | None = None,
        instruction_set: str | None = None,
    ) -> None:
        self._library = native.library()
        self.camera = camera
        self.threads = threads
        self._handle = 0
        poses = cam_from_parts(camera)
        view = native_view(camera, poses, background=background, antialiased=antialiased)
        context = native.scratch_context()
        context.configure(threads, instruction_set)
        self._handle = context.open_session(native_scene(static), view)

    def __del__(self) -> None:
        if getattr(self, "_handle", 0):
            self._library.aomgen_session_free(self._handle)

    def draw(
        self,
        moving: Gaussians,
        parts: RigidParts | None = None,
        *,
        shade: NDArray[np.float32] | None = None,
        with_ids: bool = False,
    ) -> Rendering:
        """Render one frame with all threads; it equals `render` of static and moving Gaussians together.

        Args:
            moving: Moving Gaussians in the world frame, or in the frames of `parts`.
            parts: Parts of the moving Gaussians; view-dependent colors rotate with them.
            shade: Factor (H, W) on the sRGB colors of static Gaussians and background, for shadows.
            with_ids: Also compute median depth and the Gaussian with the largest weight; indices of moving Gaussians follow
                those of static ones.

        Raises:
            BackendError: The engine refuses the Gaussians.
            ValueError: `shade` or `parts` has the wrong shape.
        """
        images = empty_images(self.camera, with_ids)
        self._draw_one(moving, parts, shade, {**images, "tiles": self._unknown_tiles(1)})
        settle(images)
        return Rendering(**images)

    def picture(
        self,
        moving: Gaussians,
        parts: RigidParts | None = None,
        *,
        shade: NDArray[np.float32] | None = None,
        into: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None,
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Render one 8-bit image with all threads.

        Args:
            moving: See `draw`.
            parts: See `draw`.
            shade: See `draw`.
            into: Earlier result of this session to overwrite. Only changed tiles are written, which is faster than
                rendering to a new image.

        Returns:
            Image (H, W, 3), and flags (ceil(H / 16), ceil(W / 16)): 1 for the tiles of 16 x 16 pixels that differ from the
            rendering of the static Gaussians.

        Raises:
            BackendError: The engine refuses the Gaussians.
            ValueError: An array has the wrong shape or type.
        """
        shape = (self.camera.height, self.camera.width, 3)
        if into is None:
            into = np.empty(shape, np.uint8), self._unknown_tiles(1)[0]
        image_srgb, changed = into
        for array, want in ((image_srgb, shape), (changed, self._unknown_tiles(1).shape[1:])):
            if array.shape != want or array.dtype != np.uint8 or not array.flags.c_contiguous:
                raise ValueError(
                    f"the image has shape {array.shape} of {array.dtype}, expected {want} of uint8"
                )
        self._draw_one(moving, parts, shade, {"rgb8": image_srgb, "tiles": changed})
        return into

    def draw_many(
        self,
        moving: Gaussians,
        motion: Motion,
        shades: NDArray[np.float32] | None = None,
    ) -> NDArray[np.uint8]:
        """Render frames (T, H, W, 3) uint8, sRGB, each by one thread; see `draw_outputs`.

        Args:
            moving: N Gaussians in the frames of their parts.
            motion: Poses of the parts in each frame.
            shades: Factors (T, H, W), see `shade` of `draw`.
        """
        (images,) = draw_outputs([self], moving, motion, ("rgb8",), [shades], self.threads)
        return images["rgb8"]

    def _unknown_tiles(self, frames: int) -> NDArray[np.uint8]:
        rows, columns = -(-self.camera.height // TILE), -(-self.camera.width // TILE)
        return np.ones((frames, rows, columns), np.uint8)

    def _draw_one(
        self,
        moving: Gaussians,
        parts: RigidParts | None,
        shade: ArrayLike | None,
        outputs: dict[str, NDArray],
    ) -> None:
        poses = cam_from_parts(self.camera, parts)
        inputs = {"cam_from_part": poses}
        if shade is not None:
            inputs["shade"] = self._check_shades(shade, ())
        context = native.scratch_context()
        context.configure(self.threads)
        frame = native.Frame(session=self._handle, **addresses_of(inputs | outputs))
        context.draw_session(native_scene(moving, parts=parts), len(poses), 0, [frame])

    def _check_shades(self, shades: ArrayLike, leading: tuple[int, ...]) -> NDArray[np.float32]:
        shades = np.ascontiguousarray(shades, np.float32)
        want = (*leading, self.camera.height, self.camera.width)
        if shades.shape != want:
            raise ValueError(f"shade has shape {shades.shape}, expected {want}")
        return shades

    def _frames(
        self, motion: Motion, shades: ArrayLike | None, outputs: Sequence[str]
    ) -> tuple[dict[str, NDArray], list[native.Frame], dict[str, NDArray]]:
        """Allocate images; return them, the engine's frames that refer to them, and all arrays that must stay alive."""
        shape = (len(motion), self.camera.height, self.camera.width)
        images = {name: np.empty(shape + _CHANNELS.get(name, ()), _TYPES[name]) for name in outputs}
        Ts = self.camera.T_cam_world @ motion.Ts_world_part
        arrays = images | {
            "cam_from_part": np.ascontiguousarray(Ts[:, :, :3], np.float32),
            "tiles": self._unknown_tiles(len(motion)),
        }
        if motion.colors is not None:
            arrays["colors"] = motion.colors
        if shades is not None:
            arrays["shade"] = self._check_shades(shades, shape[:1])
        starts = addresses_of(arrays)
        steps = {name: arrays[name].strides[0] for name in starts}
        frames = [
            native.Frame(
                session=self._handle, **{name: start + t * steps[name] for name, start in starts.items()}
            )
            for t in range(len(motion))
        ]
        return images, frames, arrays


def draw_outputs(
    sessions: Sequence[RenderSession],
    moving: Gaussians,
    motion: Motion,
    outputs: Sequence[str],
    shades: Sequence[NDArray[np.float32] | None] | None = None,
    threads: int | None = None,
) -> list[dict[str, NDArray]]:
    """Render frames of several sessions, distributed over threads.

    Args:
        sessions: Sessions; their static Gaussians may differ.
        moving: N Gaussians in the frames of their parts.
        motion: Poses of the parts in each frame.
        outputs: Some of "rgb8", "alpha", "median_depth" and "max_id"; the last two require each other.
        shades: Factors (T, H, W) of each session, see `RenderSession.draw`, or None.
        threads: Number of threads; None uses all processors available to the process.

    Returns:
        Arrays (T, H, W, ...) by output, for each session.

    Raises:
        BackendError: The engine refuses the Gaussians.
        ValueError: `motion` does not match `moving`, or an array of `shades` has the wrong shape.
    """
    if len(motion.parts) != len(moving):
        raise ValueError(f"{len(motion.parts)} part indices for {len(moving)} Gaussians")
    colored = 0 if motion.colors is None else motion.colors.shape[1]
    drawn = [
        session._frames(motion, None if shades is None else shades[i], outputs)
        for i, session in enumerate(sessions)
    ]
    scene = native_scene(moving)
    scene.parts = motion.parts.ctypes.data
    context = native.scratch_context()
    context.configure(threads)
    frames = [frame for _, frames, _ in drawn for frame in frames]
    context.draw_session(scene, motion.Ts_world_part.shape[1], colored, frames)
    return [images for images, _, _ in drawn]
