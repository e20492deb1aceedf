"""The joint as the paper reads it from the parts' boxes: the pair of edges that lies along it."""

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.boxes import OrientedBox, find_upright_axes, fit_box
from aomgen.core.joint import Joint, JointType
from aomgen.core.values import Array
from aomgen.motion.part_shape import find_face_normal
from aomgen.paper.mask_keyframes import Variant

# Number of points on each edge; the score is the mean of the distances between corresponding points.
_EDGE_SAMPLES = 9
# Number of point pairs that are averaged for the joint's center, the paper's K; the paper gives no value.
NEAREST_PAIRS = 50


def score_edge_pairs(static: OrientedBox, moving: OrientedBox) -> Array:
    """Score (12, 12) of every pair (static edge, moving edge): 0 for parallel edges on top of each other.

    This is the paper's `edge_score`; distances are divided by the moving part's diagonal.
    """
    edges_static, edges_moving = static.edges(), moving.edges()
    parallel = np.abs(_units(edges_static) @ _units(edges_moving).T)
    gaps = _samples(edges_static)[:, None, :, None] - _samples(edges_moving)[None, :, None, :]
    distance = np.linalg.norm(gaps, axis=-1).min(-1).mean(-1) / moving.diagonal_m
    return (1 - parallel) * 0.8 + distance * 0.2


def pair_costs(
    boxes: tuple[OrientedBox, OrientedBox],
    contact_world: Array,
    direction_world: Array,
    joint_type: JointType,
    variant: Variant,
) -> Array:
    """Compute the cost (12, 12) of every pair (static edge, moving edge) to lie along a joint of known type.

    Printed: `l1 score +- l2 |e . v| +- l3 distance(contact, e)`, with plus for revolute and minus for
    prismatic joints. The cost of a revolute joint is then small at the edge nearest to the contact, in contradiction to the
    text, which requires the far side. Repaired: the distance of a revolute joint has a minus sign, and that of a prismatic
    joint, whose parallel edges differ only in it, is omitted. The paper gives no values for the weights; here all are 1,
    and distances are divided by the diagonal of the moving part.

    Args:
        boxes: Boxes of the static and the moving part, world frame.
        contact_world: Contact point (3,), [m].
        direction_world: Unit vector (3,): approach of the end effector, or its displacement.

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling", with twelve edges instead of eight, and the
    mean of the sampled distances instead of their sum, so that it does not depend on their number. The costs of the two joint
    types are not comparable: the printed cost of a prismatic joint is always lower.
    """
    edges = boxes[1].edges()
    along = np.abs(_units(edges) @ direction_world)
    reach = _line_distances(contact_world, edges) / boxes[1].diagonal_m
    score = score_edge_pairs(*boxes)
    if joint_type == "revolute":
        return score + (along - reach if variant == "repaired" else along + reach)[None]
    return score - (along if variant == "repaired" else along + reach)[None]


def box_joint(
    points: tuple[Array, Array],
    contact_world: Array,
    direction_world: Array,
    joint_type: JointType,
    variant: Variant = "printed",
) -> tuple[Joint, Array]:
    """Find the joint at the cheapest pair of edges, and the outward normal of the moving part's face.

    Args:
        points: Points of the static (N, 3) and of the closed moving part (M, 3), world frame, [m].
        contact_world: Contact point on the moving part (3,), [m].
        direction_world: Unit direction (3,) of the end effector, the paper's `v_ee`.
        joint_type: Type of the joint, which is given as in the paper.
        variant: See `pair_costs`.

    Returns:
        The joint, world frame, whose axis has an arbitrary sign and whose limits are not set; and a unit normal (3,).

    Raises:
        InputError: A part has too few points.

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling". Boxes are upright and share the object's
    heading, which the paper leaves open.
    """
    axes = find_upright_axes(np.concatenate(points))
    static, moving = (fit_box(part, axes) for part in points)
    costs = pair_costs((static, moving), contact_world, direction_world, joint_type, variant)
    row, column = np.unravel_index(int(np.argmin(costs)), costs.shape)
    edge_static, edge_moving = static.edges()[row], moving.edges()[column]
    step = edge_moving[1] - edge_moving[0]
    origin = find_pair_center(*points, edge_static, edge_moving)
    joint = Joint(type=joint_type, axis=step / np.linalg.norm(step), origin=origin, lower=0.0, upper=0.0)
    return joint, find_face_normal(static, moving)


def find_pair_center(
    points_static: Array, points_moving: Array, edge_static: Array, edge_moving: Array
) -> Array:
    """Compute the mean midpoint (3,) of the nearest point pairs near a pair of edges; without any, the center of the edges.

    Points (N, 3), (M, 3) and the end points (2, 3) of the edges share a frame, [m].

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling", with a share of the edge's length as epsilon.
    """
    near = 0.15 * float(np.linalg.norm(edge_moving[1] - edge_moving[0]))
    close_moving = points_moving[_line_distances(points_moving, edge_moving[None]) < near]
    close_static = points_static[_line_distances(points_static, edge_static[None]) < near]
    if not (len(close_moving) and len(close_static)):
        return np.concatenate([edge_static, edge_moving]).mean(0)
    distances, partners = cKDTree(close_static).query(close_moving)
    chosen = np.argsort(distances)[:NEAREST_PAIRS]
    return ((close_moving[chosen] + close_static[partners[chosen]]) / 2).mean(0)


def _units(edges: Array) -> Array:
    steps = edges[:, 1] - edges[:, 0]
    return steps / np.linalg.norm(steps, axis=1, keepdims=True)


def _samples(edges: Array) -> Array:
    shares = np.linspace(0, 1, _EDGE_SAMPLES)[None, :, None]
    return edges[:, :1] * (1 - shares) + edges[:, 1:] * shares


def _line_distances(points: Array, edges: Array) -> Array:
    """Compute the distances (N,) of points (3,) or (N, 3) from the lines of edges (N, 2, 3) or (1, 2, 3), [m]."""
    offsets = points - edges[:, 0]
    units = _units(edges)
    return np.linalg.norm(offsets - (offsets * units).sum(1, keepdims=True) * units, axis=1)
