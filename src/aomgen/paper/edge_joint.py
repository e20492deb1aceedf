"""The joint as the paper reads it from the parts' boxes: the pair of edges that lies along it."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.boxes import OrientedBox, find_upright_axes, fit_box
from aomgen.core.joint import JointType
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.motion.part_shape import find_face_normal
from aomgen.paper.mask_keyframes import Variant

# Points on each edge between which distances are taken; the score is their mean.
_EDGE_SAMPLES = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class PairWeights:
    """The paper's lambda 1, 2 and 3, and K; it names no values.

    Attributes:
        shape: Weight of the edge score.
        direction: Weight of the edge's angle to the hand's direction.
        contact: Weight of the distance between contact and edge.
        nearest_pairs: Point pairs averaged for the joint's center.
    """

    shape: float = 1.0
    direction: float = 1.0
    contact: float = 1.0
    nearest_pairs: int = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxJoint:
    """A joint read from boxes, world frame; its axis has no sense of direction yet.

    Attributes:
        axis: Unit direction (3,) of the chosen edge.
        origin: Joint center (3,), [m].
        face_normal: Unit outward normal (3,) of the moving part's face.
        pair: Chosen static and moving edge, indices into `Box.edges`.
    """

    axis: Vector3
    origin: Vector3
    face_normal: Vector3
    pair: tuple[int, int]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgePairTerms:
    """What is measured of every pair (static edge, moving edge), as costs are made of it.

    Attributes:
        score: 0 for parallel edges on top of each other (12, 12); the paper's `edge_score`.
        along: |cos| between each moving edge and the hand's direction (12,).
        reach: Distance from the contact to each moving edge's line, in diagonals of the part (12,).
    """

    score: Annotated[Array, "12 12"]
    along: Annotated[Array, "12"]
    reach: Annotated[Array, "12"]

    __post_init__ = freeze_arrays


def measure_edge_pairs(
    static: OrientedBox, moving: OrientedBox, contact_world: Array, direction_world: Array
) -> EdgePairTerms:
    """Measure every pair of edges; distances are divided by the moving part's diagonal.

    Args:
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


def pair_costs(
    terms: EdgePairTerms, joint_type: JointType, signs: Variant, weights: PairWeights | None = None
) -> Array:
    """Cost (12, 12) of every pair (static edge, moving edge) to lie along a joint of known type.

    Printed: `l1 score +- l2 |e . v| +- l3 distance(contact, e)`, plus for revolute and minus for
    prismatic; the edge nearest to the contact is a cheap revolute joint, against the text, which
    wants the far side. Repaired: minus before the revolute joint's distance, and no distance for a
    prismatic one, whose parallel edges differ in nothing else.

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling". Costs of the two types do not compare:
    the printed prismatic one is lower whatever moved.
    """
    weights = weights or PairWeights()
    score = weights.shape * terms.score
    along, reach = weights.direction * terms.along, weights.contact * terms.reach
    if joint_type == "revolute":
        return score + (along + reach if signs == "printed" else along - reach)[None]
    return score - (along + reach if signs == "printed" else along)[None]


def box_joint(
    points: tuple[Array, Array],
    contact_world: Array,
    direction_world: Array,
    joint_type: JointType,
    signs: Variant = "printed",
    weights: PairWeights | None = None,
) -> BoxJoint:
    """The joint at the cheapest pair of edges.

    Args:
        points: Of the static (N, 3) and of the closed moving part (M, 3), world frame, [m].
        contact_world: Contact point on the moving part (3,), [m].
        direction_world: Unit direction (3,) of the hand, the paper's `v_ee`.
        joint_type: Taken as known, as the paper does.
        signs: See `pair_costs`.

    Raises:
        InputError: A part has too few points.

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling". Boxes are upright and share the object's
    heading, which the paper leaves open.
    """
    weights = weights or PairWeights()
    axes = find_upright_axes(np.concatenate(points))
    static, moving = (fit_box(part, axes) for part in points)
    costs = pair_costs(
        measure_edge_pairs(static, moving, contact_world, direction_world), joint_type, signs, weights
    )
    row, column = (int(index) for index in np.unravel_index(int(np.argmin(costs)), costs.shape))
    edge_static, edge_moving = static.edges()[row], moving.edges()[column]
    step = edge_moving[1] - edge_moving[0]
    return BoxJoint(
        axis=step / np.linalg.norm(step),
        origin=find_pair_center(*points, edge_static, edge_moving, weights.nearest_pairs),
        face_normal=find_face_normal(static, moving),
        pair=(row, column),
    )


def find_pair_center(
    points_static: Array, points_moving: Array, edge_static: Array, edge_moving: Array, count: int
) -> Array:
    """Mean midpoint (3,) of the `count` nearest point pairs near a pair of edges; the edges' middle without any.

    Points (N, 3), (M, 3) and the end points (2, 3) of the edges share a frame, [m].

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling", with a share of the edge's length as epsilon.
    """
    near = 0.15 * float(np.linalg.norm(edge_moving[1] - edge_moving[0]))
    close_moving = points_moving[_line_distances(points_moving, edge_moving[None]) < near]
    close_static = points_static[_line_distances(points_static, edge_static[None]) < near]
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


def _line_distances(points: Array, edges: Array) -> Array:
    """Distances (N,) of points (3,) or (N, 3) from the lines of edges (N, 2, 3) or (1, 2, 3), [m]."""
    offsets = points - edges[:, 0]
    units = _units(edges)
    return np.linalg.norm(offsets - (offsets * units).sum(1, keepdims=True) * units, axis=1)
