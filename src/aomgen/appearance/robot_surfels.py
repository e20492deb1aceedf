"""Surface of the robot from its model, with colors from all images of the capture.

A scan shows the robot in one joint configuration and from one side: undersides are missing, outlines are ragged, and the colors
include the light. The model's surface is complete.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.appearance.robot_shading import RobotDiscs, fit_robot_colors
from aomgen.appearance.surfel_observations import SurfelObservations, observe_surfels, pixel_size
from aomgen.conventions import ROBOT
from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.light import light_from_harmonics, open_transfer
from aomgen.core.mesh import Mesh, face_normals_areas
from aomgen.robots.robot import RobotModel
from aomgen.splatting.surfels import Surfels, surfels_of
from aomgen.twin.relighting import Relit
from aomgen.twin.twin import PosedImages, TwinModel

# Distance between discs in the images, [px], unless their number exceeds its limits.
SPACING_PX: Final = 2.0
# Least and largest number of discs: covers a small robot, keeps episodes fast.
COUNTS: Final = (12_000, 40_000)
# Least number of discs for each body and material, so that small parts have closed surfaces.
MIN_PER_BODY: Final = 120
# Distance from the model beyond which opaque scanned Gaussians are objects that the model does not contain, such as cables, [m].
# Nearer ones are blur of the same surface.
ATTACHED_M: Final = 0.012
# Least number of observations of the robot; with fewer, it keeps its scanned Gaussians.
MIN_OBSERVATIONS: Final = 200


def replace_robot_gaussians(
    twin: TwinModel, robot: RobotModel, views: Sequence[PosedImages], rng: np.random.Generator
) -> TwinModel:
    """Replace the scanned Gaussians of the robot by surfels on its model.

    The views of the scan and of the demonstration have the same exposure. The twin is not changed if the model has no meshes
    or the images hardly show it.
    """
    if not robot.meshes or not views:
        return twin
    pixel_m = pixel_size(robot, twin, views)
    cover = _cover(robot, pixel_m, rng)
    bare = _with_cover(twin, cover)
    observations = observe_surfels(bare, robot, views)
    if not len(observations.disc) >= MIN_OBSERVATIONS:
        return twin
    cover = _orient_normals(cover, observations)
    relit, specular_sh = fit_robot_colors(observations, cover)
    count = len(bare.gaussians) - len(cover.bodies)
    sh = np.array(bare.gaussians.with_sh_degree(max(bare.gaussians.sh_degree, 2)).sh)
    sh[count:, 1:9] = specular_sh
    relit = replace(relit, indices=count + relit.indices)
    return replace(bare, gaussians=bare.gaussians.with_sh(sh), relit=relit)


def _cover(robot: RobotModel, pixel_m: float, rng: np.random.Generator) -> RobotDiscs:
    """Cover every body with discs; the materials are the distinct colors of the model."""
    palette, material_of = np.unique(
        np.round([mesh.color_srgb for mesh in robot.meshes], 4), axis=0, return_inverse=True
    )
    body_of = np.array([mesh.body for mesh in robot.meshes])
    areas = np.array([face_normals_areas(m.vertices_body, m.faces)[1].sum() for m in robot.meshes])
    count = np.clip(areas.sum() / (SPACING_PX * pixel_m) ** 2, *COUNTS)
    pieces, normals, bodies, materials = [], [], [], []
    for body, material in product(np.unique(body_of), range(len(palette))):
        mine = np.flatnonzero((body_of == body) & (material_of == material))
        if not areas[mine].sum() > 0:
            continue
        share = areas[mine].sum() / areas.sum()
        meshes = [_plain_mesh(robot, i) for i in mine]
        surfels = surfels_of(meshes, max(int(count * share), MIN_PER_BODY), rng)
        pieces.append(_inset_discs(surfels, pixel_m))
        normals.append(surfels.normals)
        bodies.append(np.full(len(surfels.gaussians), body + 1, np.int32))
        materials.append(np.full(len(surfels.gaussians), material, np.int32))
    return RobotDiscs(
        gaussians=concatenate(pieces),
        normals=np.concatenate(normals).astype(np.float64),
        bodies=np.concatenate(bodies),
        materials=np.concatenate(materials),
    )


def _inset_discs(surfels: Surfels, depth_m: float) -> Gaussians:
    """Move discs by one pixel below the surface, and by less where the body is thin.

    The rasterizer widens each disc by about half a pixel, and many opaque discs that overlap at an outline widen it
    further.
    """
    places = np.asarray(surfels.gaussians.means, np.float64)
    normals = np.asarray(surfels.normals, np.float64)
    # Discs with an opposite normal, at this depth directly below, belong to the other side of the body.
    tree = cKDTree(places)
    room = np.full(len(places), depth_m)
    for depth in np.array([2.0, 1.5, 1.0, 0.5]) * depth_m:
        _, nearest = tree.query(places - normals * depth)
        opposed = np.einsum("ni,ni->n", normals, normals[nearest]) < 0
        room[opposed] = np.minimum(room[opposed], depth / 3)
    return replace(surfels.gaussians, means=places - normals * room[:, None])


def _plain_mesh(robot: RobotModel, index: int) -> Mesh:
    mesh = robot.meshes[index]
    return Mesh(
        name=str(index),
        vertices=mesh.vertices_body,
        faces=mesh.faces,
        uvs=np.zeros((0, 3, 2)),
        texture_srgb=np.zeros((0, 0, 3), np.uint8),
        color_srgb=mesh.color_srgb,
    )


def _with_cover(twin: TwinModel, cover: RobotDiscs) -> TwinModel:
    """Replace the scanned Gaussians near the robot model by discs under uniform light."""
    kept = ~((twin.labels == ROBOT) & (twin.bodies > 0)) | _is_attached(twin, cover)
    rest = twin.select(kept)
    count = len(cover.gaussians)
    relit = Relit(
        indices=len(rest.gaussians) + np.arange(count),
        albedo_linear=np.ones((count, 3), np.float32),
        transfer=open_transfer(cover.normals),
        light_of=cover.materials,
        lights=(light_from_harmonics(np.eye(9, 3)),) * (int(cover.materials.max()) + 1),
    )
    return rest.extend(cover.gaussians, cover.bodies, ROBOT, relit=relit)


def _is_attached(twin: TwinModel, cover: RobotDiscs) -> NDArray[np.bool_]:
    """Mark the scanned Gaussians (N,) of a link that the model does not contain."""
    attached = np.zeros(len(twin.gaussians), bool)
    for body in np.unique(cover.bodies):
        mine = np.flatnonzero((twin.labels == ROBOT) & (twin.bodies == body))
        surface = cover.gaussians.means[cover.bodies == body]
        distances, _ = cKDTree(surface).query(twin.gaussians.means[mine])
        attached[mine] = (distances > ATTACHED_M) & (twin.gaussians.opacities[mine] > 0.5)
    return attached


def _orient_normals(cover: RobotDiscs, observations: SurfelObservations) -> RobotDiscs:
    """Orient the normals towards the side from which images show the discs."""
    towards = np.einsum("ni,ni->n", cover.normals[observations.disc], -observations.directions_body)
    sides = np.bincount(observations.disc, towards * observations.pixels, len(cover.normals))
    return replace(cover, normals=np.where(sides[:, None] < 0, -cover.normals, cover.normals))
