"""Measured errors of the stages before the motion, and their application to a true world."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import ndtr

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.camera import Camera
from aomgen.core.transforms import matrix_from_rotvec, similarity, transform
from aomgen.core.values import Array

# Quantiles of the tables below.
QUANTILES: Final = (0.01, 0.05, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99)


@dataclass(frozen=True, slots=True, kw_only=True)
class SolidStatistics:
    """Shapes of Gaussians and their distances from the true surface.

    Attributes:
        offsets_mm: Distance along the outward normal at `QUANTILES`; inside is negative.
        opacity: Opacity at `QUANTILES`.
        scales_m: Median standard deviations, thinnest first, [m].
        size_log_sd: Spread of the size, in logarithms.
        tilt_rad: Spread of the disc's normal about each axis, [rad].
    """

    offsets_mm: tuple[float, ...]
    opacity: tuple[float, ...] = (0.03, 0.05, 0.13, 0.24, 0.39, 0.54, 0.63, 0.78)
    scales_m: tuple[float, float, float] = (0.0009, 0.0032, 0.0066)
    size_log_sd: float = 0.6
    tilt_rad: float = 0.35

    def offsets_m(self, scores: Array) -> Array:
        """Compute offsets (N,), [m], from normal scores (N,)."""
        return 1e-3 * np.interp(ndtr(scores), QUANTILES, self.offsets_mm)

    def opacities(self, shares: Array) -> Array:
        """Compute opacities (N,) from shares (N,), 0..1."""
        return np.interp(shares, QUANTILES, self.opacity)


@dataclass(frozen=True, slots=True, kw_only=True)
class Upstream:
    """Errors of scene, camera and clock in AOMotion's input, standard deviations unless stated otherwise.

    Measured on seven finished runs (synthetic captures of 320x240 to 640x480 px, three arms): the scene's
    similarity against the true one, the fixed camera against the scene, the clock against the true one,
    and solid Gaussians of both parts against the true meshes.

    Attributes:
        rotation_deg: Rotation of the scene about each axis; measured size .01-.12, rms .073 in all.
        scale_pct: Scale error of the scene; measured .01-.12, rms .061.
        shift_mm: Shift of the scene at the object, along each axis; measured size .5-2.6, rms 1.6 in all.
        camera_mm: Shift of the camera against the scene, along each axis; measured size .4-2.6, rms 1.4 in
            all. The camera rotates with it, so that the object keeps its image position except for
        camera_px: this shift, along each axis (measured size .1-.7, rms .36 in all),
        roll_deg: and this rotation about its optical axis; measured rotations .02-.22, rms .12 in all.
        clock_ms: Error of the offset between video and log; measured .03-2.1, rms .98.
        clock_sd_ms: Standard deviation that the alignment states; 1.0 on six runs, 1.4 on one.
        walls, bars: Positions and sizes of Gaussians, on walls and on handles.
        patch_m, patch_share: Width of patches with a common error, and their share of the variance:
            neighbors within 6 mm correlate by .3-.5, beyond 25 mm not at all.
        floaters: Share of Gaussians that float before the surface; most of them fade during the fit of the
            colors. Measured: 4-5 % of the solid ones of a part are further than 10 mm from all of its object.
        floaters_mm: Their mean distance.
        border_mm, border_local_mm: Displacement of the border between the labels moving and static, as a
            whole and locally. Measured: 0-24 % of the moving part's solid Gaussians are labelled static
            (0-8 % of those further than 10 mm from the static part), 1-6 % of the static part's moving.
        strip_share: Probability that a strip of the other part along half of the border is included;
            measured: 6 % of the solid Gaussians labelled moving are further than 10 mm from the part on
            drawers, 15-19 % on microwaves.
        strip_mm: Width of that strip, uniform from 0.
        strangers: Share of the object's Gaussians that are labelled background; measured 0-8 %.
    """

    rotation_deg: float = 0.042
    scale_pct: float = 0.061
    shift_mm: float = 0.95
    camera_mm: float = 0.79
    camera_px: float = 0.25
    roll_deg: float = 0.06
    clock_ms: float = 0.98
    clock_sd_ms: float = 1.0
    walls: SolidStatistics = field(
        default_factory=lambda: SolidStatistics(offsets_mm=(-15.0, -8.0, -4.6, -2.4, 0.2, 4.4, 9.5, 22.0))
    )
    bars: SolidStatistics = field(
        default_factory=lambda: SolidStatistics(offsets_mm=(-6.0, -5.4, -4.1, -3.0, -1.5, 0.9, 1.9, 4.5))
    )
    patch_m: float = 0.010
    patch_share: float = 0.5
    floaters: float = 0.08
    floaters_mm: float = 15.0
    border_mm: float = 8.0
    border_local_mm: float = 12.0
    strip_share: float = 0.5
    strip_mm: float = 30.0
    strangers: float = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class Misplacement:
    """One sample of the errors of scene, camera and clock.

    Attributes:
        S_given_world: Similarity (4, 4) from the true scene to the given one.
        camera: The given camera.
        clock_s: Error of the clock offset, [s].
    """

    S_given_world: Array
    camera: Camera
    clock_s: float


def draw_misplacement(
    upstream: Upstream, camera: Camera, middle: Array, rng: np.random.Generator
) -> Misplacement:
    """Draw errors of scene, camera and clock.

    Args:
        upstream: Size of the errors.
        camera: The true camera.
        middle: Position of the object (3,), world frame, [m], about which the scene is rotated.
        rng: Generator of the errors.
    """
    R = matrix_from_rotvec(np.deg2rad(upstream.rotation_deg) * rng.standard_normal(3))
    scale = 1 + upstream.scale_pct / 100 * rng.standard_normal()
    shift = 1e-3 * upstream.shift_mm * rng.standard_normal(3)
    S = similarity(scale, R, middle + shift - scale * R @ middle)
    moved = _moved(upstream, camera, middle, rng)
    T_given_cam = S @ moved.T_world_cam
    T_given_cam[:3, :3] /= scale
    return Misplacement(
        S_given_world=S,
        camera=moved.move(T_given_cam),
        clock_s=1e-3 * upstream.clock_ms * rng.standard_normal(),
    )


def _moved(upstream: Upstream, camera: Camera, middle: Array, rng: np.random.Generator) -> Camera:
    """Displace the camera, and rotate it so that the object stays at nearly the same image position."""
    center = camera.center + 1e-3 * upstream.camera_mm * rng.standard_normal(3)
    before, after = middle - camera.center, middle - center
    turn = np.cross(before, after) / (np.linalg.norm(before) * np.linalg.norm(after))
    tilt = upstream.camera_px / camera.fx * rng.standard_normal(2)
    roll = np.deg2rad(upstream.roll_deg) * rng.standard_normal()
    R = matrix_from_rotvec(turn) @ camera.T_world_cam[:3, :3] @ matrix_from_rotvec(np.array([*tilt, roll]))
    return camera.move(transform(R, center))


def mislabelled(
    points: Array, labels: NDArray[np.uint8], upstream: Upstream, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Make labels (N,) as masks and votes give them: the border is moved, strips are included, some are lost.

    Args:
        points: True positions (N, 3), world frame, [m].
        labels: True labels (N,).
        upstream: Size of the errors.
        rng: Generator of the errors.
    """
    result = labels.copy()
    ours, others = np.flatnonzero(labels == MOVING), np.flatnonzero(labels == STATIC)
    both = np.concatenate([ours, others])
    if not len(ours) or not len(others):
        return result
    to_moving = cKDTree(points[ours]).query(points[others])[0]
    to_static = cKDTree(points[others]).query(points[ours])[0]
    # The depth is positive inside the moving part, negative outside.
    depth = np.concatenate([to_static, -to_moving])
    border = 1e-3 * upstream.border_mm * rng.standard_normal()
    border = border + 1e-3 * upstream.border_local_mm * _waves(points[both], rng)
    if rng.random() < upstream.strip_share:
        border = border + _strip(points[both], upstream, rng)
    result[both] = np.where(depth > border, MOVING, STATIC)
    lost = _waves(points[both], rng) > 2.0
    lost &= rng.random(len(both)) < upstream.strangers / 0.023
    result[both[lost]] = BACKGROUND
    return result


def _strip(points: Array, upstream: Upstream, rng: np.random.Generator) -> Array:
    """Draw the displacement of the border (N,), [m]: to one side along half of it."""
    direction = rng.standard_normal(3)
    heights = (points - points.mean(0)) @ (direction / np.linalg.norm(direction))
    sign = 1.0 if rng.random() < 0.5 else -1.0
    return np.where(heights > 0, sign * 1e-3 * rng.uniform(0, upstream.strip_mm), 0.0)


def _waves(points: Array, rng: np.random.Generator) -> Array:
    """Draw a smooth random field (N,) of unit variance, with waves of about 5 to 20 cm."""
    waves = rng.standard_normal((16, 3)) * (2 * np.pi / rng.uniform(0.05, 0.20, (16, 1)))
    phases = rng.uniform(0, 2 * np.pi, 16)
    return np.sqrt(2 / 16) * np.cos(points @ waves.T + phases).sum(1)
