"""The paper's split of the robot's Gaussians: by the bounding boxes of the model's links."""

import numpy as np
from numpy.typing import NDArray

from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.robots.configuration import RobotConfiguration

# Gaussians lie some millimetres off the surface that they paint.
MARGIN_M = 0.005


def bodies_in_boxes(
    points_world: Array, configuration: RobotConfiguration, margin_m: float = MARGIN_M
) -> NDArray[np.int32]:
    """The robot body whose box holds each point.

    Boxes are those of the meshes along the axes of their body. Of several boxes the one counts in
    whose middle the point lies most.

    Args:
        points_world: (N, 3), [m].
        configuration: Robot as scanned.
        margin_m: Boxes are larger by this on every side.

    Returns:
        Index into `robot.body_names` (N,), -1 for points in no box.

    Source: AOMGen, sec. 4.2, "Robot". Not checked: whatever else stands in a box is taken as robot.
    """
    poses = configuration.robot.link_poses(configuration.joints[None], configuration.gripper)[0]
    owners = np.full(len(points_world), -1, np.int32)
    depth = np.ones(len(points_world))
    for body in sorted({mesh.body for mesh in configuration.robot.meshes}):
        vertices = np.concatenate(
            [mesh.vertices_body for mesh in configuration.robot.meshes if mesh.body == body]
        )
        low, high = vertices.min(0) - margin_m, vertices.max(0) + margin_m
        local = apply(invert(poses[body]), points_world)
        # 0 in the middle of the box, 1 on its faces.
        place = np.abs(2 * (local - low) / (high - low) - 1).max(1)
        nearer = place < depth
        owners[nearer], depth[nearer] = body, place[nearer]
    return owners
