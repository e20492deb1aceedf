"""Boxes around the two parts and their edges."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.transforms import apply, invert, transform
from aomgen.core.values import Array, freeze
from aomgen.errors import InputError

# Yaws tried over a quarter turn, half a degree apart: finer than a scanned footprint tells its yaw.
_YAW_STEPS = 180
# Points beyond this percentile on either side are strays, [%].
TAIL_PERCENT = 1.0
# Fewer points have no box.
MIN_POINTS = 20
# Points on each edge between which distances are taken; the score is their mean.
_EDGE_SAMPLES = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class OrientedBox:
    """An upright box: its third axis is the world's z.

    Attributes:
        T_world_box: Centre and axes (4, 4).
        half_extents: (3,), [m].
    """

    T_world_box: Array
    half_extents: Array

    def __post_init__(self) -> None:
        freeze(self, "T_world_box", self.T_world_box, (4, 4))
        freeze(self, "half_extents", self.half_extents, (3,))

    @property
    def diagonal_m(self) -> float:
        """Length of the space diagonal, [m]."""
        return float(2 * np.linalg.norm(self.half_extents))

    def edges(self) -> Array:
        """End points (12, 2, 3) of the twelve edges, world frame, [m]."""
        ends = []
        for along in range(3):
            first, second = (axis for axis in range(3) if axis != along)
            for sign_first, sign_second in product((-1.0, 1.0), repeat=2):
                corner = np.zeros(3)
                corner[first], corner[second] = sign_first, sign_second
                step = np.eye(3)[along]
                ends.append([corner - step, corner + step])
        return apply(self.T_world_box, np.array(ends) * self.half_extents)


def find_footprint_yaw(points_world: Array) -> float:
    """Yaw of the smallest upright rectangle around points (N, 3), [rad], in 0..pi/2.

    Extents are taken between the 1st and 99th percentile, so that stray points do not count.
    """
    yaws = np.arange(_YAW_STEPS) * (np.pi / 2 / _YAW_STEPS)
    areas = []
    for yaw in yaws:
        c, s = np.cos(yaw), np.sin(yaw)
        turned = points_world[:, :2] @ np.array([[c, -s], [s, c]])
        low, high = np.percentile(turned, [TAIL_PERCENT, 100 - TAIL_PERCENT], axis=0)
        areas.append(np.prod(high - low))
    return float(yaws[int(np.argmin(areas))])


def fit_upright_box(points_world: Array, yaw: float) -> OrientedBox:
    """Box with the given yaw around points (N, 3), world frame, tails of one percent cut.

    Raises:
        InputError: Fewer than 20 points.
    """
    if not len(points_world) >= MIN_POINTS:
        raise InputError(
            "part points", f"{len(points_world)} points, need {MIN_POINTS}", "correct the prompts"
        )
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    local = points_world @ R
    low, high = np.percentile(local, [TAIL_PERCENT, 100 - TAIL_PERCENT], axis=0)
    return OrientedBox(
        T_world_box=transform(R, R @ ((low + high) / 2)), half_extents=np.maximum((high - low) / 2, 1e-4)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgePairTerms:
    """What is measured of every pair (static edge, moving edge), as costs are made of it.

    Attributes:
        score: 0 for parallel edges on top of each other (12, 12); the paper's `edge_score`.
        along: |cos| between each moving edge and the hand's direction (12,).
        reach: Distance from the contact to each moving edge's line, in diagonals of the part (12,).
    """

    score: Array
    along: Array
    reach: Array

    def __post_init__(self) -> None:
        freeze(self, "score", self.score, (12, 12))
        freeze(self, "along", self.along, (12,))
        freeze(self, "reach", self.reach, (12,))


def measure_edge_pairs(
    static: OrientedBox, moving: OrientedBox, contact_world: Array, direction_world: Array
) -> EdgePairTerms:
    """Measure every pair of edges; distances are divided by the moving part's diagonal.

    Args:
        static: Box of the part that stands.
        moving: Box of the part that moves.
        contact_world: Contact point (3,), [m].
        direction_world: Unit vector (3,): approach of the hand, or its displacement.

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling", with twelve edges instead of eight, and the
    mean of the sampled distances instead of their sum, so that their number does not count.
    """
    edges_static, edges_moving = static.edges(), moving.edges()
    size = moving.diagonal_m
    unit_static, unit_moving = (_units(edges) for edges in (edges_static, edges_moving))
    parallel = np.abs(unit_static @ unit_moving.T)
    samples_static, samples_moving = (_samples(edges) for edges in (edges_static, edges_moving))
    gaps = samples_static[:, None, :, None] - samples_moving[None, :, None, :]
    distance = np.linalg.norm(gaps, axis=-1).min(-1).mean(-1) / size
    return EdgePairTerms(
        score=(1 - parallel) * 0.8 + distance * 0.2,
        along=np.abs(unit_moving @ direction_world),
        reach=_line_distances(contact_world, edges_moving) / size,
    )


def find_face_normal(static: OrientedBox, moving: OrientedBox) -> Array:
    """Box axis along which the moving part sticks out of the static one most, for its size."""
    offset = apply(invert(moving.T_world_box), static.T_world_box[:3, 3])
    depth = np.abs(offset) / (static.half_extents + moving.half_extents)
    axis = int(np.argmax(depth))
    return -np.sign(offset[axis]) * moving.T_world_box[:3, axis]


def find_pair_center(
    points_static: Array, points_moving: Array, edge_static: Array, edge_moving: Array, count: int
) -> Array:
    """Mean midpoint (3,) of the `count` nearest point pairs near a pair of edges; the edges' middle without any.

    Points (N, 3), (M, 3) and the end points (2, 3) of the edges share a frame, [m].

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling", with a share of the edge's length as epsilon.
    """
    near = 0.15 * float(np.linalg.norm(edge_moving[1] - edge_moving[0]))
    close_moving = points_moving[_line_distances_many(points_moving, edge_moving) < near]
    close_static = points_static[_line_distances_many(points_static, edge_static) < near]
    if not (len(close_moving) and len(close_static)):
        return np.concatenate([edge_static, edge_moving]).mean(0)
    distances, partners = cKDTree(close_static).query(close_moving)
    chosen = np.argsort(distances)[:count]
    return ((close_moving[chosen] + close_static[partners[chosen]]) / 2).mean(0)


def _units(edges: Array) -> Array:
    steps = edges[:, 1] - edges[:, 0]
    return steps / np.linalg.norm(steps, axis=1, keepdims=True)


def _samples(edges: Array) -> Array:
    shares = np.linspace(0, 1, _EDGE_SAMPLES)[None, :, None]
    return edges[:, :1] * (1 - shares) + edges[:, 1:] * shares


def _line_distances(point: Array, edges: Array) -> Array:
    offsets = point - edges[:, 0]
    units = _units(edges)
    return np.linalg.norm(offsets - (offsets * units).sum(1, keepdims=True) * units, axis=1)


def _line_distances_many(points: Array, edge: Array) -> Array:
    unit = (edge[1] - edge[0]) / np.linalg.norm(edge[1] - edge[0])
    offsets = points - edge[0]
    return np.linalg.norm(offsets - np.outer(offsets @ unit, unit), axis=1)
