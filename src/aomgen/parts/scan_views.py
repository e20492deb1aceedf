"""Scan images with masks: weights of Gaussians in masks, masks of labelled Gaussians, and labels of the robot."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import MOVING, STATIC
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.errors import BackendError
from aomgen.robots.robot import RobotConfiguration
from aomgen.segmentation.interface import Mask
from aomgen.splatting.rasterizer import contribution_weights, render

# Number of views whose masks are used.
VIEWS = 20
# Distance from a link within which a Gaussian belongs to it, [m]: scan noise plus alignment error; and within which it
# can belong to it: cables and housings that the model omits.
MAX_DISTANCE_M, LOOSE_DISTANCE_M = 0.02, 0.06
# Surface samples per square meter: about 4 mm apart, well below the distance above.
SAMPLES_PER_M2 = 60_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanView:
    """A scan image in the world frame, with the mask of the aligned robot."""

    name: str
    camera: Camera
    image_srgb: NDArray[np.uint8]
    robot: Mask


def spread(views: Sequence[ScanView]) -> list[ScanView]:
    """Select about `VIEWS` of the views, evenly in their order."""
    return list(views[:: max(1, len(views) // VIEWS)])


def lift(gaussians: Gaussians, view: ScanView, masks: list[Mask]) -> NDArray[np.float32]:
    """Compute the blended weight (N, M) of every Gaussian in each mask of one view."""
    return contribution_weights(gaussians, view.camera, np.stack(masks).astype(np.float32))


def render_parts(gaussians: Gaussians, labels: NDArray[np.uint8], camera: Camera) -> dict[int, Mask]:
    """Render the masks of static and moving part from their Gaussians, with occlusion."""
    features = np.stack([labels == STATIC, labels == MOVING], 1).astype(np.float32)
    shares = render(gaussians, camera, features=features).features
    if shares is None:
        raise BackendError("rasterizer", "rendered no features", "rebuild the engine")
    return {STATIC: shares[..., 0] > 0.5, MOVING: shares[..., 1] > 0.5}


def label_robot(
    gaussians: Gaussians, views: list[ScanView], configuration: RobotConfiguration, rng: np.random.Generator
) -> NDArray[np.int32]:
    """Find the robot body of each Gaussian: index (N,) into `robot.body_names`, -1 for none.

    Args:
        gaussians: The scan, world frame.
        views: Scan images with rendered robot masks.
        configuration: Robot as scanned.
        rng: Samples the robot's surface.
    """
    means = np.asarray(gaussians.means, np.float64)
    near, distances = nearest_links(means, configuration, rng, LOOSE_DISTANCE_M)
    inside, seen = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for view in spread(views):
        weights = lift(gaussians, view, [view.robot, ~view.robot])
        inside += weights[:, 0]
        seen += weights.sum(1)
    share = inside / np.maximum(seen, 1e-9)
    close = (share > 0.5) & (distances < MAX_DISTANCE_M)
    # A Gaussian on a thin finger extends well beyond the finger's outline.
    close |= (share > 0.25) & (distances < 0.5 * MAX_DISTANCE_M)
    # Rims outside the outline, and small Gaussians close to the model, belong to the robot as well.
    close |= (distances < 0.3 * MAX_DISTANCE_M) & (gaussians.scales.max(1) < MAX_DISTANCE_M)
    # Reflecting metal is reconstructed behind its surface: Gaussians inside the robot in all views belong to it.
    behind = (share > 0.85) & (distances < LOOSE_DISTANCE_M)
    # A Gaussian that no view shows is inside the robot if it is close to its surface.
    robot = (near >= 0) & np.where(seen > 0.05, close | behind, distances < 0.01)
    return np.where(robot, near, -1).astype(np.int32)


def nearest_links(
    points_world: Array,
    configuration: RobotConfiguration,
    rng: np.random.Generator,
    max_distance_m: float = MAX_DISTANCE_M,
) -> tuple[NDArray[np.int32], Array]:
    """Find the robot body nearest to each point, by distance to the visual meshes in the scanned configuration.

    Args:
        points_world: (N, 3), [m].
        configuration: Robot as scanned, fingers included.
        rng: Samples the meshes, about 4 mm apart.
        max_distance_m: Points farther away belong to no body.

    Returns:
        Index into `robot.body_names` (N,), -1 for none; and distances (N,) [m], infinite beyond
        the limit.
    """
    poses = configuration.robot.link_poses(configuration.joints[None], configuration.gripper)[0]
    samples, owners = [], []
    for mesh in configuration.robot.meshes:
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
