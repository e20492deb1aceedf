from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.light import hemisphere_light, light_from_harmonics, open_transfer
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.errors import AssetError
from aomgen.lighting.visibility import Occluders, estimate_transfer, turn_outward
from aomgen.splatting.rasterizer import render
from aomgen.splatting.surfels import crease_edges, surfels_of
from diffuse_shading import shaded_srgb

QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def plate(size: float = 0.4, texture: np.ndarray | None = None, z: float = 0.0) -> Mesh:
    corners = size / 2 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]) + [0, 0, z]
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    return Mesh(
        name="plate",
        vertices=corners,
        faces=QUAD,
        uvs=uv[QUAD] if texture is not None else np.zeros((0, 3, 2)),
        texture_srgb=texture if texture is not None else np.zeros((0, 0, 3), np.uint8),
        color_srgb=np.array([0.8, 0.2, 0.1]),
    )


def camera_above(f: float = 200) -> Camera:
    T = look_at((0.05, -0.02, 1.0), (0, 0, 0), (0, 1, 0))
    return Camera(fx=f, fy=f, cx=60, cy=60, width=120, height=120, T_world_cam=T)


def test_discs_close_the_surface_and_end_at_its_edge():
    surfels = surfels_of([plate()], 4000, np.random.default_rng(0))
    assert 2500 < len(surfels.gaussians) < 5500
    camera = camera_above()
    drawn = render(surfels.gaussians, camera)
    rays = camera.directions()
    hit = camera.center + rays * (-camera.center[2] / rays[..., 2])[..., None]
    from_edge = 0.2 - np.abs(hit[..., :2]).max(-1)
    assert drawn.alpha[from_edge > 0.01].min() > 0.9
    assert drawn.alpha[from_edge < -0.012].max() < 0.05
    inside = drawn.rgb[from_edge > 0.02]
    np.testing.assert_allclose(
        inside / drawn.alpha[from_edge > 0.02][:, None], [[0.8, 0.2, 0.1]] * len(inside), atol=0.02
    )


def test_the_texture_lies_the_right_way_round():
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :32] = (255, 0, 0)  # upper left in the file: u < 0.5, v > 0.5
    texture[32:, 32:] = (0, 0, 255)
    surfels = surfels_of([plate(texture=texture)], 3000, np.random.default_rng(0))
    upper_left = (surfels.gaussians.means[:, 0] < -0.03) & (surfels.gaussians.means[:, 1] > 0.03)
    lower_right = (surfels.gaussians.means[:, 0] > 0.03) & (surfels.gaussians.means[:, 1] < -0.03)
    np.testing.assert_allclose(surfels.albedo_linear[upper_left].mean(0), [1, 0, 0], atol=0.02)
    np.testing.assert_allclose(surfels.albedo_linear[lower_right].mean(0), [0, 0, 1], atol=0.02)


