"""Depth of views from their neighbours (cpp/plane_sweep.h), and the points that other views confirm, thinned evenly."""

from ctypes import POINTER, Structure, byref, c_float, c_int32, c_void_p
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aomgen.core.camera import Camera
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.errors import BackendError
from aomgen.splatting.native import library
from aomgen.splatting.surfaces import ViewDepth

_STATUS = {1: "refuses its arguments", 2: "is short of memory"}
# Radius of the correlation window, [px]: 5 x 5, smaller than the objects in the reduced views.
WINDOW_RADIUS = 2
# Number of sources that are averaged at a pixel; fewer tolerate more occlusion.
BEST_SOURCES = 2
# Standard deviation of image noise, 0..1: three 8-bit steps.
NOISE = 0.012
# Penalty of a change by one plane between neighboring pixels, in matching cost 0..255: slanted surfaces are common.
SMALL_JUMP_PENALTY = 10.0
# Penalty of a larger change, in matching cost: depth edges are rare.
LARGE_JUMP_PENALTY = 60.0
# Largest difference, in planes, between a depth and that of a view that confirms it.
MAX_PLANES_APART = 1.5
# Least number of neighbors that confirm a depth: a single one may agree by chance.
MIN_CONFIRMATIONS = 2
# Least normalized correlation at a confirmed depth, -1..1: above that of unrelated texture, which is about 0.
MIN_SCORE = 0.25
# Least weight of a cell that contains a point, in pixels.
MIN_WEIGHT = 5.0
# Logarithm to base 2 of the number of bins in which cells are counted.
BIN_BITS = 22


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
    """Compute inverse depth and matching score of every pixel of a view.

    Args:
        reference: Camera and gray image (H, W), 0..1.
        sources: Up to 16 neighbours, images of the same size.
        inverse_depths: (D,) evenly increasing, D <= 256; 0 is infinity.

    Returns:
        Inverse depth (H, W) and correlation at it (H, W), -1..1. Every pixel gets an estimate; the caller
        discards those that no other view confirms.

    Raises:
        BackendError: The engine refuses the inputs or has not enough memory.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthMap:
    """Inverse depth of one view.

    Attributes:
        camera: Camera at the map's resolution, recon frame.
        inverse_depth: (H, W); 0 is infinity.
        score: Correlation at it (H, W), -1..1.
        step: Difference of two adjacent hypotheses in inverse depth.
        neighbours: Indices of the views with which it was matched.
    """

    camera: Camera
    image_srgb: NDArray[np.uint8]
    inverse_depth: NDArray[np.float32]
    score: NDArray[np.float32]
    step: float
    neighbours: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """P points with the quantities that thinning requires.

    Attributes:
        footprints: Size of a pixel at the point (P,), recon units.
        detail: Level of detail (P,) relative to the default, about 0.5..2.
        weights: Number of pixels (P,) that each point represents.
    """

    points_recon: Array
    normals_recon: Array
    colors_srgb: NDArray[np.uint8]
    footprints: Array
    detail: Array
    weights: Array

    def select(self, which: NDArray[np.bool_]) -> "Samples":
        """Select the samples of a mask (P,)."""
        return Samples(**{name: getattr(self, name)[which] for name in SAMPLE_FIELDS})

    def with_points(self, other: "Samples") -> "Samples":
        """Append other samples."""
        return join_samples([self, other])


SAMPLE_FIELDS = tuple(field.name for field in fields(Samples))


def join_samples(parts: list[Samples]) -> Samples:
    """Concatenate samples."""
    return Samples(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in SAMPLE_FIELDS})


def confirm_depth(depth_map: DepthMap, votes: NDArray[np.int32]) -> ViewDepth:
    """Return the depth of a view where its neighbors confirm it (H, W); NaN elsewhere."""
    known = (votes >= MIN_CONFIRMATIONS) & (depth_map.inverse_depth > depth_map.step)
    depth = np.where(known, 1.0 / np.maximum(depth_map.inverse_depth, depth_map.step), np.nan)
    return ViewDepth(camera=depth_map.camera, depth=depth.astype(np.float32))


def confirm_samples(depth_map: DepthMap, votes: NDArray[np.int32]) -> Samples:
    """Return samples of every pixel whose depth at least `MIN_CONFIRMATIONS` neighbours share."""
    keep = (votes >= MIN_CONFIRMATIONS) & (depth_map.score >= MIN_SCORE)
    detail = contrast_detail(depth_map.image_srgb)
    return Samples(
        points_recon=_points(depth_map)[keep],
        normals_recon=normals_recon(depth_map)[keep],
        colors_srgb=depth_map.image_srgb[keep],
        footprints=(1.0 / np.maximum(depth_map.inverse_depth[keep], depth_map.step)) / depth_map.camera.fx,
        detail=detail[keep],
        weights=np.minimum(votes[keep] - 1.0, 2.0).astype(np.float64),
    )


def count_confirmations(depth_map: DepthMap, maps: list[DepthMap]) -> NDArray[np.int32]:
    """Count the neighbors (H, W) whose depth maps agree with each pixel's depth."""
    finite = depth_map.inverse_depth > depth_map.step
    points = _points(depth_map)[finite]
    votes = np.zeros(len(points), np.int32)
    for index in depth_map.neighbours:
        other = maps[index]
        pixels, depths = other.camera.project(points)
        columns, rows = np.floor(pixels).astype(np.int64).T
        inside = (depths > 0) & (columns >= 0) & (rows >= 0)
        inside &= (columns < other.camera.width) & (rows < other.camera.height)
        theirs = other.inverse_depth[rows[inside], columns[inside]]
        tolerance = MAX_PLANES_APART * max(other.step, depth_map.step)
        votes[inside] += np.abs(theirs - 1.0 / depths[inside]) <= tolerance
    result = np.zeros(finite.shape, np.int32)
    result[finite] = votes
    return result


