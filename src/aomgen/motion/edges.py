"""Boxes around the two parts, and which pair of their edges looks like the joint.

Right for most doors and drawers, wrong for some (a wide flat lid, a tall fridge), so it serves as
a weak prior for `joint.py` and never decides alone.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.joint import JointType
from aomgen.core.transforms import apply, invert, transform
from aomgen.core.values import Array, freeze
from aomgen.errors import InputError

_YAW_STEPS = 180
_TAIL_PERCENT = 1.0
_MIN_POINTS = 20
_EDGE_SAMPLES = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
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


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeWeights:
    """Weights of the edge cost's terms, and the pair count that makes the centre.

    Attributes:
        shape: Weight of "parallel and close" (the paper's lambda 1).
        direction: Weight of the edge's angle to the hand's motion (lambda 2).
        contact: Weight of the distance between contact and edge (lambda 3).
        nearest_pairs: Point pairs averaged for the joint's centre (the paper's K).
    """

    shape: float = 1.0
    direction: float = 0.5
    contact: float = 1.0
    nearest_pairs: int = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgePrior:
    """What the shape of the closed object says about its joint, world frame.

    Attributes:
        axes: Unit box axes (3, 3) in rows; the last is vertical.
        revolute_axis, revolute_origin: Direction (3,) and centre (3,) of the best revolute pair, [m].
        prismatic_axis: Direction (3,) of the best prismatic pair.
        face_normal: Unit outward normal (3,) of the moving part's face.
        diagonal_m: Size of the moving part, [m].
    """

    axes: Array
    revolute_axis: Array
    revolute_origin: Array
    prismatic_axis: Array
    face_normal: Array
    diagonal_m: float

    def __post_init__(self) -> None:
        freeze(self, "axes", self.axes, (3, 3))
        for name in ("revolute_axis", "revolute_origin", "prismatic_axis", "face_normal"):
            freeze(self, name, getattr(self, name), (3,))


def footprint_yaw(points_world: Array) -> float:
    """Yaw of the smallest upright rectangle around points (N, 3), [rad], in 0..pi/2.

    Extents are taken between the 1st and 99th percentile, so that stray points do not count.
    """
    yaws = np.arange(_YAW_STEPS) * (np.pi / 2 / _YAW_STEPS)
    areas = []
    for yaw in yaws:
        c, s = np.cos(yaw), np.sin(yaw)
        turned = points_world[:, :2] @ np.array([[c, -s], [s, c]])
        low, high = np.percentile(turned, [_TAIL_PERCENT, 100 - _TAIL_PERCENT], axis=0)
        areas.append(np.prod(high - low))
    return float(yaws[int(np.argmin(areas))])


def upright_box(points_world: Array, yaw: float) -> Box:
    """Box with the given yaw around points (N, 3), world frame, tails of one percent cut.

    Raises:
        InputError: Fewer than 20 points.
    """
    if not len(points_world) >= _MIN_POINTS:
        raise InputError(
            "part points", f"{len(points_world)} points, need {_MIN_POINTS}", "correct the prompts"
        )
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    local = points_world @ R
    low, high = np.percentile(local, [_TAIL_PERCENT, 100 - _TAIL_PERCENT], axis=0)
    return Box(
        T_world_box=transform(R, R @ ((low + high) / 2)), half_extents=np.maximum((high - low) / 2, 1e-4)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeTerms:
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


def edge_terms(static: Box, moving: Box, contact_world: Array, direction_world: Array) -> EdgeTerms:
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
    return EdgeTerms(
        score=(1 - parallel) * 0.8 + distance * 0.2,
        along=np.abs(unit_moving @ direction_world),
        reach=_line_distances(contact_world, edges_moving) / size,
    )


def edge_costs(
    static: Box,
    moving: Box,
    contact_world: Array,
    direction_world: Array,
    joint_type: JointType,
    weights: EdgeWeights | None = None,
) -> Array:
    """Cost (12, 12) of every pair (static edge, moving edge) to lie along the joint.

    Parallel and close edges are cheap. A revolute joint lies across the hand's approach and far from
    the contact; a prismatic edge points along the hand's motion.

    The direction is the hand's approach (revolute) or its displacement (prismatic); see `edge_terms`.

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling", with the sign of the contact term turned
    (the text asks for the far side, the printed formula for the near one).
    """
    weights = weights or EdgeWeights()
    terms = edge_terms(static, moving, contact_world, direction_world)
    cost = weights.shape * terms.score
    if joint_type == "revolute":
        return cost + weights.direction * terms.along[None] - weights.contact * terms.reach[None]
    return cost - weights.direction * terms.along[None]


def edge_prior(
    points_static: Array,
    points_moving: Array,
    contact_world: Array,
    displacement_world: Array,
    weights: EdgeWeights | None = None,
) -> EdgePrior:
    """Boxes, their axes and the best edge pair of each joint type.

    Args:
        points_static: Points of the static part (N, 3), world frame, [m].
        points_moving: Points of the closed moving part (M, 3), world frame, [m].
        contact_world: Contact point (3,), [m].
        displacement_world: Unit vector (3,) of the hand's first motion.
        weights: Weights of the cost.

    Raises:
        InputError: A part has too few points.

    Not checked: the object stands upright and both parts are roughly boxes.
    """
    weights = weights or EdgeWeights()
    yaw = footprint_yaw(np.concatenate([points_static, points_moving]))
    static, moving = upright_box(points_static, yaw), upright_box(points_moving, yaw)
    axes = moving.T_world_box[:3, :3].T
    normal = face_normal(static, moving)
    best_revolute = _best_pair(edge_costs(static, moving, contact_world, normal, "revolute", weights))
    best_prismatic = _best_pair(
        edge_costs(static, moving, contact_world, displacement_world, "prismatic", weights)
    )
    edge_static, edge_moving = static.edges()[best_revolute[0]], moving.edges()[best_revolute[1]]
    return EdgePrior(
        axes=axes,
        revolute_axis=_units(edge_moving[None])[0],
        revolute_origin=pair_center(
            points_static, points_moving, edge_static, edge_moving, weights.nearest_pairs
        ),
        prismatic_axis=_units(moving.edges()[best_prismatic[1]][None])[0],
        face_normal=normal,
        diagonal_m=moving.diagonal_m,
    )


def face_normal(static: Box, moving: Box) -> Array:
    """Box axis along which the moving part sticks out of the static one most, for its size."""
    offset = apply(invert(moving.T_world_box), static.T_world_box[:3, 3])
    depth = np.abs(offset) / (static.half_extents + moving.half_extents)
    axis = int(np.argmax(depth))
    return -np.sign(offset[axis]) * moving.T_world_box[:3, axis]


def pair_center(
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


def _best_pair(costs: Array) -> tuple[int, int]:
    row, column = np.unravel_index(int(np.argmin(costs)), costs.shape)
    return int(row), int(column)


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
