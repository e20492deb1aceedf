"""Patches of a part that is between the pads of a gripper."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze
from aomgen.motion.bar import Ways, swept_bar
from aomgen.physics.robot_parts import FingerPad

# Reconstructed surfaces of thin things are off by this much, in the scan and by its alignment, [m].
SURFACE_SD_M = 0.002
# Pads give way by 0.1 mm where they press: 40 N on 3 cm^2 of a rubber of 5 MPa, 4 mm thick. Under load they
# stand about half as slanted as the gripper's table says, so that in its terms they give half of that, [m].
SOFT_M = 5e-5
# What is between the pads may look thinner than their opening by this much on each side, [m].
_THINNER_M = 0.01
_GRID = 61
# The sides of a bar are known to this angle: the object's yaw to 2.5 degrees, the pads' slant to 1.5, [rad].
_ROLL_SD_RAD = float(np.radians(3.0))
# A bar lies in the pads' plane to 30 degrees, or it would turn the hand.
_IN_PLANE = float(np.cos(np.radians(30.0)))
# A bar is followed this far beside the pads, [m].
_BESIDE_M = 0.05
# Places with less than this share of the most matter hold strays of the surface behind.
_INSIDE = 0.3
# Of what is between the pads, this much is in front of its surface by chance, [%].
_NEAR_PERCENT = 10.0


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


def held_patches(
    pads: Sequence[FingerPad], Ts_ee_body: Array, points_ee: Array, axes_ee: Array
) -> tuple[Patch, ...]:
    """One patch on each pad of a gripper that holds the part; none if the part is not between its pads.

    The pads of a closing gripper are not quite parallel, so they press where the part reaches into the
    narrowest of the space between them, as far as they give way. Where the part is comes from its
    points; how thick it is there does not, as thin things are reconstructed too thin.

    Args:
        pads: Of the hand; fewer than two hold nothing.
        Ts_ee_body: Poses (B, 4, 4) of all bodies, end-effector frame.
        points_ee: Dense points of the part (N, 3), same frame, [m].
        axes_ee: Unit axes (3, 3) in rows of the object's box, same frame: sides of a bar are across them.

    Not checked: a part whose thickness varies within the pads more than their opening does.
    """
    if len(pads) < 2:
        return ()
    faces = [_Face.of(pad, Ts_ee_body[pad.body]) for pad in pads[:2]]
    closing = faces[0].normal - faces[1].normal
    flatness = _flatness(closing / np.linalg.norm(closing), axes_ee)
    patches = []
    for face, other in zip(faces, faces[::-1], strict=True):
        openings = face.openings(face.grid, other)
        matter = face.matter(points_ee, other, axes_ee, flatness)
        if not (len(matter) and openings.min() > 0):
            return ()
        covered = face.covered(matter)
        inside = covered > _INSIDE
        if not (openings[inside].min() <= _thickness(matter) + 2 * _THINNER_M):
            return ()
        patches.append(_pressed(face, openings, covered, inside, points_ee))
    return tuple(patches)


def unseen_patches(pads: Sequence[FingerPad], Ts_ee_body: Array, points_ee: Array) -> tuple[Patch, ...]:
    """One patch all over each pad, for a gripper that holds what the scan hardly saw; see `held_patches`."""
    faces = [_Face.of(pad, Ts_ee_body[pad.body]) for pad in pads[:2]]
    even = np.ones(_GRID**2)
    return tuple(_pressed(face, even, even, even > 0, points_ee) for face in faces)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Face:
    """The inner face of a pad in the end-effector frame, and a grid (G, 3) over it."""

    finger: str
    T_face_ee: Array
    half: Array
    grid: Array

    @staticmethod
    def of(pad: FingerPad, T_ee_body: Array) -> "_Face":
        T_ee_face = T_ee_body @ pad.T_body_pad
        T_ee_face[:3, 3] = apply(T_ee_body, pad.face_body)
        steps = np.linspace(-1, 1, _GRID)
        u, v = (mesh.ravel() for mesh in np.meshgrid(steps, steps))
        flat = np.stack([u * pad.half_extents[0], v * pad.half_extents[1], np.zeros(len(u))], 1)
        return _Face(
            finger=pad.finger,
            T_face_ee=invert(T_ee_face),
            half=pad.half_extents[:2],
            grid=apply(T_ee_face, flat),
        )

    @property
    def normal(self) -> Array:
        """Towards the other pad (3,)."""
        return self.T_face_ee[2, :3]

    @property
    def middle(self) -> Array:
        """Of the face (3,), [m]."""
        return invert(self.T_face_ee)[:3, 3]

    def openings(self, points_ee: Array, other: "_Face") -> Array:
        """Distance (N,) between both faces where points (N, 3) project on this one, [m]."""
        heights = apply(self.T_face_ee, points_ee)[:, 2]
        on_face = points_ee - heights[:, None] * self.normal
        return (other.middle - on_face) @ other.normal / float(self.normal @ other.normal)

    def matter(self, points_ee: Array, other: "_Face", axes_ee: Array, flatness: float) -> Array:
        """What of points (N, 3) is between both faces (K, 3), in this one's frame; a bar as `swept_bar`."""
        local = apply(self.T_face_ee, points_ee)
        margin = 2 * SURFACE_SD_M
        between = (local[:, 2] > -margin) & (local[:, 2] < self.openings(points_ee, other) + margin)
        near = local[between & np.all(np.abs(local[:, :2]) < self.half + _BESIDE_M, axis=1)]
        opening = float(np.median(self.openings(self.grid, other)))
        bars = (
            swept_bar(near, self.half, ways, opening, flatness) for ways in (self.ways(axes_ee), Ways.any())
        )
        bar = next((bar for bar in bars if bar is not None), None)
        matter = near if bar is None else bar
        return matter[np.all(np.abs(matter[:, :2]) < self.half + margin, axis=1)]

    def ways(self, axes_ee: Array) -> Ways:
        """Directions in the face's plane of those unit axes (A, 3) that lie nearly in it."""
        flat = axes_ee @ self.T_face_ee[:2, :3].T
        lengths = np.linalg.norm(flat, axis=1)
        in_plane = lengths > _IN_PLANE
        return Ways(directions=flat[in_plane] / lengths[in_plane, None], sd_rad=_ROLL_SD_RAD)

    def covered(self, matter: Array) -> Array:
        """How much of the near side of matter (K, 3) is in front of the grid (G,), as a share of the most, 0..1."""
        behind = np.maximum(matter[:, 2] - np.percentile(matter[:, 2], _NEAR_PERCENT), 0)
        # The grid is the product of two rows of steps, and so are the weights over it.
        places = np.linspace(-1, 1, _GRID)[:, None] * self.half[:, None, None]
        u, v = np.exp(-0.5 * ((places - matter.T[:2, None]) / SURFACE_SD_M) ** 2)
        density = (v * np.exp(-0.5 * (behind / SURFACE_SD_M) ** 2) @ u.T).ravel()
        return density / max(float(density.max()), 1e-12)


