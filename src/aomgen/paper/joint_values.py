"""The part's motion as the paper recovers it: its face, moved by theta, has to meet the contact.

The paper looks for the theta_t that minimizes the distance between the contact point PC_r,t and the
point in which the face's plane, moved by theta_t, meets the contact's trajectory. PC_r,t lies on that
trajectory, so the distance is zero wherever the plane passes through PC_r,t itself, and the minimum is
a root in closed form. A plane through a point has two such angles about an axis; the paper does not
choose, and here it is the one next to the frame before.
"""

import numpy as np

from aomgen.core.joint import Joint
from aomgen.core.transforms import apply
from aomgen.core.values import Array

# A plane that slides within itself by more than this share of a motion tells nothing of it.
_MIN_ACROSS = 1e-3


def intersections(plane_point: Array, plane_normal: Array, path: Array) -> Array:
    """Points (K, 3) in which a plane meets a path (T, 3) of straight pieces; a path inside it is not met."""
    heights = (path - plane_point) @ plane_normal
    first, second = heights[:-1], heights[1:]
    crossed = (first * second <= 0) & (first != second)
    shares = (first / np.where(crossed, first - second, 1.0))[crossed, None]
    return path[:-1][crossed] * (1 - shares) + path[1:][crossed] * shares


def recovery_error(
    joint: Joint, plane_point: Array, plane_normal: Array, path: Array, frame: int, theta: float
) -> float:
    """The paper's f(theta) at one frame: from PC_r,t to the nearest intersection, [m]; infinite without any.

    Args:
        joint: World frame.
        plane_point, plane_normal: The face's plane at theta 0, world frame, (3,) each.
        path: The contact's trajectory PC_r (T, 3), [m].
        frame: Which of them is PC_r,t.
        theta: Joint value, [rad] or [m].
    """
    T = joint.motion(theta)
    met = intersections(apply(T, plane_point), T[:3, :3] @ plane_normal, path)
    return float(np.linalg.norm(met - path[frame], axis=1).min()) if len(met) else float("inf")


def recovered_thetas(joint: Joint, plane_point: Array, plane_normal: Array, path: Array) -> Array:
    """Joint value (T,) of every frame of the motion, [rad] or [m].

    Where no plane passes through the contact the one that comes nearest counts. Where the face slides
    within itself, as that of a sliding door does, every value meets the contact and 0 is kept.

    Args:
        joint, plane_point, plane_normal, path: As in `recovery_error`.

    Source: AOMGen, sec. 4.2, "Movable Part Motion Recovery".
    """
    if joint.type == "prismatic":
        across = float(plane_normal @ joint.axis)
        if not abs(across) > _MIN_ACROSS:
            return np.zeros(len(path))
        return (path - plane_point) @ plane_normal / across
    flat_normal = plane_normal - (plane_normal @ joint.axis) * joint.axis
    if not float(np.linalg.norm(flat_normal)) > _MIN_ACROSS:
        return np.zeros(len(path))
    return _angles(joint, plane_point, plane_normal, path)


def _angles(joint: Joint, plane_point: Array, plane_normal: Array, path: Array) -> Array:
    """Solutions of `n(theta) . (x - o) = n . (p - o)`, written as `a cos + b sin = c`."""
    offsets = path - joint.origin
    along = float(plane_normal @ joint.axis)
    c = plane_normal @ (plane_point - joint.origin) - along * (offsets @ joint.axis)
    a = offsets @ plane_normal - along * (offsets @ joint.axis)
    b = offsets @ np.cross(joint.axis, plane_normal)
    middle = np.arctan2(b, a)
    spread = np.arccos(np.clip(c / np.maximum(np.hypot(a, b), 1e-12), -1.0, 1.0))
    thetas, last = np.empty(len(path)), 0.0
    for k, candidates in enumerate(zip(middle - spread, middle + spread, strict=True)):
        turns = [angle + 2 * np.pi * np.round((last - angle) / (2 * np.pi)) for angle in candidates]
        last = thetas[k] = min(turns, key=lambda angle: abs(angle - last))
    return thetas
