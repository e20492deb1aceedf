"""Screening of a draw before planning: it must be on the table, in view and within reach."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from aomgen.core.boxes import OrientedBox
from aomgen.core.camera import Camera
from aomgen.core.demonstration import SupportPlane
from aomgen.core.plan import FittedAsset, OrbitChange, Rejection, Variation, measure_excess
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.episodes.variations import Ranges, inside
from aomgen.robots.robot import Reach

# An object may protrude this far beyond the table's estimated edge, [m].
OVERHANG_M: Final = 0.02
# Share of the object that each camera must show, 0..1: a corner may be cut off.
LEAST_IN_VIEW: Final = 0.85
# Part of the longest reach at which an arm can still rotate its end effector, 0..1.
USEFUL_REACH: Final = 0.9
# Number of joint values at which the held point is tested, from the first to the last planned one.
SAMPLED_VALUES: Final = 5
# Name of added cameras, with their number.
FREE_CAMERA: Final = "free{}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Criteria for draws: ranges, table, obstacles, the robot's reach, and the scene's cameras."""

    ranges: Ranges
    support: SupportPlane
    obstacles: tuple[OrientedBox, ...]
    reach: Reach
    cameras: Mapping[str, Camera]
    free: int = 0

    def views(self, variation: Variation, fitted: FittedAsset) -> dict[str, Camera]:
        """Return the cameras of an episode, world frame: the scene's, moved as drawn, and the added ones."""
        recorded = apply(fitted.T_world_asset, fitted.contact_asset)
        now = apply(variation.place_at(fitted), fitted.contact_asset)
        changes = variation.orbits or (OrbitChange(),) * len(self.cameras)
        views = {
            name: orbit_camera(camera, recorded, change)
            for (name, camera), change in zip(self.cameras.items(), changes, strict=False)
        }
        first = next(iter(self.cameras.values()))
        for number, change in enumerate(changes[len(self.cameras) :]):
            aimed = first.move(_aim_camera(first, now))
            views[FREE_CAMERA.format(number)] = orbit_camera(aimed, now, change)
        return views

    def screen(self, variation: Variation, fitted: FittedAsset) -> Rejection | None:
        """Screen a draw: the result of `find_obstruction`, "out_of_view", or None if it is worth planning."""
        barred = self.find_obstruction(variation, fitted)
        if barred is not None:
            return barred
        T = variation.place_at(fitted)
        held = _held(fitted, T)
        for name, camera in self.views(variation, fitted).items():
            share = measure_visible_share(camera, held, _corners(fitted, T))
            if not share >= LEAST_IN_VIEW:
                return Rejection(
                    reason="out_of_view",
                    detail=f"camera {name} shows {share:.0%} of the action, limit {LEAST_IN_VIEW:.0%}",
                    metrics={"in_view": share},
                    excess=measure_excess(share, LEAST_IN_VIEW),
                )
        return None

    def find_obstruction(self, variation: Variation, fitted: FittedAsset) -> Rejection | None:
        """Find why a pose is unusable: "outside_area", "off_table", "blocked" or "out_of_reach"."""
        T = variation.place_at(fitted)
        if self.ranges.polygon and not inside(self.ranges.polygon, np.array([variation.x, variation.y])):
            return Rejection(reason="outside_area", detail="the position is outside the given area")
        over_m = self._overhang_m(fitted, T)
        if not over_m <= OVERHANG_M:
            return Rejection(
                reason="off_table",
                detail=f"protrudes {100 * over_m:.0f} cm beyond the table's edge, limit {100 * OVERHANG_M:.0f} cm",
                metrics={"overhang_m": over_m},
                excess=measure_excess(over_m, OVERHANG_M),
            )
        covered = next((box for box in self.obstacles if stands_in(fitted, T, box)), None)
        if covered is not None:
            x, y = covered.T_world_box[:2, 3]
            return Rejection(
                reason="blocked",
                detail=f"an obstacle of the scene is there, at about x = {x:.2f} m, y = {y:.2f} m",
            )
        far_m = float(np.linalg.norm(_held(fitted, T) - self.reach.shoulder_world, axis=1).max())
        useful_m = USEFUL_REACH * self.reach.reach_m
        if not far_m <= useful_m:
            return Rejection(
                reason="out_of_reach",
                detail=f"the handle is {far_m:.2f} m from the shoulder, limit {useful_m:.2f} m",
                metrics={"distance_m": far_m},
                excess=measure_excess(far_m, useful_m),
            )
        return None

    def _overhang_m(self, fitted: FittedAsset, T_world_object: Array) -> float:
        """Compute the distance beyond the table, [m]; the recorded location counts as part of the table."""
        recorded, corners = (_footprint(fitted, T) for T in (fitted.T_world_asset, T_world_object))
        low = np.minimum(self.support.low_xy, recorded.min(0))
        high = np.maximum(self.support.high_xy, recorded.max(0))
        return float(max((low - corners).max(), (corners - high).max(), 0.0))


