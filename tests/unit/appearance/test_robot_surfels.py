from dataclasses import replace

import numpy as np
import pytest

from aomgen.appearance.refine import refine_twin
from aomgen.appearance.robot_shading import RobotDiscs, fit_robot_colors
from aomgen.appearance.robot_surfels import replace_robot_gaussians
from aomgen.appearance.surfel_observations import SurfelObservations, match_exposure
from aomgen.conventions import MOVING, ROBOT
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, gaussians_of
from aomgen.core.light import light_from_harmonics, open_transfer
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.io.artifact import load_artifact, save_artifact
from aomgen.lighting.shadowed_twin import render_state
from aomgen.twin.relighting import Relit, ResidualAppearance, orientation_weights
from aomgen.twin.twin import PosedImages, TwinModel
from diffuse_shading import shaded_srgb

BEHIND = look_at((0.5, 1.1, 0.7), (0.2, 0.0, 0.3))
EYES = [(-0.4, -0.9, 0.7), (0.4, -1.1, 0.5), (-0.7, -0.2, 0.6), (0.9, -0.8, 0.8), (-0.3, -1.0, 0.2)]


def pictures(toy_scene, state, eyes) -> list[PosedImages]:
    """What cameras around the robot see of the scanned Gaussians, which have no light baked in."""
    views = []
    for eye in eyes:
        camera = Camera(
            fx=150, fy=150, cx=80, cy=60, width=160, height=120, T_world_cam=look_at(eye, (0.2, 0, 0.3))
        )
        views.append(
            PosedImages(
                camera=camera, images_srgb=(drawn(toy_scene.twin, toy_scene, state, camera),), states=(state,)
            )
        )
    return views


def drawn(twin, toy_scene, state, camera) -> np.ndarray:
    return np.clip(np.rint(render_state(twin, toy_scene.robot, state, camera).rgb * 255), 0, 255).astype(
        np.uint8
    )


def error(twin, toy_scene, view) -> float:
    image = drawn(twin, toy_scene, view.states[0], view.camera)
    return float(np.mean((image.astype(float) - view.images_srgb[0]) ** 2))


@pytest.fixture(scope="module")
def dressing(toy_scene):
    views = pictures(toy_scene, toy_scene.twin.scan_state, EYES)
    with_surfels = replace_robot_gaussians(toy_scene.twin, toy_scene.robot, views, np.random.default_rng(0))
    return views, with_surfels, refine_twin(with_surfels, toy_scene.robot, views, np.random.default_rng(1))


def test_a_dressed_robot_looks_like_its_pictures(toy_scene, dressing):
    views, _, twin = dressing
    bare = toy_scene.twin.select(toy_scene.twin.labels != ROBOT)
    for view in views:
        assert error(twin, toy_scene, view) < 0.3 * error(bare, toy_scene, view)


def test_a_dressed_robot_is_closed_where_no_picture_looked(toy_scene, dressing):
    _, _, twin = dressing
    camera = Camera(fx=150, fy=150, cx=80, cy=60, width=160, height=120, T_world_cam=BEHIND)
    robot = (twin.labels == ROBOT)[:, None] * 1.0
    seen = render_state(twin, toy_scene.robot, twin.scan_state, camera, features=robot).features
    was = render_state(
        toy_scene.twin, toy_scene.robot, twin.scan_state, camera,
        features=(toy_scene.twin.labels == ROBOT)[:, None] * 1.0,
    ).features  # fmt: skip
    inside = np.asarray(was)[..., 0] > 0.97
    assert inside.sum() > 300
    assert np.median(np.asarray(seen)[..., 0][inside]) > 0.9


def test_dressing_leaves_everything_else_alone(toy_scene, dressing):
    _, twin, _ = dressing
    for label in set(toy_scene.twin.labels.tolist()) - {ROBOT}:
        np.testing.assert_array_equal(
            twin.gaussians.means[twin.labels == label],
            toy_scene.twin.gaussians.means[toy_scene.twin.labels == label],
        )
    assert twin.body_names == toy_scene.twin.body_names
    assert twin.relit is not None
    assert (twin.labels[twin.relit.indices] == ROBOT).all()


def test_dressing_repeats_itself(toy_scene, dressing):
    views, with_surfels, twin = dressing
    again = refine_twin(with_surfels, toy_scene.robot, views, np.random.default_rng(1))
    np.testing.assert_array_equal(again.bodies, twin.bodies)
    np.testing.assert_allclose(again.gaussians.means, twin.gaussians.means, atol=1e-5)


def test_a_dressed_twin_survives_storage(dressing, tmp_path):
    _, _, twin = dressing
    save_artifact(tmp_path, "twin", twin)
    again = load_artifact(tmp_path, "twin", TwinModel)
    assert again.relit is not None
    assert twin.relit is not None
    np.testing.assert_array_equal(again.relit.light_of, twin.relit.light_of)
    for one, other in zip(again.relit.residuals, twin.relit.residuals, strict=True):
        assert one.body == other.body
        assert one.reach_rad == other.reach_rad
        np.testing.assert_array_equal(one.difference_srgb, other.difference_srgb)


