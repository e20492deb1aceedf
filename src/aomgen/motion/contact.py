"""Contact patches between the gripper and the part at the start of the motion, one patch per finger.

A finger touches the part where the gap between their surfaces is smallest along the direction of pressing.
Pads press towards each other on the material between them; any other gripper presses in the direction in
which the part moves. Gaps are known only up to the error of reconstructed surfaces, so a patch is the mean
over the positions that may be nearest.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from aomgen.core.motion import ContactPatch
from aomgen.core.quadrature import normal_points
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.motion.ee_path import average_poses
from aomgen.motion.inputs import EMPTY_GRIP, MotionInput
from aomgen.robots.gripper_surface import hand_surface
from aomgen.robots.robot import FingerPad, RobotModel

# Spacing of the points that represent the part's surface, and error of reconstructed thin surfaces, [m].
SURFACE_SD_M = 0.002
# Because of that error, the held strip may appear to reach this far into the pads, [m].
_BEHIND_M = 2 * SURFACE_SD_M
# Points along either side of a pad's face: pads are about 2 cm long, so corners are met to 0.25 mm.
_PAD_GRID = 81
# Standard deviations of the unknown rotation of the held strip against a pad, [rad]: about its length by the
# fit of the object's box, along it by the compliance of the pads, and on the face by the few visible points.
_TURN_SDS = tuple(np.radians([1.0, 0.3, 5.0]))
# Number of rotations over which a contact is averaged; each costs one search over the points of a pad.
_TURNS = 100
# The touched surface may appear to be inside the finger by the error of finger and alignment, [m].
_INSIDE_M = 0.01
# Points beyond these percentiles are outliers.
_STRAYS = (5, 95)
# A shorter travel does not define a direction, [m].
_MIN_TRAVEL_M = 5e-4
# A surface whose normal deviates further from the pushing direction than this cosine hardly pushes.
_MIN_FACING = 0.2
# A finger whose share of the push is smaller than this does not touch.
_MIN_SHARE = 0.15
# One patch per finger ("hand" if the pads are unknown), and their mean (3,), end-effector frame, [m].
Contacts = tuple[tuple[ContactPatch, ...], Array]


def carry_part(demo: MotionInput, resting_s: float, times_s: Array) -> Array:
    """Compute transforms (K, 4, 4) of the part since a time of rest if the gripper holds it at times (K,)."""
    Ts_world_ee = demo.ee_poses_at(np.append(resting_s, times_s))
    return Ts_world_ee[1:] @ invert(Ts_world_ee[0])


def find_contacts(
    demo: MotionInput, part: tuple[Array, Array], times_s: Array, Ts_world_part: Array
) -> Contacts:
    """Find the patches of all fingers that touch, over the first moments of the motion.

    The part is posed as the gripper carries it: averaged over the moments, its position is known better than
    at a single one, and no patch is sought at an earlier position of the part.

    Args:
        demo: Demonstration, of which the robot and its log are used.
        part: Dense points of the part as scanned (N, 3), and the unit axes (3, 3) in rows of
            its box; world frame, [m].
        times_s, Ts_world_part: Moments (K,), and the part's transforms since the scan there (K, 4, 4).

    Source: AOMGen, sec. 4.2, "Contact Point Detection", with patches in place of one nearest pair.
    Not checked: that anything touches at all; `gap_m` reports the remaining distance.
    """
    Ts_world_ee = demo.ee_poses_at(times_s)
    T_ee_part = average_poses(invert(Ts_world_ee) @ Ts_world_part)
    points_ee, axes_ee = apply(T_ee_part, part[0]), part[1] @ T_ee_part[:3, :3].T
    middle = len(times_s) // 2
    Ts_ee_body = invert(Ts_world_ee[middle]) @ demo.body_poses_at(times_s)[middle]
    faces = _holding_faces(demo, times_s, Ts_ee_body)
    patches = _find_held(faces, points_ee, axes_ee) if faces else []
    if not patches and demo.robot.hand_bodies:
        way = _find_direction(Ts_world_ee, Ts_world_part, points_ee)
        patches = _find_pushed(demo.robot, Ts_ee_body, points_ee, way)
    if not patches:
        # Fingers that closed on a part that the scan hardly shows may hold it anywhere on their pads.
        patches = [face.patch(points_ee, face.grid, np.zeros(2)) for face in faces] or [_nearest(points_ee)]
    grasp_ee = np.mean([patch.point for patch in patches], axis=0)
    return tuple(_carry(patch, Ts_world_ee) for patch in patches), grasp_ee


def find_between_pads(demo: MotionInput, time_s: float, points: Array) -> NDArray[np.bool_]:
    """Find which points (N, 3), world frame, lie between the pads of a gripper that may hold them."""
    faces = _holding_faces(demo, np.array([time_s]), demo.body_poses_at([time_s])[0])
    between = [
        face.between(other, points, face.grid.max(0)) for face, other in zip(faces, faces[::-1], strict=True)
    ]
    return np.all(between, axis=0) if faces else np.zeros(len(points), bool)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Face:
    """The inner face of a finger's pad: pose, z towards the other pad (4, 4), and a grid on it (G, 2), [m].

    The pose is given in the frame of the points that the face is compared with.
    """

    finger: str
    T_frame_face: Array
    grid: Array

    @staticmethod
    def of(pad: FingerPad, T_frame_body: Array) -> "_Face":
        T_frame_face = T_frame_body @ pad.T_body_pad
        T_frame_face[:3, 3] = apply(T_frame_body, pad.face_body)
        steps = np.linspace(-1, 1, _PAD_GRID)
        grid = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) * pad.half_extents[:2]
        return _Face(finger=pad.finger, T_frame_face=T_frame_face, grid=grid)

    def between(self, other: "_Face", points: Array, half_m: ArrayLike) -> NDArray[np.bool_]:
        """Find which points (N, 3) lie within half extents of this face, up to the other one."""
        local = apply(invert(self.T_frame_face), points)
        inside = (local[:, 2] > -_BEHIND_M) & (local[:, 2] < self.openings(local[:, :2], other) + _BEHIND_M)
        return inside & np.all(np.abs(local[:, :2]) < half_m, axis=1)

    def slope(self, normal: Array) -> Array:
        """Compute how fast (2,) a plane with a normal (3,) approaches along this face, [m/m]."""
        local = normal @ self.T_frame_face[:3, :3]
        return local[:2] / local[2]

    def openings(self, flat: Array, other: "_Face") -> Array:
        """Compute the distances (...) to the other face from points (..., 2) of this one, [m]."""
        T_face_other = invert(self.T_frame_face) @ other.T_frame_face
        normal = T_face_other[:3, 2]
        return np.asarray((normal @ T_face_other[:3, 3] - flat @ normal[:2]) / normal[2])

    def patch(self, points_ee: Array, flat: Array, touched: Array) -> ContactPatch:
        """Make a patch at a point (2,) of this face, one of (N, 2) candidates, on a part of points (M, 3)."""
        placed = apply(self.T_frame_face, np.pad(np.vstack([touched, flat]), ((0, 0), (0, 1))))
        return ContactPatch(
            finger=self.finger,
            point=placed[0],
            normal=self.T_frame_face[:3, 2],
            spread_m=float(np.sqrt(((flat - touched) ** 2).sum(1).mean() + 3 * SURFACE_SD_M**2)),
            gap_m=float(cKDTree(points_ee).query(placed)[0].min()),
        )


def _holding_faces(demo: MotionInput, times_s: Array, Ts_frame_body: Array) -> list[_Face]:
    """Return the faces of both pads; none without pads, or if they are closed at most times (K,)."""
    pads = demo.robot.pads[:2]
    if len(pads) < 2 or not float(np.median(demo.log.at(times_s)[1])) < EMPTY_GRIP:
        return []
    return [_Face.of(pad, Ts_frame_body[pad.body]) for pad in pads]


def _find_held(faces: list[_Face], points_ee: Array, axes_ee: Array) -> list[ContactPatch]:
    """Find one patch on each face of a gripper that holds the part; none if it is not between them.

    The held piece (bar, rim, knob) has straight sides. Its faces are parallel to the object's box, and of a
    plane that is rotated against a pad, a corner is nearest.
    """
    closing = faces[0].T_frame_face[:3, 2] - faces[1].T_frame_face[:3, 2]
    axis = axes_ee[np.argmax(np.abs(axes_ee @ closing))]
    # The first rotation is that of the strip as it was seen.
    turns = np.vstack([np.zeros(3), normal_points(_TURNS, 3) * _TURN_SDS])
    patches = []
    for face, other in zip(faces, faces[::-1], strict=True):
        # The margin sideways equals the length along the fingers: visible points next to the
        # pads show the bar's line.
        within = face.between(other, points_ee, face.grid.max() + _BEHIND_M)
        between = apply(invert(face.T_frame_face), points_ee[within])
        if not len(between):
            return []
        opening = float(face.openings(np.zeros(2), other))
        along, across, covered = _lay_strip(between[:, :2], face.grid, opening, turns[:, 2])
        thickness = float(np.ptp(np.percentile(between[:, 2], _STRAYS)))
        closest = face.openings(face.grid[covered[0]], other).min(initial=np.inf)
        if not 0 < closest <= thickness + 2 * _INSIDE_M:
            return []
        rolls = across @ face.slope(axis) + turns[:, 0]
        leans = along @ face.slope(closing) + turns[:, 1]
        nearness = (rolls[:, None] * across + leans[:, None] * along) @ face.grid.T
        nearest = np.argmax(np.where(covered, nearness, -np.inf), axis=1)[covered.any(1)]
        patches.append(face.patch(points_ee, face.grid[covered[0]], face.grid[nearest].mean(0)))
    return patches


def _lay_strip(
    seen: Array, grid: Array, least_m: float, turns: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Fit a straight strip to visible points (N, 2) before a face with points (G, 2), and rotate it there.

    Args:
        seen, grid: Points of the part and of the face, [m].
        least_m: Smallest width of the strip.
        turns: Angles (K,) by which the strip may be rotated, [rad].

    Returns:
        Unit vectors along and across the strip (K, 2), and the points of the face that it covers (K, G).
    """
    center = seen.mean(0)
    way = np.linalg.eigh((seen - center).T @ (seen - center))[1][:, 1]
    low, high = np.percentile((seen - center) @ [-way[1], way[0]], _STRAYS)
    middle = center + (low + high) / 2 * np.array([-way[1], way[0]])
    angles = np.arctan2(way[1], way[0]) + turns
    along = np.stack([np.cos(angles), np.sin(angles)], 1)
    across = along[:, ::-1] * [-1, 1]
    half = max(float(high - low), least_m, 2 * SURFACE_SD_M) / 2
    return along, across, np.abs(across @ (grid - middle).T) <= half