def _flatness(normal: Array, axes: Array) -> float:
    """How likely a side of a bar with the part's axes (3, 3) lies flat against a face, 0..1."""
    roll = np.arccos(min(float(np.abs(axes @ normal).max()), 1.0))
    return float(np.exp(-0.5 * (roll / _ROLL_SD_RAD) ** 2))


def _thickness(matter: Array) -> float:
    low, high = np.percentile(matter[:, 2], [5, 95])
    return float(high - low)


def _pressed(
    face: _Face, openings: Array, covered: Array, inside: NDArray[np.bool_], points_ee: Array
) -> Patch:
    """The patch where the part is (covered) and the pads are close, as far as both give way."""
    slack = openings - openings[inside].min()
    weights = covered * np.clip(1 - slack / (2 * SOFT_M), 0, 1)
    weights /= weights.sum()
    point = weights @ face.grid
    # The pads may give way more than assumed: the middle of all that is covered is as possible.
    spread = face.grid - point
    covariance = (spread * (covered / covered.sum())[:, None]).T @ spread + SURFACE_SD_M**2 * np.eye(3)
    gap = float(cKDTree(points_ee).query(face.grid[inside])[0].min())
    return Patch(finger=face.finger, point=point, normal=face.normal, covariance=covariance, gap_m=gap)
