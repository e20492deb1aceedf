"""The paper's split of the robot's Gaussians: by the bounding boxes of the model's links."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.transforms import apply, invert
from aomgen.robots.robot import RobotConfiguration

# Boxes are larger by this on every side: Gaussians lie some millimetres off the surface that they paint.
MARGIN_M = 0.005


def bodies_in_boxes(points_world: ArrayLike, configuration: RobotConfiguration) -> NDArray[np.int32]:
    """The robot body (N,) whose box holds each point (N, 3), [m]: index into `robot.body_names`, -1 for none.

    Boxes are those of the meshes along the axes of their body. Of several boxes the one counts in
    whose middle the point lies most.

    Source: AOMGen, sec. 4.2, "Robot". Not checked: whatever else stands in a box is taken as robot.
    """
    points = np.asarray(points_world, np.float64)
    poses = configuration.robot.link_poses(configuration.joints[None], configuration.gripper)[0]
    owners = np.full(len(points), -1, np.int32)
    depth = np.ones(len(points))
    for body in sorted({mesh.body for mesh in configuration.robot.meshes}):
        vertices = np.concatenate(
            [mesh.vertices_body for mesh in configuration.robot.meshes if mesh.body == body]
        )
        low, high = vertices.min(0) - MARGIN_M, vertices.max(0) + MARGIN_M
        local = apply(invert(poses[body]), points)
        # 0 in the middle of the box, 1 on its faces.
        place = np.abs(2 * (local - low) / (high - low) - 1).max(1)
        nearer = place < depth
        owners[nearer], depth[nearer] = body, place[nearer]
    return owners