def _find_pushed(robot: RobotModel, Ts_ee_body: Array, points_ee: Array, way: Array) -> list[ContactPatch]:
    """Find one patch on each finger that pushes in a direction (3,): its nearest surface that faces the part.

    Not checked: parts that bend within the width of the gripper. Where gripper and part are parallel, either
    end of the patch may carry the force.
    """
    surface = hand_surface(robot)
    points, normals = surface.pose(Ts_ee_body)
    facing = np.clip(normals @ way, 0, 1)
    pushing = facing > _MIN_FACING
    points, facing, fingers = points[pushing], facing[pushing], surface.fingers[pushing]
    across = np.linalg.svd(way[None])[2][1:]
    beside = cKDTree(points_ee @ across.T).query_ball_point(points @ across.T, SURFACE_SD_M)
    ahead = points_ee @ way
    rooms = [ahead[near] - start for near, start in zip(beside, points @ way, strict=True)]
    room = np.array([row[row > -_INSIDE_M].min(initial=np.inf) for row in rooms])
    if not np.isfinite(room).any():
        return []
    weights = facing * np.exp(-0.5 * ((room - room.min()) / SURFACE_SD_M) ** 2)
    weights /= weights.sum()
    patches = []
    for finger in np.unique(fingers[weights > 0]):
        share = np.where(fingers == finger, weights, 0)
        if share.sum() >= _MIN_SHARE:
            share /= share.sum()
            normal = share @ normals[pushing]
            point, gap = share @ points, float(np.abs(room[share > 0]).min())
            spread = share @ ((points - point) ** 2).sum(1) + 3 * SURFACE_SD_M**2 + gap**2
            patches.append(
                ContactPatch(
                    finger=str(finger),
                    point=point,
                    normal=normal / np.linalg.norm(normal),
                    spread_m=float(np.sqrt(spread)),
                    gap_m=gap,
                )
            )
    return patches


