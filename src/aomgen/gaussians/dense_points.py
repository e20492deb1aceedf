"""Dense colored points of the scene from a sparse model: where the Gaussians will start."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import luma_from_srgb
from aomgen.core.camera import Camera
from aomgen.core.progress import Progress
from aomgen.core.structure import Structure
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.gaussians.background import dominant_planes, explain, far_shell
from aomgen.gaussians.depth_fusion import (
    DepthMap,
    Samples,
    confirm_depth,
    confirm_samples,
    count_confirmations,
    join_samples,
    plane_sweep,
    thin,
)
from aomgen.io.images import resize
from aomgen.splatting.surfaces import in_free_space


@dataclass(frozen=True, slots=True, kw_only=True)
class DensifyParams:
    """Effort and limits of the dense points.

    Attributes:
        target_points: Requested points on surfaces; the result is within a few percent.
        long_side: Long side of the reduced images, [px], so that portrait and landscape photos take the same time.
        planes: Number of depth hypotheses of a pixel, evenly spaced in inverse depth from infinity on.
        sources: Number of neighbors with which a view is matched.
        shell_points: Largest number of points on the far sphere, where it was observed.
        threads: Number of views that are processed at the same time.
    """

    target_points: int = 78_000
    long_side: int = 320
    planes: int = 128
    sources: int = 4
    shell_points: int = 12_000
    threads: int = 2


def densify(
    structure: Structure,
    images_srgb: dict[str, NDArray[np.uint8]],
    params: DensifyParams,
    progress: Progress,
) -> tuple[Samples, Samples]:
    """Compute dense points by plane sweeps; neighboring views have to confirm each point.

    Args:
        images_srgb: Images (H, W, 3) uint8 by name; a subset of the structure's images.

    Returns:
        Points on surfaces, and points of a far shell where the views agree on infinity. Surface points are thinned by
        their size in the nearest view, and are denser where the image has detail. They include the sparse points, and large
        planes are continued where stereo is ambiguous. Normals are towards the cameras, or zero if they are unknown.

    Not checked: mirrors and glass, which cause points at mirrored positions.
    """
    names = [name for name in structure.cameras_recon if name in images_srgb]
    views = [
        reduce_view(structure.cameras_recon[name], images_srgb[name], params.long_side) for name in names
    ]
    neighbours = choose_neighbours(structure, names, params.sources)
    nearest = nearest_depth(structure, names)
    grays = [luma_from_srgb(image) for _, image in views]

    def sweep(index: int) -> DepthMap:
        camera, image = views[index]
        planes = np.linspace(0.0, 1.0 / nearest[index], params.planes)
        inverse_depth, score = plane_sweep(
            (camera, grays[index]),
            [(views[other][0], grays[other]) for other in neighbours[index]],
            planes,
        )
        return DepthMap(
            camera=camera,
            image_srgb=image,
            inverse_depth=inverse_depth,
            score=score,
            step=float(planes[1]),
            neighbours=tuple(neighbours[index]),
        )

    maps: list[DepthMap] = []
    with ThreadPoolExecutor(params.threads) as pool:
        for depth_map in pool.map(sweep, range(len(views))):
            maps.append(depth_map)
            progress(0.75 * len(maps) / len(views), "sweeping planes")
    progress(0.76, "comparing depth maps")
    with ThreadPoolExecutor(params.threads) as pool:
        votes = list(pool.map(lambda one: count_confirmations(one, maps), maps))
        surfaces = join_samples(list(pool.map(confirm_samples, maps, votes)))
    surfaces = surfaces.with_points(_sparse(structure, names, views))
    progress(0.85, "continuing planes")
    planes = dominant_planes(thin(surfaces, params.target_points // 8).points_recon)
    filled, rays = explain(maps, votes, planes, params.threads)
    kept = thin(surfaces.with_points(filled), params.target_points)
    view_depths = [confirm_depth(one, own) for one, own in zip(maps, votes, strict=True)]
    kept = kept.select(~in_free_space(kept.points_recon, view_depths))
    centers = np.array([camera.center for camera, _ in views])
    return kept, far_shell(rays, kept.points_recon, centers, params.shell_points)


def choose_neighbours(structure: Structure, names: list[str], count: int) -> list[list[int]]:
    """Choose for each view the views that observe the same points at a suitable parallax.

    A shared point has full weight near 8 degrees of parallax, and less if the rays are nearly parallel (no depth) or far
    apart (different appearance).
    """
    order = {name: index for index, name in enumerate(structure.cameras_recon)}
    centers = np.array([structure.cameras_recon[name].center for name in names])
    seen = [set() for _ in structure.cameras_recon]
    for point, view in structure.observations:
        seen[view].add(int(point))
    result = []
    for i, name in enumerate(names):
        scores = np.zeros(len(names))
        for j, other in enumerate(names):
            shared = sorted(seen[order[name]] & seen[order[other]]) if i != j else []
            if len(shared) < 8:
                continue
            points = structure.points_recon[shared]
            a, b = points - centers[i], points - centers[j]
            cosines = (a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
            angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
            scores[j] = np.exp(-0.5 * (np.log(np.maximum(angles, 0.1) / 8.0) / 0.6) ** 2).sum()
        ranked = [int(j) for j in np.argsort(-scores, kind="stable") if scores[j] > 0][:count]
        if not ranked:
            distances = np.linalg.norm(centers - centers[i], axis=1)
            ranked = [int(j) for j in np.argsort(distances, kind="stable")[1 : count + 1]]
        result.append(ranked)
    return result


def nearest_depth(structure: Structure, names: list[str]) -> Array:
    """Compute the depth (V,) at which each view's sweep begins: 70 % of the depth of its nearest sparse points.

    Raises:
        ReconstructionError: A view sees no point.
    """
    order = {name: index for index, name in enumerate(structure.cameras_recon)}
    result = np.empty(len(names))
    for row, name in enumerate(names):
        mine = structure.observations[structure.observations[:, 1] == order[name], 0]
        _, depths = structure.cameras_recon[name].project(structure.points_recon[mine])
        if not (depths > 0).any():
            raise ReconstructionError(
                name, "shows no point of the sparse model", "remove it, or register it with more overlap"
            )
        result[row] = 0.7 * np.percentile(depths[depths > 0], 1)
    return result


def reduce_view(camera: Camera, image: NDArray[np.uint8], long_side: int) -> tuple[Camera, NDArray[np.uint8]]:
    """Reduce an image (H, W, 3) and its camera to a long side, [px]; smaller ones stay."""
    share = long_side / max(camera.width, camera.height)
    if share >= 1.0:
        return camera, image
    small = camera.resize(round(share * camera.width), round(share * camera.height))
    return small, resize(image, small.width, small.height)


def _sparse(structure: Structure, names: list[str], views: list[tuple[Camera, NDArray[np.uint8]]]) -> Samples:
    """Select the sparse points that at least two of the used views observe, colored by these views."""
    order = list(structure.cameras_recon)
    used = {order.index(name): row for row, name in enumerate(names)}
    rows: dict[int, list[int]] = {}
    for point, view in structure.observations:
        if int(view) in used:
            rows.setdefault(int(point), []).append(used[int(view)])
    points, colors, footprints = [], [], []
    for point, seen_by in sorted(rows.items()):
        if len(seen_by) < 2:
            continue
        camera, image = views[seen_by[0]]
        pixels, depths = camera.project(structure.points_recon[point][None])
        x, y = np.clip(np.floor(pixels[0]).astype(int), 0, [camera.width - 1, camera.height - 1])
        points.append(structure.points_recon[point])
        colors.append(image[y, x])
        footprints.append(depths[0] / camera.fx)
    count = len(points)
    return Samples(
        points_recon=np.array(points).reshape(-1, 3),
        normals_recon=np.zeros((count, 3)),
        colors_srgb=np.array(colors, np.uint8).reshape(-1, 3),
        footprints=np.array(footprints),
        detail=np.ones(count),
        weights=np.full(count, 6.0),
    )
