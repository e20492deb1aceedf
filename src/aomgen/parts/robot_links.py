"""Which link of the robot carries each Gaussian."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.robots.configuration import RobotPosture

# Distance from a link within which a Gaussian belongs to it, [m]: scan noise plus alignment error.
MAX_DISTANCE_M = 0.02
# Surface samples a square metre: about 4 mm apart, well below the distance above.
SAMPLES_PER_M2 = 60_000.0


def nearest_links(
    points_world: Array,
    posture: RobotPosture,
    rng: np.random.Generator,
    max_distance_m: float = MAX_DISTANCE_M,
) -> tuple[NDArray[np.int32], Array]:
    """The robot body nearest to each point, by distance to the posed visual meshes.

    Args:
        points_world: (N, 3), [m].
        posture: Robot as scanned, fingers included.
        rng: Spreads samples over the meshes, about 4 mm apart.
        max_distance_m: Points farther away belong to no body.

    Returns:
        Index into `robot.body_names` (N,), -1 for none; and distances (N,) [m], infinite beyond
        the limit.
    """
    poses = posture.robot.link_poses(posture.joints[None], posture.gripper)[0]
    samples, owners = [], []
    for mesh in posture.robot.meshes:
        area = face_normals_areas(mesh.vertices_body, mesh.faces)[1].sum()
        if not area > 0:
            continue
        count = max(30, int(area * SAMPLES_PER_M2))
        points, _, _ = sample_surface(mesh.vertices_body, mesh.faces, count, rng)
        samples.append(apply(poses[mesh.body], points))
        owners.append(np.full(count, mesh.body, np.int32))
    distances, nearest = cKDTree(np.concatenate(samples)).query(
        points_world, distance_upper_bound=max_distance_m
    )
    owners_padded = np.append(np.concatenate(owners), np.int32(-1))
    return owners_padded[nearest].astype(np.int32), np.asarray(distances, np.float64)
