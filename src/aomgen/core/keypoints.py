"""Five keypoints of an articulated object: grasp point, ends of the handle, and ends of the joint axis."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.joint import Joint
from aomgen.core.transforms import apply
from aomgen.core.values import Array

KEYPOINTS: Final = ("grasp", "handle_0", "handle_1", "axis_0", "axis_1")
# Number of leading keypoints that move with the part; the others stay on the joint axis.
MOVING_POINTS: Final = 3
# Coordinates that differ by less than this count as equal when two ends are ordered, [m].
SAME_M: Final = 1e-4
# Largest distance in depth between a keypoint and the visible surface around it, [m]: for points on the handle, which is thin,
# and for points on the joint axis, which is behind the edge of a door.
NEAR_M, NEAR_AXIS_M = 0.025, 0.06


def find_keypoints(asset: ArticulatedAsset) -> Array:
    """Find the keypoints (5, 3) of an asset at joint value 0, asset frame, [m].

    - grasp: the asset's handle point.
    - handle: the ends of the collider at the handle point, on the line through this point along the handle axis. The first
      end is the lower one; of horizontal handles, the one closer to the hinge, then the one with the smaller x and y.
    - axis: for a revolute joint, the ends of the moving part's extent along the joint axis; for a prismatic joint, the
      points at which the line through the center of the moving part along the axis enters and leaves its bounding box.
      The handle is not included in the extent. The first end is the lower one; of horizontal axes, the one with the
      smaller x, then the smaller y.
    """
    body = [box for box in asset.moving.colliders if not box.name.startswith("handle")]
    corners = np.concatenate([box.corners for box in body or asset.moving.colliders])
    bar = asset.handle_bar or min(asset.moving.colliders, key=lambda box: box.distance(asset.handle_point))
    joint, along = asset.joint, (bar.corners - asset.handle_point) @ asset.handle_axis
    handle = asset.handle_point + np.outer([along.min(), along.max()], asset.handle_axis)
    middle = joint.origin if joint.type == "revolute" else (corners.min(0) + corners.max(0)) / 2
    along = (corners - middle) @ joint.axis
    axis = middle + np.outer([along.min(), along.max()], joint.axis)
    hinge = [_axis_distances(joint, handle)] if joint.type == "revolute" else []
    handle = _order_ends(handle, [handle[:, 2], *hinge, handle[:, 0], handle[:, 1]])
    axis = _order_ends(axis, [axis[:, 2], axis[:, 0], axis[:, 1]])
    return np.concatenate([asset.handle_point[None], handle, axis])


def move_keypoints(keypoints: ArrayLike, joint: Joint, thetas: ArrayLike) -> Array:
    """Compute the positions (T, 5, 3) of keypoints at joint values.

    Args:
        keypoints: Keypoints (5, 3) at joint value 0, [m].
        joint: Joint in the frame of the keypoints.
        thetas: Joint values (T,), [rad] or [m].
    """
    closed = np.asarray(keypoints, np.float64)
    points = np.tile(closed, (np.size(thetas), 1, 1))
    points[:, :MOVING_POINTS] = apply(joint.motion(np.ravel(thetas))[:, None], closed[:MOVING_POINTS])
    return points


def project_keypoints(camera: Camera, points_world: Array) -> tuple[Array, Array]:
    """Project points (..., 3) to pixels (..., 2), [px], and depths (...,), [m]; points behind the camera get (-1, -1)."""
    pixels, depths = camera.project(points_world)
    return np.where(depths[..., None] > 0, pixels, -1.0), depths


def judge_visible(
    camera: Camera, points_world: Array, depth: NDArray[np.floating], labels: NDArray[np.uint8]
) -> NDArray[np.bool_]:
    """Determine which keypoints are visible in an image.

    A keypoint is visible if one of the 3 x 3 pixels around it shows the object at about the depth of the keypoint: the
    moving part for points on the handle, either part for points on the axis.

    Args:
        camera: Camera of the image.
        points_world: Keypoints (5, 3), world frame.
        depth: Depth of the image (H, W), [m].
        labels: Part labels of the image (H, W), see `conventions.PART_LABELS`.

    Returns:
        Mask (5,) of the visible keypoints.
    """
    pixels, depths = project_keypoints(camera, points_world)
    visible = np.zeros(len(points_world), bool)
    for k, ((u, v), distance) in enumerate(zip(pixels, depths, strict=True)):
        if not (0 <= u < camera.width and 0 <= v < camera.height):
            continue
        rows, columns = (slice(max(int(x) - 1, 0), int(x) + 2) for x in (v, u))
        near = np.abs(depth[rows, columns] - distance) < (NEAR_M if k < MOVING_POINTS else NEAR_AXIS_M)
        shown = labels[rows, columns]
        of_object = (shown == MOVING) | ((shown == STATIC) & (k >= MOVING_POINTS))
        visible[k] = (near & of_object).any()
    return visible


def _order_ends(ends: Array, keys: Sequence[Array]) -> Array:
    """Order two points (2, 3) by the first key (2,) in which they differ."""
    for key in keys:
        if abs(key[0] - key[1]) > SAME_M:
            return ends if key[0] < key[1] else ends[::-1]
    return ends


def _axis_distances(joint: Joint, points: Array) -> Array:
    """Compute the distances (N,) of points (N, 3) from a joint axis, [m]."""
    return np.linalg.norm(np.cross(points - joint.origin, joint.axis), axis=1)
