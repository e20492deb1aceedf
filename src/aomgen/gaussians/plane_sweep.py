"""Dense inverse depth of one view from its neighbours (cpp/plane_sweep.h)."""

from ctypes import POINTER, Structure, byref, c_float, c_int32, c_void_p
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.errors import BackendError
from aomgen.splatting.native import library

_STATUS = {1: "refuses its arguments", 2: "is short of memory"}
# Radius of the correlation window, [px]: 5 x 5, small against the objects at the width of the views.
WINDOW_RADIUS = 2
# Sources averaged at a pixel: fewer tolerate more occlusion.
BEST_SOURCES = 2
# Standard deviation of image noise, 0..1: three 8-bit steps.
NOISE = 0.012
# Penalty of a change by one plane between neighbours, in matching cost 0..255: slanted surfaces are common.
SMALL_JUMP_PENALTY = 10.0
# Penalty of a larger change, in matching cost: depth edges are rare.
LARGE_JUMP_PENALTY = 60.0


class _Sweep(Structure):
    _fields_ = (
        ("width", c_int32),
        ("height", c_int32),
        ("source_count", c_int32),
        ("plane_count", c_int32),
        ("reference", c_void_p),
        ("sources", c_void_p),
        ("rotations", c_void_p),
        ("translations", c_void_p),
        ("first_inverse_depth", c_float),
        ("inverse_depth_step", c_float),
        ("window_radius", c_int32),
        ("best_sources", c_int32),
        ("noise", c_float),
        ("small_jump_penalty", c_float),
        ("large_jump_penalty", c_float),
    )


def plane_sweep(
    reference: tuple[Camera, NDArray[np.float32]],
    sources: list[tuple[Camera, NDArray[np.float32]]],
    inverse_depths: Array,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Inverse depth and matching score of every pixel of a view.

    Args:
        reference: Camera and gray image (H, W), 0..1.
        sources: Up to 16 neighbours, images of the same size.
        inverse_depths: (D,) evenly increasing, D <= 256; 0 is infinity.

    Returns:
        Inverse depth (H, W) and correlation at it (H, W), -1..1. Every pixel gets an answer; what
        no other view confirms is for the caller to discard.

    Raises:
        BackendError: The engine refuses or is short of memory.
    """
    camera, image = reference
    height, width = image.shape
    stack = np.ascontiguousarray(np.stack([gray for _, gray in sources]), np.float32)
    turns = [source.T_cam_world @ camera.T_world_cam for source, _ in sources]
    K_inverse = np.linalg.inv(camera.K)
    rotations = np.ascontiguousarray(
        [source.K @ T[:3, :3] @ K_inverse for T, (source, _) in zip(turns, sources, strict=True)], np.float32
    )
    translations = np.ascontiguousarray(
        [source.K @ T[:3, 3] for T, (source, _) in zip(turns, sources, strict=True)], np.float32
    )
    gray = np.ascontiguousarray(image, np.float32)
    sweep = _Sweep(
        width=width,
        height=height,
        source_count=len(sources),
        plane_count=len(inverse_depths),
        reference=gray.ctypes.data,
        sources=stack.ctypes.data,
        rotations=rotations.ctypes.data,
        translations=translations.ctypes.data,
        first_inverse_depth=float(inverse_depths[0]),
        inverse_depth_step=float(inverse_depths[1] - inverse_depths[0]),
        window_radius=WINDOW_RADIUS,
        best_sources=min(BEST_SOURCES, len(sources)),
        noise=NOISE,
        small_jump_penalty=SMALL_JUMP_PENALTY,
        large_jump_penalty=LARGE_JUMP_PENALTY,
    )
    inverse_depth = np.empty((height, width), np.float32)
    score = np.empty((height, width), np.float32)
    status = _function()(byref(sweep), inverse_depth.ctypes.data, score.ctypes.data)
    if status != 0:
        raise BackendError("plane sweep", _STATUS.get(status, f"fails with status {status}"))
    return inverse_depth, score


def _function() -> Any:
    function = library().aomgen_plane_sweep
    function.restype, function.argtypes = c_int32, (POINTER(_Sweep), c_void_p, c_void_p)
    return function
