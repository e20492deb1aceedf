"""Dense depth, its confirmation, thinning, planes and the initial Gaussians."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from aomgen.core.camera import Camera, look_at
from aomgen.core.structure import Structure, held_out
from aomgen.core.transforms import matrix_from_quat
from aomgen.errors import BackendError, ReconstructionError
from aomgen.gaussians.background import (
    EXPLAINED_WEIGHT,
    OPEN_WEIGHT,
    dominant_planes,
    explain,
    far_shell,
)
from aomgen.gaussians.dense_points import nearest_depth, reduce_view
from aomgen.gaussians.depth_fusion import NOISE, DepthMap, Samples, count_confirmations, plane_sweep, thin
from aomgen.gaussians.train import initial_gaussians
from aomgen.structure.mapping import choose_pairs

TEXTURE = ndimage.gaussian_filter(np.random.default_rng(0).random((512, 512)), 1.5, mode="wrap")
TEXTURE = ((TEXTURE - TEXTURE.min()) / np.ptp(TEXTURE)).astype(np.float32)


View = tuple[Camera, np.ndarray]


def _camera(x: float, y: float = 0.0) -> Camera:
    T = look_at([x, y, 0], [x, y, 1], up=(0, -1, 0))
    return Camera(fx=120, fy=120, cx=64, cy=48, width=128, height=96, T_world_cam=T)


def _seen(camera: Camera, slope: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Image and depth of the textured plane z = 2 + slope * x."""
    rays = camera.directions()
    depth = (2 + slope * camera.center[0] - camera.center[2]) / (rays[..., 2] - slope * rays[..., 0])
    points = camera.center + rays * depth[..., None]
    texels = np.stack([points[..., 1], points[..., 0]]) * 60 + 256
    return ndimage.map_coordinates(TEXTURE, texels, order=1, mode="wrap"), depth


@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_plane_sweep_recovers_a_plane(slope):
    cameras = [_camera(0), _camera(0.2), _camera(-0.2), _camera(0, 0.2)]
    views = [(camera, _seen(camera, slope)[0]) for camera in cameras]
    inverse_depth, score = plane_sweep(views[0], views[1:], np.linspace(0, 1, 64))
    expected = 1 / _seen(cameras[0], slope)[1]
    inner = np.abs(inverse_depth - expected)[12:-12, 24:-24]
    assert np.median(inner) < 0.25 / 63
    assert np.quantile(inner, 0.95) < 1.0 / 63
    assert np.median(score) > 0.8


def _correlations(reference: View, source: View, inverse_depth: float) -> np.ndarray:
    """Normalized correlation (H, W) of 5 x 5 windows, -1 where less than 3/4 of a window is inside the source."""
    (camera, image), (other, seen) = reference, source
    T = other.T_cam_world @ camera.T_world_cam
    height, width = image.shape
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(camera.K).T
    x, y, z = np.moveaxis((rays @ T[:3, :3].T + T[:3, 3] * inverse_depth) @ other.K.T, -1, 0)
    x, y = x / z - 0.5, y / z - 0.5
    inside = ((x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)).astype(float)
    warped = ndimage.map_coordinates(seen.astype(float), [y, x], order=1) * inside
    count = 25 * ndimage.uniform_filter(inside, 5, mode="constant")

    def mean(values: np.ndarray) -> np.ndarray:
        sums = 25 * ndimage.uniform_filter(inside * values, 5, mode="constant")
        return sums / np.maximum(count, 1)

    mean_a, mean_b = mean(image), mean(warped)
    variance_a, variance_b = (
        np.maximum(mean(v**2) - m**2, 0) + NOISE**2 for v, m in ((image, mean_a), (warped, mean_b))
    )
    value = (mean(image * warped) - mean_a * mean_b) / np.sqrt(variance_a * variance_b)
    return np.where(count > 0.75 * 25 - 1e-6, value, -1.0)


def test_the_score_is_the_mean_of_the_two_best_correlations():
    cameras = [_camera(0), _camera(0.2, 0.03), _camera(-0.3, 0.05), _camera(0.01, 0.2)]
    reference, *sources = [(camera, _seen(camera, 0.4)[0]) for camera in cameras]
    # At infinity, the borders of these images would coincide up to rounding.
    depths = np.linspace(0.02, 1, 64)
    inverse_depth, score = plane_sweep(reference, sources, depths)
    every = np.array([[_correlations(reference, source, depth) for depth in depths] for source in sources])
    best = np.sort(every, axis=0)[-2:].mean(0)
    # A depth between two planes belongs to one of them.
    place = (inverse_depth - depths[0]) / (depths[1] - depths[0])
    near = [
        np.take_along_axis(best, np.clip(index(place), 0, 63).astype(int)[None], 0)[0]
        for index in (np.floor, np.ceil)
    ]
    apart = np.min([np.abs(score - one) for one in near], axis=0)
    assert np.quantile(apart, 0.998) < 1.5 / 127.5


