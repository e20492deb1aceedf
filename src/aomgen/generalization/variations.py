"""New places for the object, spread evenly and reproducible from a seed and an index.

Source: AOMGen, sec. 5.2 (ranges of x, y and yaw).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from aomgen.core.camera import Camera
from aomgen.core.demonstration import SupportPlane
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel

# An object may stand this far beyond the table's estimated edge, [m].
OVERHANG_M = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseRanges:
    """Ranges about the recorded object's pose.

    Attributes:
        x_m, y_m: Along the world's axes, [m].
        yaw_deg: About the vertical, [deg].
    """

    x_m: tuple[float, float] = (-0.05, 0.30)
    y_m: tuple[float, float] = (-0.05, 0.05)
    yaw_deg: tuple[float, float] = (-45.0, 45.0)


def variations(seed: int, ranges: PoseRanges) -> Iterator[Variation]:
    """An endless low-discrepancy sequence; number i depends on the seed and i alone.

    Source: Halton's sequence, scrambled (Owen, 2017).
    """
    lows, highs = np.array([ranges.x_m, ranges.y_m, np.deg2rad(ranges.yaw_deg)]).T
    sequence = qmc.Halton(3, scramble=True, rng=np.random.default_rng(seed))
    index = 0
    while True:
        x, y, yaw = lows + sequence.random(1)[0] * (highs - lows)
        yield Variation(seed=seed, index=index, x=float(x), y=float(y), yaw=float(yaw))
        index += 1


def longest_reach(robot: RobotModel, samples: int = 2000) -> tuple[Array, float]:
    """Point about which the arm reaches farthest (3,), and how far its end effector gets, [m].

    The point is the highest one on the first joint's line that keeps the farthest sampled
    pose nearest, which for most arms is the shoulder.
    """
    rng = np.random.default_rng(0)
    low, high = np.clip(robot.joint_limits, -np.pi, np.pi).T
    joints = rng.uniform(low, high, (samples, len(low)))
    points = robot.ee_poses(joints)[:, :3, 3]
    foot = float(robot.link_poses(joints[:1], 0.0)[0, 0, 2, 3])
    heights = foot + np.linspace(0.0, 0.5, 26)
    middle = np.median(points[:, :2], axis=0)
    centres = np.array([[middle[0], middle[1], height] for height in heights])
    farthest = np.array([np.linalg.norm(points - centre, axis=1).max() for centre in centres])
    best = int(np.argmin(farthest))
    return centres[best], float(farthest[best])


def worth_trying(
    variation: Variation, fitted: FittedAsset, support: SupportPlane, shoulder_world: Array, reach_m: float
) -> bool:
    """Whether the held point stays within reach and the object on the known table.

    A coarse filter before planning: pads at arm's length leave no freedom of orientation, so nine
    tenths of the longest reach count.
    """
    T = variation.placed(fitted)
    moved = fitted.asset.joint.motion(fitted.target_theta * np.linspace(0, 1, 5))
    held = apply(T @ moved, fitted.contact_asset[None])
    if not np.linalg.norm(held - shoulder_world, axis=1).max() <= 0.9 * reach_m:
        return False
    # The recorded object stood on the table, so its place belongs to it whatever the estimate says.
    recorded = _footprint(fitted, fitted.T_world_asset)
    low = np.minimum(support.low_xy, recorded.min(0)) - OVERHANG_M
    high = np.maximum(support.high_xy, recorded.max(0)) + OVERHANG_M
    corners = _footprint(fitted, T)
    return bool(np.all(corners >= low) and np.all(corners <= high))


def _footprint(fitted: FittedAsset, T_world_object: Array) -> Array:
    """Corners of the static part seen from above (N, 2), world frame, [m]."""
    feet = np.concatenate([box.corners for box in fitted.asset.static.colliders])
    return apply(T_world_object, feet)[:, :2]


def in_view(variation: Variation, fitted: FittedAsset, camera: Camera, least_share: float) -> bool:
    """Whether a camera shows the action: the held point always, and most of the object.

    Args:
        variation: Where the object stands.
        fitted: The object and its planned motion.
        camera: World frame.
        least_share: Of the closed object's outline box that must lie inside the image, 0..1.
    """
    T = variation.placed(fitted)
    moved = T @ fitted.asset.joint.motion(fitted.target_theta * np.linspace(0, 1, 5))
    held, depths = camera.project(apply(moved, fitted.contact_asset[None]))
    size = np.array([camera.width, camera.height])
    if not (np.all(depths > 0) and np.all(held >= 0) and np.all(held <= size)):
        return False
    boxes = (*fitted.asset.static.colliders, *fitted.asset.moving.colliders)
    pixels, _ = camera.project(apply(T, np.concatenate([box.corners for box in boxes])))
    low, high = pixels.min(0), pixels.max(0)
    inside = np.clip(high, 0, size) - np.clip(low, 0, size)
    return bool(np.prod(inside) >= least_share * np.prod(high - low))
