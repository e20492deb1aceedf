"""The joint as the paper reads it from the parts' boxes: the pair of edges that lies along it."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.boxes import find_upright_axes, fit_box
from aomgen.core.joint import JointType
from aomgen.core.values import Array, freeze
from aomgen.motion.box_edges import (
    EdgePairTerms,
    find_face_normal,
    find_pair_center,
    measure_edge_pairs,
)
from aomgen.paper.mask_keyframes import Variant


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

    axis: Array
    origin: Array
    face_normal: Array
    pair: tuple[int, int]

    def __post_init__(self) -> None:
        for name in ("axis", "origin", "face_normal"):
            freeze(self, name, getattr(self, name), (3,))


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
        weights: Of the cost.

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
