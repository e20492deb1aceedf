"""Binding of the splatting engine's C interface (cpp/aomgen_splatting.h) through ctypes."""

import ctypes
import threading
from ctypes import POINTER, Structure, c_char_p, c_double, c_float, c_int32, c_int64, c_void_p
from functools import cache
from pathlib import Path

from aomgen.errors import BackendError

# `AOMGEN_ABI_VERSION` of the engine that the structures below describe.
ABI_VERSION = 2
LIBRARY_NAME = "libaomgen_splatting.so"
_REMEDY = "reinstall aomgen, or build in place: cmake -S . -B build && cmake --build build"


class NativeScene(Structure):
    """AomgenScene: pointers to the arrays of N Gaussians."""

    _fields_ = (
        ("count", c_int64),
        ("sh_coefficients", c_int32),
        ("sh_degree", c_int32),
        ("encoded", c_int32),
        ("feature_count", c_int32),
        ("means", c_void_p),
        ("quats", c_void_p),
        ("scales", c_void_p),
        ("opacities", c_void_p),
        ("sh", c_void_p),
        ("features", c_void_p),
        ("parts", c_void_p),
    )


class NativeView(Structure):
    """AomgenView: camera, near depth, background, and a pose for every part of the scene."""

    _fields_ = (
        ("width", c_int32),
        ("height", c_int32),
        ("fx", c_float),
        ("fy", c_float),
        ("cx", c_float),
        ("cy", c_float),
        ("near_depth", c_float),
        ("antialiased", c_int32),
        ("background", c_float * 3),
        ("part_count", c_int32),
        ("cam_from_part", c_void_p),
    )


class Images(Structure):
    """AomgenImages: output arrays of a forward pass."""

    _fields_ = (
        ("rgb", c_void_p),
        ("interleaved", c_int32),
        ("differentiable", c_int32),
        ("depth", c_void_p),
        ("alpha", c_void_p),
        ("median_depth", c_void_p),
        ("max_id", c_void_p),
        ("features", c_void_p),
    )


class ImageGradients(Structure):
    """AomgenImageGradients: gradients of the loss with respect to the images, and the rendered features."""

    _fields_ = tuple((name, c_void_p) for name in ("rgb", "depth", "alpha", "features", "drawn_features"))


class SceneGradients(Structure):
    """AomgenSceneGradients: output arrays of a backward pass; they are packed if `rows` is given."""

    _fields_ = tuple(
        (name, c_void_p)
        for name in ("rows", "means", "quats", "scales", "opacities", "sh", "features", "cam_from_part")
    )


class Frame(Structure):
    """AomgenFrame: poses of the moving parts in one frame of a session, and output arrays."""

    _fields_ = tuple(
        (name, c_void_p)
        for name in ("session", "cam_from_part", "colors", "shade", "tiles")
        + ("rgb8", "rgb", "depth", "alpha", "median_depth", "max_id")
    )


_SIGNATURES = {
    "aomgen_abi_version": (c_int32, ()),
    "aomgen_last_error": (c_char_p, ()),
    "aomgen_instruction_sets": (c_char_p, ()),
    "aomgen_processor_count": (c_int32, ()),
    "aomgen_context_new": (c_void_p, ()),
    "aomgen_context_free": (None, (c_void_p,)),
    "aomgen_context_configure": (c_int32, (c_void_p, c_int32, c_char_p)),
    "aomgen_forward": (c_int32, (c_void_p, POINTER(NativeScene), POINTER(NativeView), POINTER(Images))),
    "aomgen_backward": (c_int32, (c_void_p, POINTER(ImageGradients), POINTER(SceneGradients))),
    "aomgen_contribution_weights": (
        c_int32,
        (c_void_p, POINTER(NativeScene), POINTER(NativeView), c_int32, c_void_p, c_void_p),
    ),
    "aomgen_session_open": (
        c_int32,
        (c_void_p, POINTER(NativeScene), POINTER(NativeView), POINTER(c_void_p)),
    ),
    "aomgen_session_free": (None, (c_void_p,)),
    "aomgen_session_draw": (
        c_int32,
        (c_void_p, POINTER(NativeScene), c_int32, c_int64, c_int32, POINTER(Frame)),
    ),
    "aomgen_image_loss": (
        c_int32,
        (c_void_p, c_int32, c_int32, c_int32, c_void_p, c_void_p, c_void_p, c_float)
        + (POINTER(c_double), c_void_p, c_void_p),
    ),
    "aomgen_adam_step": (c_int32, (c_void_p, c_int64, c_int32, *(c_void_p,) * 5, c_int64)),
    "aomgen_stage_times": (c_int32, (c_void_p, POINTER(c_double))),
    "aomgen_count_pairs": (c_int32, (c_void_p, POINTER(c_int64), POINTER(c_int64))),
    "aomgen_vector_throughput": (c_int32, (c_void_p, POINTER(c_double))),
}