def test_plane_sweep_sees_infinity():
    cameras = [_camera(0), _camera(0.2), _camera(-0.2)]
    image = _seen(cameras[0])[0]
    inverse_depth, _ = plane_sweep(
        (cameras[0], image), [(camera, image) for camera in cameras[1:]], np.linspace(0, 1, 64)
    )
    assert np.median(inverse_depth) < 0.5 / 63


def test_plane_sweep_refuses_more_planes_than_it_has_room_for():
    view = (_camera(0), _seen(_camera(0))[0])
    with pytest.raises(BackendError, match="refuses"):
        plane_sweep(view, [view], np.linspace(0, 1, 300))


def _map(camera: Camera, inverse_depth: np.ndarray, neighbours: tuple[int, ...]) -> DepthMap:
    return DepthMap(
        camera=camera,
        image_srgb=np.zeros((96, 128, 3), np.uint8),
        inverse_depth=inverse_depth.astype(np.float32),
        score=np.ones((96, 128), np.float32),
        step=1 / 63,
        neighbours=neighbours,
    )


def test_only_depths_that_neighbours_share_are_confirmed():
    cameras = [_camera(0), _camera(0.1), _camera(-0.1)]
    good = np.full((96, 128), 0.5)
    wrong = good.copy()
    wrong[:, 64:] = 0.8
    maps = [_map(cameras[0], wrong, (1, 2)), _map(cameras[1], good, (0, 2)), _map(cameras[2], good, (0, 1))]
    votes = count_confirmations(maps[0], maps)
    assert (votes[10:-10, 20:60] == 2).all()
    assert (votes[:, 68:] == 0).all()


def test_thinning_hits_its_target_and_drops_lonely_samples():
    rng = np.random.default_rng(1)
    plane = np.concatenate([rng.uniform(-1, 1, (60_000, 2)), np.zeros((60_000, 1))], 1)
    noise = rng.uniform(-1, 1, (200, 3)) + [0, 0, 5]
    points = np.concatenate([plane, noise])
    count = len(points)
    samples = Samples(
        points_recon=points,
        normals_recon=np.tile([0.0, 0, 1], (count, 1)),
        colors_srgb=np.full((count, 3), 90, np.uint8),
        footprints=np.full(count, 0.01),
        detail=np.ones(count),
        weights=np.ones(count),
    )
    kept = thin(samples, 3000)
    assert 1000 < len(kept.points_recon) <= 3000
    assert np.abs(kept.points_recon[:, 2]).max() < 1e-9
    assert (kept.colors_srgb == 90).all()


def test_dominant_planes_are_found_in_clutter():
    rng = np.random.default_rng(2)
    floor = np.concatenate([rng.uniform(-2, 2, (3000, 2)), rng.normal(0, 0.004, (3000, 1))], 1)
    wall = np.stack([rng.uniform(-2, 2, 2000), rng.normal(2, 0.004, 2000), rng.uniform(0, 2, 2000)], 1)
    clutter = rng.uniform(-2, 2, (1500, 3))
    (first, offset, _), (second, _, _), *_ = dominant_planes(np.concatenate([floor, wall, clutter]))
    assert abs(first[2]) > 0.9999
    assert abs(offset) < 0.005
    assert abs(second[1]) > 0.9999
    assert dominant_planes(rng.normal(size=(2000, 3)), min_share=0.2) == []


def _rays(columns: np.ndarray, rows: np.ndarray, grey: np.ndarray, weight: float) -> Samples:
    """Directions on a grid of 1/300 around +z."""
    unit = np.stack([columns / 300.0, rows / 300.0, np.ones(len(rows))], 1)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    count = len(unit)
    return Samples(
        points_recon=unit,
        normals_recon=np.zeros((count, 3)),
        colors_srgb=np.repeat(grey[:, None], 3, 1).astype(np.uint8),
        footprints=np.full(count, 1 / 300),
        detail=np.ones(count),
        weights=np.full(count, weight),
    )