def test_detail_gets_more_discs():
    texture = np.full((64, 64, 3), 128, np.uint8)
    texture[:, 32:] = (np.indices((64, 32)).sum(0) // 4 % 2 * 255)[..., None]
    surfels = surfels_of([plate(texture=texture)], 4000, np.random.default_rng(0))
    right = surfels.gaussians.means[:, 0] > 0.02
    left = surfels.gaussians.means[:, 0] < -0.02
    assert right.sum() > 2 * left.sum()


def test_a_sticker_hides_the_wall_right_behind_it():
    sticker = plate(0.1, texture=np.full((4, 4, 3), 255, np.uint8), z=0.0005)
    surfels = surfels_of([plate(), sticker], 4000, np.random.default_rng(0))
    drawn = render(surfels.gaussians, camera_above())
    np.testing.assert_allclose(drawn.rgb[55:65, 55:65] / drawn.alpha[55:65, 55:65, None], 1.0, atol=0.05)


def test_a_map_of_opacity_cuts_holes_and_a_window_hides_nothing():
    texture = np.full((64, 64, 3), 255, np.uint8)
    opacity = np.full((64, 64), 255, np.uint8)
    opacity[16:48, 16:48] = 0
    cut = replace(plate(texture=texture), maps={"opacity": opacity}, opacity=0.75)
    middle = np.abs(surfels_of([cut], 4000, np.random.default_rng(0)).gaussians.means[:, :2]).max(1)
    assert middle.min() > 0.09
    window = replace(plate(0.1, z=0.0005), opacity=0.3)
    surfels = surfels_of([plate(), window], 4000, np.random.default_rng(0)).gaussians
    inside = np.abs(surfels.means[:, :2]).max(1) < 0.04
    assert set(np.round(surfels.opacities[inside], 2).tolist()) == {np.float32(0.3), np.float32(0.99)}
    with pytest.raises(AssetError, match="transparent"):
        surfels_of([replace(plate(), opacity=0.0)], 100, np.random.default_rng(0))


def test_maps_of_roughness_and_normals_hold_where_they_lie():
    """Normals lean by 37 degrees towards the texture's u on the left, and towards its v on the right."""
    left = np.arange(64) < 32
    normal = np.where(left[None, :, None], [0.6, 0, 0.8], [0, 0.6, 0.8]) * np.ones((64, 1, 1))
    maps = {
        "roughness": np.tile(np.where(left, 51, 204).astype(np.uint8), (64, 1)),
        "normal": np.round((normal + 1) / 2 * 255).astype(np.uint8),
    }
    mesh = replace(plate(texture=np.full((64, 64, 3), 99, np.uint8)), maps=maps)
    R = matrix_from_rotvec([0.3, -0.5, 0.9])
    surfels = surfels_of([mesh.transform(transform(R, np.zeros(3)))], 3000, np.random.default_rng(0))
    x = (surfels.gaussians.means @ R)[:, 0]
    # Either side of a lone sheet may be the outer one.
    outward = np.sign(surfels.normals @ R[:, 2])[:, None]
    for side, value, lean in ((x < -0.02, 0.2, [0.6, 0, 0.8]), (x > 0.02, 0.8, [0, 0.6, 0.8])):
        np.testing.assert_allclose(surfels.roughness[side], value, atol=0.01)
        want = np.array(lean) * np.where([1, 1, 0], 1, outward[side])
        np.testing.assert_allclose(surfels.shading_normals[side] @ R, want, atol=0.02)


def test_only_borders_and_sharp_edges_are_creases():
    assert crease_edges(plate().vertices, QUAD).sum() == 4  # the diagonal is none
    folded = np.array([[-1, 0, 0], [0, -1, 0], [0, 1, 0], [1, 0, 0.9]])
    assert crease_edges(folded, np.array([[0, 1, 2], [1, 3, 2]])).all()


def test_transfer_of_an_open_surface_is_the_clamped_cosine():
    points = np.random.default_rng(0).uniform((-0.2, -0.2, 0), (0.2, 0.2, 0), (400, 3))
    normals = np.tile([0, 0, 1.0], (400, 1))
    transfer, seen = estimate_transfer(points, normals, Occluders(points))
    np.testing.assert_allclose(transfer, open_transfer(normals), atol=0.05)
    np.testing.assert_allclose(seen, 1, atol=0.05)
    np.testing.assert_array_equal(turn_outward(points, normals, Occluders(points)), normals)


def test_the_floor_of_a_box_is_darker_than_its_lid():
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-0.1, 0.1, (4000, 2)), np.zeros(4000)])
    sides = [
        np.insert(rng.uniform((-0.1, 0), (0.1, 0.2), (4000, 2)), axis, at, axis=1)
        for axis in (0, 1)
        for at in (-0.1, 0.1)
    ]
    box = np.concatenate([floor, *sides])
    middle = np.array([[0.0, 0, 0], [0, 0, 0.2]])
    transfer, _ = estimate_transfer(middle, np.array([[0, 0, 1.0], [0, 0, 1.0]]), Occluders(box))
    light = hemisphere_light((1, 1, 1), (0, 0, 0))
    inside, above = shaded_srgb(np.full((2, 3), 0.8), transfer, light.radiance_sh)
    assert inside.mean() < 0.85 * above.mean()


def test_normals_that_look_into_a_closed_box_are_turned():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    inward = turn_outward(points[:50], -points[:50], Occluders(points))
    np.testing.assert_array_equal(inward, points[:50])


def test_light_turns_the_other_way_when_the_body_turns():
    light = light_from_harmonics(
        np.random.default_rng(0).normal(size=(9, 3)) + 3 * (np.arange(9) == 0)[:, None]
    )
    R = matrix_from_rotvec(np.array([0.3, -0.8, 0.5]))
    normal_body = np.array([[0.6, 0.0, 0.8]])
    world = open_transfer(normal_body @ R.T) @ light.radiance_sh
    body = open_transfer(normal_body) @ light.view_from(R)
    np.testing.assert_allclose(body, world, atol=1e-5)


def test_a_mesh_without_surface_is_refused():
    empty = Mesh(
        name="empty",
        vertices=np.zeros((3, 3)),
        faces=np.array([[0, 1, 2]]),
        uvs=np.zeros((0, 3, 2)),
        texture_srgb=np.zeros((0, 0, 3), np.uint8),
        color_srgb=np.ones(3),
    )
    with pytest.raises(AssetError, match="no surface"):
        surfels_of([empty], 100, np.random.default_rng(0))
