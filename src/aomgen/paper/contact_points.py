"""The nearest pair between robot and part when the motion begins, and where the robot carries it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.recording import JointLog
from aomgen.core.transforms import apply
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.errors import InputError
from aomgen.robots.robot import RobotModel

# As dense as the Gaussians of a scanned robot, and denser than those of the part, [m].
SPACING_M = 0.003


@dataclass(frozen=True, slots=True, kw_only=True)
class NearestPair:
    """Contact point on either side.

    Attributes:
        body: Robot body that touches, an index into `RobotModel.body_names`.
        point_body: Contact point on it (3,), body frame, [m].
        on_robot: The same at the start of the motion (3,), world frame, [m].
        on_part: Contact point on the moving part (3,), world frame, [m].
    """

    body: int
    point_body: Vector3
    on_robot: Vector3
    on_part: Vector3

    __post_init__ = freeze_arrays

    @property
    def gap_m(self) -> float:
        """Distance between the two, [m]."""
        return float(np.linalg.norm(self.on_part - self.on_robot))


def nearest_pair(
    robot: RobotModel, log: JointLog, points_moving: Array, start_log_s: float, rng: np.random.Generator
) -> NearestPair:
    """The point of the robot that is nearest to the part at one moment, and the part's point there.

    Args:
        robot: Kinematics and meshes, whose surfaces stand for the paper's robot Gaussians.
        log: The joint log.
        points_moving: Points of the part at its scanned place (N, 3), world frame, [m].
        start_log_s: Start of the motion, log clock, [s].
        rng: Spreads points over the robot's meshes.

    Raises:
        InputError: The robot has no meshes.

    Source: AOMGen, sec. 4.2, "Contact Point Detection". Not checked: that the two touch; `gap_m` tells.
    """
    poses = robot.link_poses(*log.at([start_log_s]))[0]
    tree = cKDTree(points_moving)
    best: NearestPair | None = None
    for mesh in robot.meshes:
        _, areas = face_normals_areas(mesh.vertices_body, mesh.faces)
        count = max(1, round(float(areas.sum()) / SPACING_M**2))
        points_body, _, _ = sample_surface(mesh.vertices_body, mesh.faces, count, rng)
        points = apply(poses[mesh.body], points_body)
        gaps, partners = tree.query(points, distance_upper_bound=best.gap_m if best else np.inf)
        nearest = int(np.argmin(gaps))
        if np.isfinite(gaps[nearest]):
            best = NearestPair(
                body=mesh.body,
                point_body=points_body[nearest],
                on_robot=points[nearest],
                on_part=points_moving[partners[nearest]],
            )
    if best is None:
        raise InputError("robot model", "has no meshes", "give a model with visual meshes")
    return best


def contact_path(pair: NearestPair, robot: RobotModel, log: JointLog, log_times_s: Array) -> Array:
    """Where the robot carries its contact point (T, 3), world frame, [m]; the paper's trajectory."""
    return apply(robot.link_poses(*log.at(log_times_s))[:, pair.body], pair.point_body)
