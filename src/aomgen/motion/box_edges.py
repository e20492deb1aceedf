"""Edges of the boxes around the two parts."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.boxes import OrientedBox
from aomgen.core.values import Array, freeze

# Points on each edge between which distances are taken; the score is their mean.
_EDGE_SAMPLES = 9


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
    offset = moving.coordinates(static.T_world_box[:3, 3])
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