def _find_direction(Ts_world_ee: Array, Ts_world_part: Array, points_ee: Array) -> Array:
    """Find the unit direction (3,) in which the part moves at the gripper, end-effector frame.

    If the part rests, it is the direction in which the gripper moves; if that rests too, from
    the gripper to the part.
    """
    T_world_ee = Ts_world_ee[len(Ts_world_ee) // 2]
    touched = apply(invert(Ts_world_part[len(Ts_world_part) // 2]), T_world_ee[:3, 3])
    ways = [
        np.diff(apply(Ts_world_part[[0, -1]], touched), axis=0)[0],
        np.diff(Ts_world_ee[[0, -1], :3, 3], axis=0)[0],
    ]
    for way in ways:
        if np.linalg.norm(way) > _MIN_TRAVEL_M:
            return T_world_ee[:3, :3].T @ way / np.linalg.norm(way)
    nearest = points_ee[np.argmin(np.linalg.norm(points_ee, axis=1))]
    return nearest / np.linalg.norm(nearest)


def _carry(patch: ContactPatch, Ts_world_ee: Array) -> ContactPatch:
    """Carry a patch from the end-effector frame to the world, averaged over the moments of a firm grasp."""
    normal = (Ts_world_ee[:, :3, :3] @ patch.normal).mean(0)
    return replace(
        patch, point=apply(Ts_world_ee, patch.point).mean(0), normal=normal / np.linalg.norm(normal)
    )


def _nearest(points_ee: Array) -> ContactPatch:
    """Take the part's point nearest to the end effector, for a robot without known fingers."""
    gap, index = cKDTree(points_ee).query(np.zeros(3))
    point = points_ee[index]
    normal = point / gap if gap > 1e-6 else np.array([0.0, 0.0, 1.0])
    return ContactPatch(
        finger="hand", point=point, normal=normal, spread_m=float(np.sqrt(3) * gap), gap_m=float(gap)
    )