@cache
def library() -> ctypes.CDLL:
    """Return the engine's shared library, which the first call loads.

    Raises:
        BackendError: The library is missing, does not load or has another interface version.
    """
    path = Path(__file__).with_name(LIBRARY_NAME)
    if not path.is_file():
        raise BackendError(path, "the splatting engine is missing", _REMEDY)
    try:
        loaded = ctypes.CDLL(str(path))
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(loaded, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise BackendError(path, f"the splatting engine does not load ({error})", _REMEDY) from error
    version = loaded.aomgen_abi_version()
    if version != ABI_VERSION:
        raise BackendError(
            path, f"the engine has interface version {version}, expected {ABI_VERSION}", _REMEDY
        )
    return loaded


def instruction_sets() -> tuple[str, ...]:
    """List the instruction sets of the engine that this processor supports, fastest first."""
    return tuple(library().aomgen_instruction_sets().decode().split(","))


class Context:
    """Scratch memory and tile lists of one caller; threads must not share a context.

    Args:
        threads: Number of worker threads; None uses all processors available to the process.
        instruction_set: One of `instruction_sets()`; None selects the fastest.

    Raises:
        BackendError: The library cannot be used, or the processor does not support the instruction set.
    """

    def __init__(self, threads: int | None = None, instruction_set: str | None = None) -> None:
        self._library = library()
        # Number of the last forward pass, by which a backward pass identifies its forward pass.
        self.forward_number = 0
        self._handle = self._library.aomgen_context_new()
        if not self._handle:
            raise BackendError("splatting engine", "not enough memory for a context")
        self.configure(threads, instruction_set)

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._library.aomgen_context_free(self._handle)

    def configure(self, threads: int | None = None, instruction_set: str | None = None) -> None:
        """Set the number of threads and the instruction set of later passes; see the class."""
        name = instruction_set.encode() if instruction_set else None
        self._check(self._library.aomgen_context_configure(self._handle, threads or 0, name))

    def forward(self, scene: NativeScene, view: NativeView, images: Images) -> None:
        """Render a scene into `images`."""
        self.forward_number += 1
        self._check(self._library.aomgen_forward(self._handle, scene, view, images))

    def backward(self, images: ImageGradients, gradients: SceneGradients, forward_number: int) -> None:
        """Compute the gradients of the last forward pass of this context, which must have been differentiable.

        Raises:
            BackendError: The last forward pass does not have the number `forward_number`, or the engine fails.
        """
        if forward_number != self.forward_number:
            raise BackendError(
                "splatting engine",
                f"forward pass {forward_number} was overwritten by pass {self.forward_number}",
                "run the backward pass before the context draws again, or use two contexts",
            )
        self._check(self._library.aomgen_backward(self._handle, images, gradients))

    def contribution_weights(
        self, scene: NativeScene, view: NativeView, count: int, masks: int, weights: int
    ) -> None:
        """Compute sums (N, M) of blended weight times mask; `masks` (M, H, W) and `weights` are addresses, `count` is M."""
        self.forward_number += 1
        call = self._library.aomgen_contribution_weights
        self._check(call(self._handle, scene, view, count, masks, weights))

    def open_session(self, scene: NativeScene, view: NativeView) -> int:
        """Open a session and return its handle, which the caller frees by `library().aomgen_session_free`."""
        self.forward_number += 1
        handle = c_void_p()
        self._check(self._library.aomgen_session_open(self._handle, scene, view, handle))
        return handle.value or 0

    def draw_session(
        self, moving: NativeScene, part_count: int, colored_count: int, frames: list[Frame]
    ) -> None:
        """Render frames of sessions; the arrays of scene and frames must stay alive during the call."""
        array = (Frame * len(frames))(*frames)
        call = self._library.aomgen_session_draw
        self._check(call(self._handle, moving, part_count, colored_count, len(frames), array))

    def image_loss(
        self,
        shape: tuple[int, int, int],
        images: tuple[int, int],
        gains: int | None,
        dssim_weight: float,
        gradients: tuple[int, int | None],
    ) -> float:
        """Compute the weighted sum of L1 and D-SSIM of two images, and its gradients.

        Args:
            shape: Shape (channels, H, W) of both planar images.
            images: Addresses of the rendered image and of the target.
            gains: Address of one gain per channel of the rendered image, or None.
            dssim_weight: Weight of D-SSIM, 0..1.
            gradients: Addresses for the gradients with respect to the rendered image and to the gains.
        """
        loss = c_double()
        call = self._library.aomgen_image_loss
        self._check(call(self._handle, *shape, *images, gains, dssim_weight, loss, *gradients))
        return loss.value

    def adam_step(self, shape: tuple[int, int], addresses: tuple[int, ...], step: int) -> None:
        """Perform a step of Adam in place; `step` counts from 1.

        `addresses` are those of values, gradients, first and second moments (rows, columns), and learning rates (columns,).
        """
        self._check(self._library.aomgen_adam_step(self._handle, *shape, *addresses, step))

    def stage_times_ms(self) -> dict[str, float]:
        """Return the wall time of each stage of the last passes, [ms]."""
        times = (c_double * 6)()
        self._check(self._library.aomgen_stage_times(self._handle, times))
        names = ("project", "sort", "bin", "blend", "blend_backward", "project_backward")
        return dict(zip(names, times, strict=True))

    def count_pairs(self) -> tuple[int, int]:
        """Count the (Gaussian, pixel) pairs that the last differentiable forward pass evaluated and blended; slow."""
        evaluated, blended = c_int64(), c_int64()
        self._check(self._library.aomgen_count_pairs(self._handle, evaluated, blended))
        return evaluated.value, blended.value

    def vector_throughput(self) -> float:
        """Measure the fused multiply-adds per second of one thread with the instruction set of this context."""
        result = c_double()
        self._check(self._library.aomgen_vector_throughput(self._handle, result))
        return result.value

    def _check(self, status: int) -> None:
        if status:
            problem = self._library.aomgen_last_error().decode()
            raise BackendError("splatting engine", problem, "check the Gaussians and the camera")


def scratch_context() -> Context:
    """Return the context of the calling thread, which may use it until its next call of this function.

    It is kept until the thread ends, because allocating its memory takes as long as rendering a small image.
    """
    own = _own_of_thread()
    if not hasattr(own, "context"):
        own.context = Context()
    return own.context


@cache
def _own_of_thread() -> threading.local:
    return threading.local()