def test_the_shell_takes_open_rays_but_never_against_explained_ones():
    rows, columns = (grid.ravel() for grid in np.mgrid[-40:40, -60:60])
    explained = columns < 0
    white, black = np.full(len(rows), 250), np.zeros(len(rows))
    rays = _rays(columns[explained], rows[explained], white[explained], EXPLAINED_WEIGHT).with_points(
        _rays(columns, rows, black, OPEN_WEIGHT)
    )
    shell = far_shell(rays, np.random.default_rng(0).normal(size=(50, 3)), np.eye(3), 5000)
    unit = shell.points_recon / np.linalg.norm(shell.points_recon, axis=1, keepdims=True)
    fine = (unit[:, 2] > 0.9) & (np.abs(unit[:, 0]) < 0.19) & (np.abs(unit[:, 1]) < 0.12)
    left, right = fine & (unit[:, 0] < -0.02), fine & (unit[:, 0] > 0.02)
    assert left.sum() > 200
    assert right.sum() > 200  # nothing explains them, but somebody saw them
    assert shell.colors_srgb[left].min() > 240
    assert shell.colors_srgb[right].max() == 0


def test_a_sharp_edge_at_infinity_leaves_no_hole():
    """Neighbours a pixel off disagree at an edge; the edge is far all the same."""
    cameras = [_camera(x) for x in (0.0, 0.1, -0.1)]
    maps, votes = [], []
    for index, camera in enumerate(cameras):
        image = np.full((96, 128, 3), 90, np.uint8)
        image[:, 40 + 2 * index : 80 + 2 * index] = 250  # registered two pixels off
        image[60:] = 120
        inverse_depth = np.where(np.arange(96)[:, None] < 60, 0.0, 0.5) * np.ones((96, 128))
        one = _map(camera, inverse_depth, tuple(i for i in range(3) if i != index))
        maps.append(replace(one, image_srgb=image))
        votes.append(np.where(inverse_depth > 0, 2, 0).astype(np.int32))
    _, rays = explain(maps, votes, [])
    # Every second pixel above the settled rows, but for a few beside them.
    assert 0.98 * 3 * 30 * 64 < len(rays.weights) <= 3 * 30 * 64
    assert 0.01 < (rays.weights == OPEN_WEIGHT).mean() < 0.5


def test_initial_gaussians_lie_flat_on_the_surface():
    grid = np.stack(np.meshgrid(np.arange(10), np.arange(10)), -1).reshape(-1, 2) * 0.1
    count = len(grid)
    surface = Samples(
        points_recon=np.concatenate([grid, np.zeros((count, 1))], 1),
        normals_recon=np.tile([0.0, 0.6, 0.8], (count, 1)),
        colors_srgb=np.full((count, 3), 255, np.uint8),
        footprints=np.full(count, 0.1),
        detail=np.ones(count),
        weights=np.ones(count),
    )
    gaussians = initial_gaussians(surface, surface.select(np.zeros(count, bool)))
    thin_axis = matrix_from_quat(gaussians.quats)[:, :, 2]
    assert np.allclose(thin_axis, [0, 0.6, 0.8], atol=1e-5)
    assert np.all(gaussians.scales[:, 2] < 0.5 * gaussians.scales[:, 0])
    assert np.allclose(0.5 + 0.28209479 * gaussians.sh[:, 0], 1.0, atol=1e-5)


def test_every_eighth_image_is_held_out():
    names = [f"{index:04d}.jpg" for index in range(20)]
    assert held_out(names[::-1]) == ["0004.jpg", "0012.jpg"]


def test_long_scans_are_not_matched_exhaustively():
    assert len(choose_pairs(20, 90)) == 190
    pairs = choose_pairs(400, 90)
    assert len(pairs) < 20_000
    chosen = set(pairs)
    assert all((i, i + 1) in chosen for i in range(399))


def test_sweeps_begin_before_the_nearest_points_of_a_view():
    structure = Structure(
        cameras_recon={"a": _camera(0.0), "b": _camera(0.3)},
        demo_cameras_recon={},
        dropped={},
        points_recon=np.array([[0.0, 0, 2], [0, 0, 3]]),
        colors_srgb=np.zeros((2, 3), np.uint8),
        observations=np.array([[0, 0], [1, 0]], np.int32),
        reprojection_error_px=0.0,
    )
    assert nearest_depth(structure, ["a"])[0] == pytest.approx(0.7 * 2, rel=0.02)
    with pytest.raises(ReconstructionError, match=r"b.*shows no point"):
        nearest_depth(structure, ["a", "b"])


def test_upright_and_sideways_images_are_reduced_alike():
    camera = Camera(fx=700, fy=700, cx=270, cy=480, width=540, height=960, T_world_cam=np.eye(4))
    small, image = reduce_view(camera, np.zeros((960, 540, 3), np.uint8), 320)
    assert image.shape == (320, 180, 3)
    assert (small.width, small.height, small.cx, small.cy) == (180, 320, 90, 160)
    kept, _ = reduce_view(camera, np.zeros((960, 540, 3), np.uint8), 960)
    assert kept is camera
