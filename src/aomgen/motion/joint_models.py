"""The two one-parameter motions and their robust fits to the hand's path."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze
from aomgen.motion.edges import EdgePrior
from aomgen.motion.path import HandPath


@dataclass(frozen=True, slots=True, kw_only=True)
class JointNoise:
    """Assumed errors of the evidence, one standard deviation each.

    Attributes:
        position_sd_m: Path of the held point (slip, bending), [m].
        rotation_sd_rad: Wobble of the hand across the axis, [rad].
        turn_sd_rad, turn_sd_share: Hand's turn against the part's turn: constant [rad] plus share of the turn;
            all nodes together count once, as a handle turns steadily in the fingers.
        grasp_sd_m: First guess of the held point, [m].
        upright_sd_rad, level_sd_rad: Direction of the object's vertical and horizontal edges, [rad].
        edge_sd_share: Distance of the joint from its edge pair, as share of the part's diagonal.
        independent_nodes: Slip is smooth, so all nodes together count as this many.
        max_radius_m: Largest radius of a revolute joint, [m].
    """

    position_sd_m: float = 0.001
    rotation_sd_rad: float = float(np.radians(2.0))
    turn_sd_rad: float = float(np.radians(3.0))
    turn_sd_share: float = 0.15
    grasp_sd_m: float = 0.008
    upright_sd_rad: float = float(np.radians(1.0))
    level_sd_rad: float = float(np.radians(2.5))
    edge_sd_share: float = 0.08
    independent_nodes: float = 6.0
    max_radius_m: float = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Solution:
    """One fitted motion.

    Attributes:
        axis: Unit direction (3,).
        origin: Point of the axis nearest the path's beginning (3,), [m]; prismatic: that beginning.
        grasp_ee: Held point (3,), end-effector frame, [m].
        values: Joint value at each node (K,), [rad] or [m].
        residual_m: RMS distance of the nodes from the model, robust, [m].
        bic: Bayesian information criterion.
        axis_sd_rad, origin_sd_m: Standard deviations, [rad], [m].
    """

    axis: Array
    origin: Array
    grasp_ee: Array
    values: Array
    residual_m: float
    bic: float
    axis_sd_rad: float
    origin_sd_m: float

    def __post_init__(self) -> None:
        freeze(self, "axis", self.axis, (3,))
        freeze(self, "origin", self.origin, (3,))
        freeze(self, "grasp_ee", self.grasp_ee, (3,))
        freeze(self, "values", self.values, (len(self.values),))


def solve_revolute(path: HandPath, edges: EdgePrior | None, noise: JointNoise) -> Solution:
    """Best circle about an axis: the held point keeps radius and height, the hand turns about the axis only.

    Unknowns: axis (2), centre (2), radius, height, held point (3, with a prior). Several first axes
    are tried, because a short arc hardly tells its plane.
    """
    middle = path.points_world.mean(0)
    candidates = [_fit_circle(path, start, middle, edges, noise) for start in _first_axes(path, edges)]
    return min(candidates, key=lambda solution: solution.bic)


def solve_prismatic(path: HandPath, edges: EdgePrior | None, noise: JointNoise) -> Solution:
    """Best straight line: the held point keeps to it and the hand does not turn."""
    points = path.points_world
    middle = points.mean(0)
    start = np.linalg.svd(points - middle)[2][0]
    tangents = tangent_basis(start)
    share = np.sqrt(noise.independent_nodes / len(points))
    turns = path.turns_world

    def terms(x: Array) -> tuple[Array, Array]:
        axis = _tilted(start, tangents, x[:2])
        offsets = points - middle - x[2:4] @ tangents
        across = offsets - np.outer(offsets @ axis, axis)
        data = [share * across.ravel() / noise.position_sd_m, share * turns.ravel() / noise.turn_sd_rad]
        prior = [] if edges is None else [_direction_term(axis, edges, noise)]
        return np.concatenate(data), np.array(prior)

    x, covariance, cost = _minimise(terms, np.zeros(4))
    axis = _tilted(start, tangents, x[:2])
    offsets = points - middle - x[2:4] @ tangents
    across = np.linalg.norm(offsets - np.outer(offsets @ axis, axis), axis=1)
    return Solution(
        axis=axis,
        origin=points[0],
        grasp_ee=path.grasp_ee,
        values=(points - points[0]) @ axis,
        residual_m=_robust_rms(across),
        bic=cost + 4 * np.log(4 * noise.independent_nodes),
        axis_sd_rad=float(np.sqrt(np.trace(covariance[:2, :2]))),
        origin_sd_m=float(np.sqrt(np.trace(covariance[2:4, 2:4]))),
    )


def _fit_circle(
    path: HandPath, start: Array, middle: Array, edges: EdgePrior | None, noise: JointNoise
) -> Solution:
    tangents = tangent_basis(start)
    Ts, turns = path.Ts_world_ee, path.turns_world
    share = np.sqrt(noise.independent_nodes / len(Ts))

    def unpack(x: Array) -> tuple[Array, Array, Array]:
        grasp = path.grasp_ee + x[6:9]
        return _tilted(start, tangents, x[:2]), middle + x[2:4] @ tangents, apply(Ts, grasp)

    def terms(x: Array) -> tuple[Array, Array]:
        axis, center, points = unpack(x)
        offsets = points - center
        heights = offsets @ axis
        radii = np.linalg.norm(offsets - np.outer(heights, axis), axis=1)
        wobble = turns - np.outer(turns @ axis, axis)
        values = arc_values(points, center, axis)
        slack = noise.turn_sd_rad + noise.turn_sd_share * abs(values[-1])
        data = [
            share * (radii - x[4]) / noise.position_sd_m,
            share * (heights - x[5]) / noise.position_sd_m,
            share * wobble.ravel() / noise.rotation_sd_rad,
            (turns @ axis - values) / (slack * np.sqrt(len(Ts))),
        ]
        prior = [*(x[6:9] / noise.grasp_sd_m), 3 * max(0.0, x[4] / noise.max_radius_m - 1)]
        if edges is not None:
            line_gap = np.cross(edges.revolute_origin - center, axis)
            prior += [
                _direction_term(axis, edges, noise),
                float(np.linalg.norm(line_gap)) / (noise.edge_sd_share * edges.diagonal_m),
            ]
        return np.concatenate(data), np.array(prior)

    center, radius = _first_circle(path.points_world, middle, tangents, turns @ start)
    x, covariance, cost = _minimise(
        terms, np.concatenate([center, [radius, 0.0], np.zeros(3)], dtype=float), lead=2
    )
    axis, center_world, points = unpack(x)
    offsets = points - center_world
    radii = np.linalg.norm(offsets - np.outer(offsets @ axis, axis), axis=1)
    misfit = np.hypot(radii - x[4], offsets @ axis - x[5])
    return Solution(
        axis=axis,
        origin=center_world + axis * (offsets[0] @ axis),
        grasp_ee=path.grasp_ee + x[6:9],
        values=arc_values(points, center_world, axis),
        residual_m=_robust_rms(misfit),
        bic=cost + 7 * np.log(4 * noise.independent_nodes),
        axis_sd_rad=float(np.sqrt(np.trace(covariance[:2, :2]))),
        origin_sd_m=float(np.sqrt(np.trace(covariance[2:4, 2:4]))),
    )


def arc_values(points: Array, center: Array, axis: Array) -> Array:
    """Angles (K,) of points (K, 3) about an axis since the first one, unwrapped, [rad]."""
    offsets = points - center
    flat = offsets - np.outer(offsets @ axis, axis)
    first = flat[0]
    return np.unwrap(np.arctan2(np.cross(first, flat) @ axis, flat @ first))


def tangent_basis(axis: Array) -> Array:
    """Two unit vectors (2, 3) that complete a unit vector (3,) to a right-handed frame."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first)
    return np.asarray(np.stack([first, np.cross(axis, first)]), np.float64)