def orbit_camera(camera: Camera, target_world: Array, change: OrbitChange) -> Camera:
    """Move a camera about a point (3,), which keeps its position in the image."""
    if change == OrbitChange():
        return camera
    turned = matrix_from_rotvec(np.array([0.0, 0.0, change.turn]))
    # A camera's y axis points down: a rotation about its x axis by a negative angle raises the camera.
    tilted = matrix_from_rotvec(-change.tilt * camera.T_world_cam[:3, 0])
    R = turned @ tilted
    eye = target_world + change.distance * (R @ (camera.center - target_world))
    return camera.move(transform(R @ camera.T_world_cam[:3, :3], eye))


def measure_visible_share(camera: Camera, held_world: Array, corners_world: Array) -> float:
    """Measure the visible share 0..1 of the box of corners (N, 3); 0 if a held point (M, 3) is hidden."""
    size = np.array([camera.width, camera.height])
    pixels, depths = camera.project(held_world)
    if not (np.all(depths > 0) and np.all(pixels >= 0) and np.all(pixels <= size)):
        return 0.0
    pixels, depths = camera.project(corners_world)
    if not np.all(depths > 0):
        return 0.0
    low, high = pixels.min(0), pixels.max(0)
    within = np.clip(high, 0, size) - np.clip(low, 0, size)
    return float(np.prod(within) / np.prod(high - low))


def _aim_camera(camera: Camera, target_world: Array) -> Array:
    """Shift a camera pose (4, 4) so that a point (3,) is in the center of its image, at the same distance."""
    R = camera.T_world_cam[:3, :3]
    ray = R @ np.array(
        [(camera.width / 2 - camera.cx) / camera.fx, (camera.height / 2 - camera.cy) / camera.fy, 1.0]
    )
    depth = (target_world - camera.center) @ R[:, 2]
    return transform(R, target_world - depth * ray)


def _held(fitted: FittedAsset, T_world_object: Array) -> Array:
    """Compute positions of the handle (N, 3) while the part moves, world frame."""
    thetas = np.linspace(fitted.start_theta, fitted.target_theta, SAMPLED_VALUES)
    return apply(T_world_object @ fitted.asset.joint.motion(thetas), fitted.contact_asset[None])


def stands_in(fitted: FittedAsset, T_world_object: Array, box: OrientedBox) -> bool:
    """Return whether the static part and an upright box overlap: no side of either separates them."""
    sides = np.concatenate([T_world_object[:2, :2], box.T_world_box[:2, :2]], axis=1)
    mine, others = _footprint(fitted, T_world_object) @ sides, box.corners()[:, :2] @ sides
    return bool(((mine.max(0) > others.min(0)) & (others.max(0) > mine.min(0))).all())


def _footprint(fitted: FittedAsset, T_world_object: Array) -> Array:
    """Compute corners of the static part seen from above (N, 2), world frame, [m]."""
    feet = np.concatenate([box.corners for box in fitted.asset.static.colliders])
    return apply(T_world_object, feet)[:, :2]


def _corners(fitted: FittedAsset, T_world_object: Array) -> Array:
    """Compute corners of the closed object's colliders (N, 3), world frame."""
    boxes = (*fitted.asset.static.colliders, *fitted.asset.moving.colliders)
    return apply(T_world_object, np.concatenate([box.corners for box in boxes]))