@pytest.mark.parametrize("views", [0, 1])
def test_without_pictures_of_the_robot_the_scan_stays(toy_scene, views):
    away = Camera(
        fx=150, fy=150, cx=80, cy=60, width=160, height=120, T_world_cam=look_at((2.0, 0, 0.5), (4.0, 0, 0.5))
    )
    image = np.zeros((120, 160, 3), np.uint8)
    view = PosedImages(camera=away, images_srgb=(image,), states=(toy_scene.twin.scan_state,))
    twin = replace_robot_gaussians(toy_scene.twin, toy_scene.robot, [view] * views, np.random.default_rng(0))
    assert twin is toy_scene.twin


def test_a_cable_that_the_model_does_not_have_stays(toy_scene):
    twin = toy_scene.twin
    cable = np.flatnonzero(twin.bodies == 3)[:40]
    means = np.array(twin.gaussians.means)
    means[cable] += 0.3
    changed = replace(twin, gaussians=replace(twin.gaussians, means=means))
    views = pictures(toy_scene, twin.scan_state, EYES[:2])
    result = replace_robot_gaussians(changed, toy_scene.robot, views, np.random.default_rng(0))
    kept = {tuple(row) for row in result.gaussians.means.tolist()}
    assert all(tuple(row) in kept for row in means[cable].tolist())


def make_images(image: np.ndarray, toy_scene) -> PosedImages:
    return PosedImages(
        camera=toy_scene.camera, images_srgb=(image, image), states=(toy_scene.twin.scan_state,) * 2
    )


def test_exposure_of_a_film_is_taken_back(toy_scene):
    rng = np.random.default_rng(1)
    scan = rng.uniform(0.3, 0.7, (24, 32, 3))
    gains = np.array([0.7, 0.8, 1.1])
    darker = np.rint(255 * scan * gains ** (1 / 2.2)).astype(np.uint8)
    matched = match_exposure(make_images(darker, toy_scene), scan, np.ones((24, 32), bool))
    for image in matched.images_srgb:
        assert np.abs(image / 255 - scan).mean() < 0.02


def test_what_does_not_show_the_same_is_not_compared(toy_scene):
    scan = np.full((24, 32, 3), 0.5)
    image = np.full((24, 32, 3), 128, np.uint8)
    image[:, :20] = 40
    compared = np.zeros((24, 32), bool)
    compared[:, 20:] = True
    matched = match_exposure(make_images(image, toy_scene), scan, compared)
    assert np.abs(matched.images_srgb[0][:, 20:].astype(int) - 128).max() <= 1


def observe_a_ball(light, albedo, pictures) -> tuple[SurfelObservations, np.ndarray]:
    """A ball that turns about z under a light, half of it seen in every picture."""
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    Ts = np.tile(np.eye(4), (pictures, 2, 1, 1))
    rows = []
    for t in range(pictures):
        Ts[t, 1] = transform(matrix_from_rotvec(np.array([0, 0, 2 * np.pi * t / pictures])), np.zeros(3))
        R = Ts[t, 1, :3, :3]
        seen = np.flatnonzero(normals @ R.T @ [0, -1.0, 0.3] > 0.2)
        colors = shaded_srgb(np.tile(albedo, (400, 1)), open_transfer(normals), light.view_from(R))
        rows.append((seen, np.full(len(seen), t), colors[seen], np.tile([0, 1.0, -0.3] @ R, (len(seen), 1))))
    disc, picture, color, directions = (np.concatenate(items) for items in zip(*rows, strict=True))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    observations = SurfelObservations(
        disc=disc, image_index=picture, color_srgb=color, pixels=np.full(len(disc), 4.0),
        directions_body=directions, Ts_world_body=Ts,
    )  # fmt: skip
    return observations, normals


def test_light_is_told_from_paint_by_turning(toy_scene):
    albedo = np.array([0.2, 0.3, 0.4])
    observations, normals = observe_a_ball(toy_scene.light, albedo, 12)
    ones = np.ones(400, np.int32)
    gaussians = gaussians_of(
        means=0.1 * normals,
        quats=np.tile([1.0, 0, 0, 0], (400, 1)),
        scales=np.full((400, 3), 0.005),
        opacities=np.ones(400),
        sh=np.zeros((400, 1, 3)),
    )
    discs = RobotDiscs(gaussians=gaussians, normals=normals, bodies=ones, materials=0 * ones)
    relit, _ = fit_robot_colors(observations, discs)
    # Orientations between those seen, without their memories.
    R = matrix_from_rotvec(np.array([0, 0, 0.4]))
    want = shaded_srgb(np.tile(albedo, (400, 1)), open_transfer(normals), toy_scene.light.view_from(R))
    got = shaded_srgb(relit.albedo_linear, open_transfer(normals), relit.lights[0].view_from(R))
    seen = normals @ R.T @ [0, -1.0, 0.3] > 0.3
    assert np.abs(got - want)[seen].mean() < 0.02


