"""Depth of pixels for which stereo is ambiguous: continued planes and the far background.

A uniform floor or a blurred panorama matches equally well at many depths. Only few depths are plausible, however: those
of planes that were found in other pixels, or infinity. Each ambiguous pixel gets the plausible depth at which the
neighboring views show the same color.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from aomgen.core.boxes import fit_plane
from aomgen.core.sh import sphere_directions
from aomgen.core.values import Array
from aomgen.gaussians.depth_fusion import (
    MIN_CONFIRMATIONS,
    DepthMap,
    Samples,
    contrast_detail,
    join_samples,
    thin,
)

# Largest number of planes: walls, floor and ceiling of a room, or a table and its surroundings.
MAX_PLANES = 5
# Triples of points that are tested for each plane; a plane with a quarter of the points is found almost certainly.
PLANE_TRIALS = 400
# Largest mean difference between views of the same color, 0..255.
MAX_DIFFERENCE = 11.0
# Infinity must explain a pixel better than a plane by this much.
INFINITY_HANDICAP = 1.5
# Every second pixel is sampled, [px]; plane regions have little texture, so more samples add no detail.
STRIDE = 2
# Radius of the far sphere, relative to the extent of the cameras: moving a camera shifts its image by less than a
# pixel.
SHELL_DISTANCE = 500.0
# Detail of points on planes, see `Samples`; less than that of surfaces, because plane regions have little texture.
PLANE_DETAIL = 0.6
# Directions of the coarse far sphere, about 4 degrees apart; it only closes holes that no view covers.
COARSE_DIRECTIONS = 3000
# Weights of pixels that neighboring views confirm, and of pixels that only one view supports. The far shell may use the
# latter, but they never override a confirmed pixel.
EXPLAINED_WEIGHT, OPEN_WEIGHT = 1.5, 0.01
# Least number of rays to infinity, over all views, for each point of the shell.
RAYS_A_POINT = 6


# Unit normal (3,), offset in `normal . x = offset`, and points (M, 3) on the plane.
Plane = tuple[Array, float, Array]


def dominant_planes(points: Array, *, min_share: float = 0.03) -> list[Plane]:
    """Find up to `MAX_PLANES` planes that contain many points, the largest first.

    Args:
        points: Points (P, 3), thinned evenly, because near surfaces would dominate otherwise.
        min_share: Least share of all points in a plane.
    """
    rng = np.random.default_rng(0)
    reach = np.median(np.linalg.norm(points - np.median(points, 0), axis=1))
    tolerance = 0.015 * reach
    rest = points[rng.permutation(len(points))[:8000]]
    wanted = max(30, int(min_share * len(rest)))
    planes: list[Plane] = []
    while len(planes) < MAX_PLANES and len(rest) >= wanted:
        plane = fit_plane(rest, tolerance, rng, PLANE_TRIALS)
        if plane is None:
            break
        normal, center = plane
        inliers = np.abs((rest - center) @ normal) < tolerance
        if inliers.sum() < wanted:
            break
        planes.append((normal, float(normal @ center), rest[inliers]))
        rest = rest[~inliers]
    return planes


def explain(
    maps: list[DepthMap], votes: list[NDArray[np.int32]], planes: list[Plane], threads: int = 1
) -> tuple[Samples, Samples]:
    """Create samples for pixels that no neighboring view confirmed: points on planes, and rays to infinity.

    Args:
        votes: Number of confirmations of each pixel (H, W); from `MIN_CONFIRMATIONS` on its depth is known.
        planes: Candidate planes in addition to infinity.
        threads: Views worked on at once.

    Returns:
        Samples on planes, and samples whose points are unit directions: pixels at infinity and, with a very small weight,
        unexplained pixels.
    """
    blurred = [ndimage.uniform_filter(m.image_srgb.astype(np.float32), (3, 3, 1)) for m in maps]  # pyright: ignore[reportArgumentType]
    trees = [cKDTree(support) for _, _, support in planes]
    extents = [np.linalg.norm(support - support.mean(0), axis=1).mean() for _, _, support in planes]
    reach = np.median(extents or [1.0])

    def explain_view(index: int) -> tuple[Samples, Samples]:
        depth_map = maps[index]
        grid = np.zeros(votes[index].shape, bool)
        grid[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE] = True
        rows, columns = np.nonzero(grid)
        shape = (len(np.unique(rows)), len(np.unique(columns)))
        rays = depth_map.camera.directions()[rows, columns]
        own = blurred[index][rows, columns]
        costs, depths = [], []
        for (normal, offset, _), tree in zip(planes, trees, strict=True):
            depth = _depth_on(normal, offset, depth_map, rays)
            points = depth_map.camera.center + rays * depth[:, None]
            near = tree.query(points, distance_upper_bound=1.5 * reach)[0] < np.inf
            cost = _differences(points, own, depth_map, maps, blurred, votes)
            costs.append(np.where(near & (depth > 0), cost, np.inf))
            depths.append(depth)
        distant = depth_map.camera.center + rays * 1e4 * reach
        costs.append(_differences(distant, own, depth_map, maps, blurred, votes) + INFINITY_HANDICAP)
        depths.append(np.full(len(rays), np.inf))
        table = np.stack([_smooth(cost.reshape(shape)).reshape(-1) for cost in costs])
        best = table.argmin(0)
        undecided = votes[index][rows, columns] < MIN_CONFIRMATIONS
        explained = table[best, np.arange(len(best))] <= MAX_DIFFERENCE
        depth = np.stack(depths)[best, np.arange(len(best))]
        on_plane, at_infinity = undecided & explained & np.isfinite(depth), explained & ~np.isfinite(depth)
        # Unexplained pixels are assumed to be far if the nearest pixel with a depth is far.
        known = np.where(undecided & ~explained, 0, np.where(undecided & at_infinity, 2, 1)).reshape(shape)
        nearest = np.asarray(
            ndimage.distance_transform_edt(known == 0, return_distances=False, return_indices=True)
        )
        beyond = undecided & (known[nearest[0], nearest[1]].reshape(-1) == 2)
        depth = np.where(on_plane, depth, 1.0)
        normals = np.stack([normal for normal, _, _ in planes] + [np.zeros(3)])[best]
        facing = (normals * rays).sum(1, keepdims=True) > 0
        unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        samples = Samples(
            points_recon=np.where(on_plane[:, None], depth_map.camera.center + rays * depth[:, None], unit),
            normals_recon=np.where(facing, -normals, normals),
            colors_srgb=depth_map.image_srgb[rows, columns],
            footprints=STRIDE * depth / depth_map.camera.fx,
            detail=np.where(on_plane, PLANE_DETAIL, contrast_detail(depth_map.image_srgb)[rows, columns]),
            weights=np.where(explained, EXPLAINED_WEIGHT, OPEN_WEIGHT),
        )
        return samples.select(on_plane), samples.select(beyond)

    with ThreadPoolExecutor(threads) as pool:
        on_planes, far = zip(*pool.map(explain_view, range(len(maps))), strict=True)
    return join_samples(list(on_planes)), join_samples(list(far))


def _depth_on(normal: Array, offset: float, depth_map: DepthMap, rays: Array) -> Array:
    """Compute the depth (R,) at which rays from the camera intersect a plane; negative behind or almost parallel."""
    slope = rays @ normal
    distance = offset - float(normal @ depth_map.camera.center)
    steep = np.abs(slope) > 0.02 * np.linalg.norm(rays, axis=1)
    return np.where(steep, distance / np.where(steep, slope, 1.0), -1.0)


def _differences(
    points: Array,
    own: NDArray[np.float32],
    depth_map: DepthMap,
    maps: list[DepthMap],
    blurred: list[NDArray[np.float32]],
    votes: list[NDArray[np.int32]],
) -> Array:
    """Compute the mean color difference (R,) to neighboring views of the points; infinite with fewer than two views."""
    total, count = np.zeros(len(points)), np.zeros(len(points))
    for index in depth_map.neighbours:
        other = maps[index]
        pixels, depths = other.camera.project(points)
        with np.errstate(invalid="ignore"):
            columns, rows = np.floor(np.nan_to_num(np.clip(pixels, -1e6, 1e6))).astype(np.int64).T
        inside = (depths > 0) & (columns >= 0) & (rows >= 0)
        inside &= (columns < other.camera.width) & (rows < other.camera.height)
        r, c = rows[inside], columns[inside]
        settled = votes[index][r, c] >= MIN_CONFIRMATIONS
        hidden = settled & (other.inverse_depth[r, c] - 1.0 / depths[inside] > 2 * other.step)
        # A known surface behind the point contradicts it, because the neighboring view looks through the point.
        through = settled & (1.0 / depths[inside] - other.inverse_depth[r, c] > 2 * other.step)
        difference = np.abs(blurred[index][r, c] - own[inside]).mean(1) + 255.0 * through
        rows_inside = np.flatnonzero(inside)[~hidden]
        total[rows_inside] += difference[~hidden]
        count[rows_inside] += 1
    return np.where(count >= 2, total / np.maximum(count, 1), np.inf)


def _smooth(cost: Array) -> Array:
    """Compute the local mean over pixels with a finite cost; other pixels remain infinite."""
    finite = np.isfinite(cost)
    sums = ndimage.uniform_filter(np.where(finite, cost, 0.0), 5)
    weights = ndimage.uniform_filter(finite.astype(np.float64), 5)
    return np.where(finite, sums / np.maximum(weights, 1e-9), np.inf)


def far_shell(rays: Samples, points_recon: Array, centers: Array, limit: int) -> Samples:
    """Create points on a far sphere: dense in directions that views show at infinity, sparse in all others.

    Args:
        rays: Samples whose points are unit directions and whose footprints are angles.
        points_recon: The scene's points (P, 3); the sphere is far outside of them.
        limit: Approximate largest number of dense points; they are denser where the images have detail.

    The sparse points get the color of the nearest dense one, so that no view shows a hole.
    """
    center = np.median(points_recon, axis=0)
    radius = SHELL_DISTANCE * float(np.linalg.norm(centers - center, axis=1).max())
    wanted = min(limit, len(rays.weights) // RAYS_A_POINT)
    seen = thin(rays, wanted, min_weight=OPEN_WEIGHT) if wanted else rays
    fine = seen.points_recon / np.maximum(np.linalg.norm(seen.points_recon, axis=1, keepdims=True), 1e-12)
    colors = seen.colors_srgb.astype(np.float64)
    coarse, coarse_edge = sphere_directions(COARSE_DIRECTIONS), np.sqrt(4 * np.pi / COARSE_DIRECTIONS)
    if len(fine):
        distances, nearest = cKDTree(fine).query(coarse)
        coarse, coarse_colors = coarse[distances > coarse_edge], colors[nearest[distances > coarse_edge]]
    else:
        coarse_colors = np.full((len(coarse), 3), 128.0)
    unit = np.concatenate([fine, coarse])
    sizes = np.concatenate([seen.footprints, np.full(len(coarse), coarse_edge)])
    return Samples(
        points_recon=center + radius * unit,
        normals_recon=-unit,
        colors_srgb=np.round(np.concatenate([colors, coarse_colors])).astype(np.uint8),
        footprints=radius * sizes,
        detail=np.ones(len(unit)),
        weights=np.ones(len(unit)),
    )