def _tilted(axis: Array, tangents: Array, tilt: Array) -> Array:
    turned = axis + tilt @ tangents
    return turned / np.linalg.norm(turned)


def _first_axes(path: HandPath, edges: EdgePrior | None) -> list[Array]:
    """Plane normal of the path, rotation axis of the hand, and the object's box axes."""
    points = path.points_world
    axes = [np.linalg.svd(points - points.mean(0))[2][2]]
    turns = path.turns_world
    if np.linalg.norm(turns, axis=1).max() > np.radians(3.0):
        axes.append(np.linalg.svd(turns)[2][0])
    if edges is not None:
        axes += list(edges.axes)
    return axes


def _first_circle(points: Array, middle: Array, tangents: Array, turns: Array) -> tuple[Array, float]:
    """Algebraic circle in the plane of the tangents: centre (2,) relative to `middle`, radius, [m].

    Source: Kasa, 1976. A nearly straight path gets a circle whose arc equals the hand's turn.
    """
    flat = (points - middle) @ tangents.T
    A = np.column_stack([2 * flat, np.ones(len(flat))])
    (x, y, c), *_ = np.linalg.lstsq(A, (flat**2).sum(1), rcond=None)
    radius = float(np.sqrt(max(c + x * x + y * y, 1e-12)))
    if radius < 2.0:
        return np.array([x, y]), radius
    chord = flat[-1] - flat[0]
    length = float(np.linalg.norm(chord))
    turn = float(turns[-1] - turns[0])
    radius = float(np.clip(length / max(abs(turn), 0.05), 0.05, 2.0))
    side = np.array([-chord[1], chord[0]]) / max(length, 1e-9) * (1.0 if turn >= 0 else -1.0)
    return radius * side, radius