def normals_recon(depth_map: DepthMap) -> Array:
    """Compute unit normals (H, W, 3) towards the camera from smoothed depth."""
    smooth = ndimage.median_filter(depth_map.inverse_depth, size=5)
    smooth = ndimage.gaussian_filter(smooth, 1.5)
    points = depth_map.camera.directions() / np.maximum(smooth, 0.25 * depth_map.step)[..., None]
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    facing = (normals * depth_map.camera.directions()).sum(-1, keepdims=True)
    return np.where(facing > 0, -normals, normals)


def thin(samples: Samples, target: int, *, min_weight: float = MIN_WEIGHT) -> Samples:
    """Thin samples to about `target`: one for each cell, whose size is proportional to the footprints of its points.

    A cell's point and color are the means of its samples, which also averages depth noise. A surface has many samples in a
    cell, a wrong match has few: cells with less than `min_weight` are dropped. The footprints of the result are the
    lengths of the cells' edges.
    """
    wanted = samples.footprints / samples.detail
    low, high = 0.5, 30.0
    for _ in range(10):
        factor = np.sqrt(low * high)
        # The counts may be approximate: it does not matter that a few cells share a bin.
        bins = (_cell_keys(samples.points_recon, wanted * factor) >> np.uint64(64 - BIN_BITS)).astype(
            np.int64
        )
        totals = np.bincount(bins, samples.weights, 1 << BIN_BITS)
        if (totals >= min_weight).sum() > target:
            low = factor
        else:
            high = factor
    keys = _cell_keys(samples.points_recon, wanted * high)
    cells = np.unique(keys, return_inverse=True)[1].reshape(-1)
    totals = np.bincount(cells, samples.weights)
    keep = totals >= min_weight

    def mean(values: Array) -> Array:
        sums = [np.bincount(cells, values[:, k] * samples.weights) for k in range(values.shape[1])]
        return (np.stack(sums, 1) / np.maximum(totals, 1e-9)[:, None])[keep]

    normals = mean(samples.normals_recon)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Samples(
        points_recon=mean(samples.points_recon),
        normals_recon=np.where(length > 0.5, normals / np.maximum(length, 1e-12), 0.0),
        colors_srgb=np.round(mean(samples.colors_srgb.astype(np.float64))).astype(np.uint8),
        footprints=mean(wanted[:, None] * high)[:, 0],
        detail=np.ones(int(keep.sum())),
        weights=totals[keep].astype(np.float64),
    )


def contrast_detail(image_srgb: NDArray[np.uint8]) -> Array:
    """Compute the level of detail (H, W), 0.45..1.8, at each pixel: about the root of the local contrast."""
    gray = image_srgb.mean(-1)
    contrast = ndimage.gaussian_filter(ndimage.gaussian_gradient_magnitude(gray, 0.8), 1.5)
    return np.clip(np.sqrt(contrast / 6.0), 0.45, 1.8)


def _points(depth_map: DepthMap) -> Array:
    inverse = np.maximum(depth_map.inverse_depth, 0.25 * depth_map.step)
    rays_cam = depth_map.camera.move(np.eye(4)).directions()
    return apply(depth_map.camera.T_world_cam, rays_cam / inverse[..., None])


def _cell_keys(points: Array, sizes: Array) -> NDArray[np.uint64]:
    """Key (P,) of each point's cell in nested cubic grids; each point uses the grid nearest its size."""
    level = np.round(np.log2(np.maximum(sizes, 1e-12)) * 2).astype(np.int64)
    edge = 2.0 ** (level / 2)
    keys = np.concatenate([level[:, None], np.floor(points / edge[:, None]).astype(np.int64)], 1)
    # A 64-bit hash is a hundred times faster than sorting rows, for millions of samples.
    mixed = np.zeros(len(keys), np.uint64)
    for column in range(4):
        mixed = (mixed ^ keys[:, column].astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return mixed