def test_memories_fade_with_the_turn():
    Rs = np.stack([np.eye(3), matrix_from_rotvec(np.array([0, 0, 0.5]))])
    memory = ResidualAppearance(
        body=1,
        rows=np.arange(3),
        Rs_world_body=Rs,
        difference_srgb=np.ones((2, 3, 3), np.float32),
        reach_rad=0.15,
    )
    at = memory.weights(matrix_from_rotvec(np.outer([0.0, 0.5, 0.25, 2.0], [0, 0, 1])))
    assert at[0, 0] > 0.98
    assert at[1, 1] > 0.98
    np.testing.assert_allclose(at[2, 0], at[2, 1])
    assert at[3].sum() < 1e-3


def test_weights_do_not_depend_on_the_world_frame():
    rng = np.random.default_rng(3)
    Rs = matrix_from_rotvec(rng.normal(0, 0.2, (5, 3)))
    Q = matrix_from_rotvec(np.array([0.4, -1.0, 0.2]))
    one = orientation_weights(Rs, Rs[2:3], 0.2)
    np.testing.assert_allclose(orientation_weights(Q @ Rs, Q @ Rs[2:3], 0.2), one, atol=1e-7)


def test_the_video_teaches_what_the_scan_could_not_see(toy_scene):
    # The demonstration's camera looks at an opened door; the other way round, its inside is red.
    scan = toy_scene.twin.scan_state
    opened = replace(scan, theta=1.2)
    twin = toy_scene.twin
    sh = np.array(twin.gaussians.sh)
    inside = twin.labels == MOVING
    sh[inside] = 0
    sh[inside, 0] = (np.array([0.8, 0.1, 0.1]) - 0.5) / SH_C0
    red = replace(twin, gaussians=twin.gaussians.with_sh(sh))
    camera = toy_scene.camera
    view = PosedImages(
        camera=camera, images_srgb=(drawn(red, toy_scene, opened, camera),) * 30, states=(opened,) * 30
    )
    taught = refine_twin(twin, toy_scene.robot, [view], np.random.default_rng(0))
    before, after = (error(item, toy_scene, view) for item in (twin, taught))
    assert after < 0.5 * before
    np.testing.assert_array_equal(taught.bodies, twin.bodies)
    np.testing.assert_array_equal(taught.gaussians.opacities, twin.gaussians.opacities)


def test_a_good_twin_is_hardly_changed(toy_scene):
    twin = toy_scene.twin
    (view,) = pictures(toy_scene, twin.scan_state, EYES[:1])
    taught = refine_twin(twin, toy_scene.robot, [view] * 20, np.random.default_rng(0))
    assert error(taught, toy_scene, view) < 4.0
    assert refine_twin(twin, toy_scene.robot, [], np.random.default_rng(0)) is twin


def test_a_shadow_that_is_elsewhere_in_every_picture_is_not_learned(toy_scene):
    twin, camera = toy_scene.twin, toy_scene.camera
    clean = drawn(twin, toy_scene, twin.scan_state, camera)
    images = []
    for i in range(8):
        image = np.array(clean)
        image[:, 20 * i : 20 * i + 20] //= 2
        images.append(image)
    view = PosedImages(camera=camera, images_srgb=tuple(images), states=(twin.scan_state,) * 8)
    taught = refine_twin(twin, toy_scene.robot, [view], np.random.default_rng(0))
    difference = drawn(taught, toy_scene, twin.scan_state, camera).astype(float) - clean
    assert abs(difference.mean()) < 0.5 * abs(np.mean([i.astype(float) - clean for i in images]))


@pytest.mark.parametrize("spoil", ["light_of", "rows"])
def test_relit_surfaces_without_light_or_row_are_refused(spoil):
    surfaces = np.zeros((2, 3), np.float32), np.zeros((2, 9), np.float32)
    rows = [0, 2] if spoil == "rows" else [0, 1]
    residual = ResidualAppearance(
        body=1, rows=rows, Rs_world_body=np.eye(3)[None], difference_srgb=np.zeros((1, 2, 3)), reach_rad=0.1
    )
    with pytest.raises(ValueError, match="index"):
        Relit(
            indices=[0, 1],
            albedo_linear=surfaces[0],
            transfer=surfaces[1],
            light_of=[0, 1] if spoil == "light_of" else [0, 0],
            lights=(light_from_harmonics(np.zeros((9, 3))),),
            residuals=(residual,),
        )
