"""Patches of a part that is between the pads of a gripper.

What is held is a piece with straight sides: a bar, a rim, a knob. The pads are nearly parallel planes, so each
touches it at the point that is nearest to it, which is decided by how the held face is turned against the pad.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze
from aomgen.robots.robot import FingerPad

# Reconstructed surfaces of thin things are off by this much, in the scan and by its alignment, [m].
SURFACE_SD_M = 0.002
# What is held may be turned against a pad by this much more than known, [rad]: about its length by the fit of the
# object's box, along it by what the pads give way until they lie on it, and on the face by the few points seen of it.
_ROLL_SD_RAD, _LEAN_SD_RAD, _WAY_SD_RAD = np.radians([1.0, 0.3, 5.0])
_TURNS = np.random.default_rng(0).normal(size=(100, 3)) * [_ROLL_SD_RAD, _LEAN_SD_RAD, _WAY_SD_RAD]
# What is between the pads may look thinner than their opening by this much on each side, [m].
_THINNER_M = 0.01
# Corners of a square.
_SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
# Lengths below this are none, [m].
_LEAST_M = 1e-9
# Points beyond these percentiles are strays.
_STRAYS = (5, 95)


@dataclass(frozen=True, slots=True, kw_only=True)
class Patch:
    """A touch of one finger, end-effector frame.

    Attributes:
        finger: Its name.
        point: Middle on the finger's surface (3,), [m].
        normal: Unit direction from the finger into the part (3,).
        covariance: Of the true middle about `point` (3, 3), [m^2].
        gap_m: Distance between finger and reconstructed part, [m].
    """

    finger: str
    point: Array
    normal: Array
    covariance: Array
    gap_m: float

    def __post_init__(self) -> None:
        for name in ("point", "normal"):
            freeze(self, name, getattr(self, name), (3,))
        freeze(self, "covariance", self.covariance, (3, 3))

    @property
    def spread_m(self) -> float:
        """Root mean square distance of the place from its middle, [m]."""
        return float(np.sqrt(np.trace(self.covariance)))


def find_grip_patches(
    pads: Sequence[FingerPad], Ts_ee_body: Array, points_ee: Array, axes_ee: Array
) -> tuple[Patch, ...]:
    """One patch on each pad of a gripper that holds the part; none if the part is not between its pads.

    Args:
        pads: Of the hand; fewer than two hold nothing.
        Ts_ee_body: Poses (B, 4, 4) of all bodies, end-effector frame.
        points_ee: Dense points of the part (N, 3), same frame, [m].
        axes_ee: Unit axes (3, 3) in rows of the object's box, same frame: held faces are across one of them.

    Not checked: a part whose thickness varies within the pads more than their opening does.
    """
    if len(pads) < 2:
        return ()
    faces = [_Face.of(pad, Ts_ee_body[pad.body]) for pad in pads[:2]]
    closing = faces[0].normal - faces[1].normal
    axis = axes_ee[np.argmax(np.abs(axes_ee @ closing))]
    patches = []
    for face, other in zip(faces, faces[::-1], strict=True):
        between = face.between(points_ee, other)
        if not len(between):
            return ()
        strip = _Strip.around(between[:, :2], float(face.openings(face.middle, other)))
        corners = strip.corners(face.half)
        low, high = np.percentile(between[:, 2], _STRAYS)
        closest = face.openings(face.placed(corners), other).min(initial=np.inf)
        if not 0 < closest <= high - low + 2 * _THINNER_M:
            return ()
        slopes = face.slope(axis), face.slope(closing)
        touches = [strip.touched(face.half, *slopes, turn) for turn in _TURNS]
        patches.append(face.patch(np.mean(touches, axis=0), corners, points_ee))
    return tuple(patches)


def assume_pad_patches(pads: Sequence[FingerPad], Ts_ee_body: Array, points_ee: Array) -> tuple[Patch, ...]:
    """One patch all over each pad, for a gripper that holds what the scan hardly saw; see `find_grip_patches`."""
    faces = [_Face.of(pad, Ts_ee_body[pad.body]) for pad in pads[:2]]
    return tuple(face.patch(np.zeros(2), _SQUARE * face.half, points_ee) for face in faces)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Face:
    """The inner face of a pad in the end-effector frame, and its half extents (2,), [m]."""

    finger: str
    T_face_ee: Array
    half: Array

    @staticmethod
    def of(pad: FingerPad, T_ee_body: Array) -> "_Face":
        T_ee_face = T_ee_body @ pad.T_body_pad
        T_ee_face[:3, 3] = apply(T_ee_body, pad.face_body)
        return _Face(finger=pad.finger, T_face_ee=invert(T_ee_face), half=pad.half_extents[:2])

    @property
    def normal(self) -> Array:
        """Towards the other pad (3,)."""
        return self.T_face_ee[2, :3]

    @property
    def middle(self) -> Array:
        """Of the face (3,), [m]."""
        return invert(self.T_face_ee)[:3, 3]

    def placed(self, flat: Array) -> Array:
        """Points (..., 2) of the face in the end-effector frame (..., 3)."""
        return self.middle + flat @ self.T_face_ee[:2, :3]

    def patch(self, touched: Array, corners: Array, points_ee: Array) -> Patch:
        """A patch at a point (2,) which may be anywhere between corners (C, 2), on a part of points (N, 3)."""
        # Even over the area about its middle, which is a third of what its corners say, and off that middle.
        middle = corners.mean(0)
        flat = (corners - middle).T @ (corners - middle) / (3 * len(corners)) + np.outer(
            middle - touched, middle - touched
        )
        rows = self.T_face_ee[:2, :3]
        covariance = rows.T @ flat @ rows + SURFACE_SD_M**2 * np.eye(3)
        gaps = cKDTree(points_ee).query(self.placed(np.vstack([corners, touched])))[0]
        return Patch(
            finger=self.finger,
            point=self.placed(touched),
            normal=self.normal,
            covariance=covariance,
            gap_m=float(gaps.min()),
        )

    def slope(self, axis_ee: Array) -> Array:
        """How fast (2,) a plane across an axis (3,) comes nearer along this face, [m/m]."""
        local = self.T_face_ee[:3, :3] @ axis_ee
        return local[:2] / local[2]

    def openings(self, points_ee: Array, other: "_Face") -> Array:
        """Distance (...) between both faces where points (..., 3) project on this one, [m]."""
        heights = apply(self.T_face_ee, points_ee)[..., 2]
        on_face = points_ee - heights[..., None] * self.normal
        return (other.middle - on_face) @ other.normal / float(self.normal @ other.normal)

    def between(self, points_ee: Array, other: "_Face") -> Array:
        """What of points (N, 3) is between both faces (K, 3), in this one's frame, as far beside as they are long."""
        local = apply(self.T_face_ee, points_ee)
        margin = 2 * SURFACE_SD_M
        within = (local[:, 2] > -margin) & (local[:, 2] < self.openings(points_ee, other) + margin)
        return local[within & np.all(np.abs(local[:, :2]) < self.half.max() + margin, axis=1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Strip:
    """The straight piece between the pads as it lies on a face.

    Attributes:
        middle: Of what was seen of it (2,), [m].
        angle: Its way on the face, [rad].
        half: Half its width, [m].
    """

    middle: Array
    angle: float
    half: float

    @staticmethod
    def around(flat: Array, depth_m: float) -> "_Strip":
        """The strip along points (N, 2): at least as deep as the pads are open, however little of its depth was seen."""
        center = flat.mean(0)
        way = np.linalg.eigh((flat - center).T @ (flat - center))[1][:, 1]
        angle = float(np.arctan2(way[1], way[0]))
        across = _frame(angle)[1]
        low, high = np.percentile((flat - center) @ across, _STRAYS)
        width = max(float(high - low), depth_m)
        return _Strip(middle=center + (high + low) / 2 * across, angle=angle, half=width / 2)

    def corners(self, half: Array) -> Array:
        """Corners (C, 2) of what is in front of it of a face of half extents (2,); none if nothing is, [m]."""
        square, across = _SQUARE * half, _frame(self.angle)[1]
        starts = (square - self.middle) @ across
        rises = np.roll(starts, -1) - starts
        rises[np.abs(rises) < _LEAST_M] = _LEAST_M
        shares = np.clip((np.array([[-self.half], [self.half]]) - starts) / rises, 0, 1)
        found = (square + shares[..., None] * (np.roll(square, -1, axis=0) - square)).reshape(-1, 2)
        return found[np.abs((found - self.middle) @ across) <= self.half + _LEAST_M]

    def touched(self, half: Array, side: Array, closing: Array, turn: Array) -> Array:
        """Where (2,) it touches a face of half extents (2,): of a plane, a corner is nearest.

        Args:
            half: Half extents of the face (2,), [m].
            side: Slope (2,) of the object's side, by which it is turned about its length.
            closing: Slope (2,) of what lies square in the closing hand, as it does along its length.
            turn: About its length, along it and on the face (3,), beyond what is known, [rad].
        """
        turned = replace(self, angle=self.angle + turn[2])
        way, across = _frame(turned.angle)
        slope = (side @ across + turn[0]) * across + (closing @ way + turn[1]) * way
        corners = turned.corners(half)
        return corners[np.argmax(corners @ slope)]


def _frame(angle: float) -> Array:
    """Unit directions along and across a way (2, 2) in rows."""
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