def _direction_term(axis: Array, edges: EdgePrior, noise: JointNoise) -> float:
    """Angle to the nearest box axis over its standard deviation."""
    sds = np.array([noise.level_sd_rad, noise.level_sd_rad, noise.upright_sd_rad])
    sines = np.linalg.norm(np.cross(edges.axes, axis), axis=1)
    cosines = np.abs(edges.axes @ axis)
    return float(np.min(np.arctan2(sines, cosines) / sds))


def _minimise(
    terms: Callable[[Array], tuple[Array, Array]], rest: Array, *, lead: int = 0
) -> tuple[Array, Array, float]:
    """Robust minimum, covariance and cost: first a soft loss, then one that forgets outliers.

    Args:
        terms: Data residuals and prior residuals, each in standard deviations, of the unknowns.
        rest: First unknowns after `lead` leading zeros.
    """

    def soft(x: Array) -> Array:
        data, prior = terms(x)
        return np.concatenate([_soft(data), _forgetful(prior)])

    def hard(x: Array) -> Array:
        data, prior = terms(x)
        return np.concatenate([_forgetful(data / 3) * 3, _forgetful(prior)])

    start = np.concatenate([np.zeros(lead), rest])
    x = least_squares(soft, start, x_scale="jac", max_nfev=200).x
    result = least_squares(hard, x, x_scale="jac", max_nfev=200)
    information = result.jac.T @ result.jac
    return result.x, np.linalg.pinv(information), float(2 * result.cost)


def _soft(residuals: Array) -> Array:
    return np.sign(residuals) * np.sqrt(2 * (np.sqrt(1 + residuals**2) - 1))


def _forgetful(residuals: Array) -> Array:
    """Square roots of Cauchy's loss."""
    return np.sign(residuals) * np.sqrt(np.log1p(residuals**2))


def _robust_rms(distances: Array) -> float:
    return float(1.4826 * np.median(np.abs(distances)))
