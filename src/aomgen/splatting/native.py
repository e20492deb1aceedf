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
    """AomgenImages: where a forward pass writes."""

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
    """AomgenImageGradients: the loss's gradients by the images, and the features as drawn."""

    _fields_ = tuple((name, c_void_p) for name in ("rgb", "depth", "alpha", "features", "drawn_features"))


class SceneGradients(Structure):
    """AomgenSceneGradients: where a backward pass writes; packed rows if `rows` is given."""

    _fields_ = tuple(
        (name, c_void_p)
        for name in ("rows", "means", "quats", "scales", "opacities", "sh", "features", "cam_from_part")
    )


class Frame(Structure):
    """AomgenFrame: poses of what moves in one frame of a session, and where it is drawn."""

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
    "aomgen_counts": (c_int32, (c_void_p, POINTER(c_int64), POINTER(c_int64))),
}


@cache
def library() -> ctypes.CDLL:
    """The engine's shared library, loaded on the first call.

    Raises:
        BackendError: It is missing, does not load or belongs to another version.
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
    """Instruction sets of the engine that this machine can run, best first."""
    return tuple(library().aomgen_instruction_sets().decode().split(","))


class Context:
    """Scratch memory and tile lists of one caller; not to be shared between threads.

    Args:
        threads: Worker threads, None for all processors of the process.
        instruction_set: One of `instruction_sets()`, None for the best.

    Raises:
        BackendError: The library is unusable, or the machine lacks the instruction set.
    """

    def __init__(self, threads: int | None = None, instruction_set: str | None = None) -> None:
        self._library = library()
        self.forward_number = 0  # of the last pass, so that a backward pass can name its forward pass
        self._handle = self._library.aomgen_context_new()
        if not self._handle:
            raise BackendError("splatting engine", "not enough memory for a context")
        self.configure(threads, instruction_set)

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._library.aomgen_context_free(self._handle)

    def configure(self, threads: int | None = None, instruction_set: str | None = None) -> None:
        """Choose threads and instruction set for the passes that follow."""
        name = instruction_set.encode() if instruction_set else None
        self._check(self._library.aomgen_context_configure(self._handle, threads or 0, name))

    def forward(self, scene: NativeScene, view: NativeView, images: Images) -> None:
        """Draw the scene."""
        self.forward_number += 1
        self._check(self._library.aomgen_forward(self._handle, scene, view, images))

    def backward(self, images: ImageGradients, gradients: SceneGradients, forward_number: int) -> None:
        """Gradients of the last differentiable forward pass of this context, which must be the numbered one."""
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
        """Sums of weight times mask; `masks` and `weights` are addresses."""
        self.forward_number += 1
        call = self._library.aomgen_contribution_weights
        self._check(call(self._handle, scene, view, count, masks, weights))

    def open_session(self, scene: NativeScene, view: NativeView) -> int:
        """Handle of a new session, for `library().aomgen_session_free`."""
        self.forward_number += 1
        handle = c_void_p()
        self._check(self._library.aomgen_session_open(self._handle, scene, view, handle))
        return handle.value or 0

    def draw_session(
        self, moving: NativeScene, part_count: int, colored_count: int, frames: list[Frame]
    ) -> None:
        """Draw frames of sessions, whose arrays must stay alive."""
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
        """Fused L1 and D-SSIM of planar images of a shape (channels, H, W); arguments are addresses."""
        loss = c_double()
        call = self._library.aomgen_image_loss
        self._check(call(self._handle, *shape, *images, gains, dssim_weight, loss, *gradients))
        return loss.value

    def adam_step(self, shape: tuple[int, int], addresses: tuple[int, ...], step: int) -> None:
        """Adam in place; addresses of values, gradients, means, squares (rows, columns), rates (columns,)."""
        self._check(self._library.aomgen_adam_step(self._handle, *shape, *addresses, step))

    def stage_times_ms(self) -> dict[str, float]:
        """Wall time of the last passes by stage, [ms]."""
        times = (c_double * 6)()
        self._check(self._library.aomgen_stage_times(self._handle, times))
        names = ("project", "sort", "bin", "blend", "blend_backward", "project_backward")
        return dict(zip(names, times, strict=True))

    def counts(self) -> tuple[int, int]:
        """Gaussians in view and (Gaussian, tile) pairs of the last forward pass."""
        visible, intersections = c_int64(), c_int64()
        self._check(self._library.aomgen_counts(self._handle, visible, intersections))
        return visible.value, intersections.value

    def count_pairs(self) -> tuple[int, int]:
        """(Gaussian, pixel) pairs that the last differentiable forward pass computed, and those it drew; slow."""
        evaluated, blended = c_int64(), c_int64()
        self._check(self._library.aomgen_count_pairs(self._handle, evaluated, blended))
        return evaluated.value, blended.value

    def vector_throughput(self) -> float:
        """Fused multiply-adds per second of one thread in this instruction set, measured."""
        result = c_double()
        self._check(self._library.aomgen_vector_throughput(self._handle, result))
        return result.value

    def _check(self, status: int) -> None:
        if status:
            problem = self._library.aomgen_last_error().decode()
            raise BackendError("splatting engine", problem, "check the Gaussians and the camera")


def scratch_context() -> Context:
    """A context that the calling thread may use until its next call of this function.

    It is kept until the thread ends, because allocating its memory costs as much as a small frame.
    """
    own = _own_of_thread()
    if not hasattr(own, "context"):
        own.context = Context()
    return own.context


@cache
def _own_of_thread() -> threading.local:
    return threading.local()
