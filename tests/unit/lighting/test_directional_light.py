"""The lamp that throws the robot's shadow: found, taken off the table, cast anew."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from aomgen.appearance.refine import refine_twin
from aomgen.conventions import linear_from_srgb
from aomgen.core.light import DirectionalLight, spread_directions
from aomgen.errors import MalformedFileError
from aomgen.io.artifact import load_artifact, read_json, save_artifact
from aomgen.io.atomic import write_json
from aomgen.lighting.directional_light import find_directional_light
from aomgen.lighting.plane_shadow import measure_blocked_light, select_casters
from aomgen.lighting.shadowed_twin import (
    EDGE_M,
    pose_with_shadow,
    remove_baked_shadow,
    remove_shadow,
    render_state,
)
from aomgen.splatting.rasterizer import render
from aomgen.twin.twin import PosedImages, TwinModel, body_poses, pose_twin

# Share of the light that the shadow lacks, and the sRGB color of mid-grey in shadow over that in light, roughly.
SHARE = 1 - np.array([0.6, 0.58, 0.55]) ** 2.2
PLANE = np.eye(4)


def lamp_from(x: float, y: float, width: float = 0.0) -> DirectionalLight:
    direction = np.array([x, y, 1.0]) / np.linalg.norm([x, y, 1.0])
    return DirectionalLight(directions=spread_directions(direction, width), T_world_plane=PLANE, share=SHARE)


def make_images(scene, lamp, rng, count=12) -> PosedImages:
    """The arm sweeps over the table; pictures have noise."""
    rest = scene.twin.scan_state
    states, images = [], []
    for share in np.linspace(-1, 1, count):
        joints = rest.joints + share * np.array([0.5, 0.3, -0.3, 0, 0.2, 0])
        state = replace(rest, joints=joints)
        rgb = render_state(replace(scene.twin, directional_light=lamp), scene.robot, state, scene.camera).rgb
        images.append(np.clip(np.rint(rgb * 255 + rng.normal(0, 2, rgb.shape)), 0, 255).astype(np.uint8))
        states.append(state)
    return PosedImages(camera=scene.camera, images_srgb=tuple(images), states=tuple(states))


@pytest.mark.parametrize(("lean", "exposure"), [((0.2, -0.3), (1.0, 1.0)), ((-0.5, 0.1), (0.8, 1.1))])
def test_a_lamp_is_found_by_the_shadow_it_throws(toy_scene, lean, exposure):
    true = lamp_from(*lean)
    view = make_images(toy_scene, true, np.random.default_rng(0))
    # Exposure that drifts does not matter.
    gains = np.linspace(exposure[0], exposure[1], len(view.states))
    images = tuple(
        np.clip(gain * image, 0, 255).astype(np.uint8)
        for gain, image in zip(gains, view.images_srgb, strict=True)
    )
    found = find_directional_light(toy_scene.twin, toy_scene.robot, replace(view, images_srgb=images), PLANE)
    assert found is not None
    assert np.degrees(np.arccos(min(found.directions[0] @ true.directions[0], 1.0))) < 2.0
    np.testing.assert_allclose(found.share, SHARE, atol=0.04)


@pytest.mark.parametrize("width", [0.0, 0.2])
def test_the_width_of_a_lamp_is_found_by_its_penumbra(toy_scene, width):
    true = lamp_from(0.2, -0.3, width)
    view = make_images(toy_scene, true, np.random.default_rng(0))
    found = find_directional_light(toy_scene.twin, toy_scene.robot, view, PLANE)
    assert found is not None
    angles = np.arccos(np.clip(found.directions @ found.directions[0], -1, 1))
    # Six of seven directions are on a ring, see `spread_directions`.
    assert abs(np.sqrt(2 * np.mean(angles**2)) - width) <= 0.06
    np.testing.assert_allclose(found.share, SHARE, atol=0.06)


def test_directions_of_a_wide_lamp_lie_around_its_middle():
    middle = lamp_from(0.2, -0.3).directions[0]
    spread = spread_directions(middle, 0.1)
    np.testing.assert_allclose(np.linalg.norm(spread, axis=1), 1)
    np.testing.assert_allclose(spread.mean(0) / np.linalg.norm(spread.mean(0)), middle, atol=1e-9)
    angles = np.arccos(np.clip(spread @ middle, -1, 1))
    # A disc of half an angle a has the mean square a^2 / 2 of its angles.
    assert np.mean(angles**2) == pytest.approx(0.1**2 / 2, rel=0.02)
    np.testing.assert_array_equal(spread_directions(middle, 0.0), middle[None])


def test_the_shadow_of_a_wide_lamp_is_taken_off_the_table(toy_scene):
    lamp = lamp_from(0.2, -0.3, 0.15)
    scanned, dark = baked(toy_scene, lamp)
    freed = remove_baked_shadow(scanned, toy_scene.robot, lamp)
    wrong, right = (
        np.abs(twin.gaussians.sh - toy_scene.twin.gaussians.sh)[dark > 0.02, 0].mean()
        for twin in (scanned, freed)
    )
    assert right < 0.1 * wrong


def test_without_a_shadow_there_is_no_lamp(toy_scene):
    rng = np.random.default_rng(0)
    view = make_images(toy_scene, None, rng, count=8)
    assert find_directional_light(toy_scene.twin, toy_scene.robot, view, PLANE) is None
    # Neither when the table changes for another reason.
    patches = [
        np.clip(np.kron(rng.uniform(0.5, 1, (12, 16, 1)), np.ones((10, 10, 1))) * image, 0, 255)
        for image in view.images_srgb
    ]
    flicker = replace(view, images_srgb=tuple(patch.astype(np.uint8) for patch in patches))
    assert find_directional_light(toy_scene.twin, toy_scene.robot, flicker, PLANE) is None


def test_a_surface_that_is_not_seen_gives_no_lamp(toy_scene):
    view = make_images(toy_scene, lamp_from(0.2, -0.3), np.random.default_rng(0))
    above = np.eye(4)
    above[2, 3] = 3.0
    assert find_directional_light(toy_scene.twin, toy_scene.robot, view, above) is None


def baked(scene, lamp):
    """The scene as a scan under the lamp gives it, and how much of each Gaussian is in shadow."""
    twin = scene.twin
    world = pose_twin(twin, scene.robot, twin.scan_state)
    flat = (twin.bodies == 0) & (np.abs(world.means[:, 2]) < 0.005)
    dark = flat * block(scene, lamp, world.means)
    return replace(twin, gaussians=twin.gaussians.illuminate(1 - dark[:, None] * lamp.share)), dark


def block(scene, lamp, points):
    """Share (N,) of the lamp's light that is blocked at points (N, 3) in the scan's state."""
    Ts = body_poses(scene.twin, scene.robot, scene.twin.scan_state)
    casters = select_casters(scene.twin, scene.robot)
    return measure_blocked_light(casters, Ts[None], PLANE, lamp.directions, points)[0]


def test_the_table_without_its_shadow_is_the_table_in_light(toy_scene):
    lamp = lamp_from(0.2, -0.3)
    scanned, dark = baked(toy_scene, lamp)
    freed = remove_baked_shadow(scanned, toy_scene.robot, lamp)

    def error(twin):
        return np.abs(twin.gaussians.sh - toy_scene.twin.gaussians.sh)[dark > 0.02, 0].mean()

    assert freed.directional_light is lamp
    assert (dark > 0.9).sum() > 100
    assert error(freed) < 0.25 * error(scanned)
    world = pose_twin(scanned, toy_scene.robot, scanned.scan_state)
    away = cKDTree(world.means[dark > 0]).query(world.means)[0] > 2 * EDGE_M
    np.testing.assert_allclose(freed.gaussians.sh[away], scanned.gaussians.sh[away], atol=1e-6)
    # Cast anew, the configuration of the scan looks as it was scanned, but for blurred edges.
    state = toy_scene.twin.scan_state
    was, now, lit = (
        render_state(twin, toy_scene.robot, state, toy_scene.camera).rgb
        for twin in (scanned, freed, toy_scene.twin)
    )
    assert np.abs(now - was).mean() < 0.5 * np.abs(lit - was).mean()


def test_unshading_undoes_a_shade(toy_scene):
    gaussians = toy_scene.gaussians
    lamp = lamp_from(0.2, -0.3)
    none = remove_shadow(gaussians, np.zeros(len(gaussians)), lamp)
    np.testing.assert_allclose(none.sh, gaussians.sh, atol=1e-6)
    whole = remove_shadow(gaussians, np.ones(len(gaussians)), lamp)
    np.testing.assert_allclose(
        linear_from_srgb(whole.colors_srgb) * (1 - SHARE), linear_from_srgb(gaussians.colors_srgb), atol=1e-5
    )


def test_training_under_a_lamp_does_not_learn_its_shadow(toy_scene):
    lamp = lamp_from(0.2, -0.3)
    twin = replace(toy_scene.twin, directional_light=lamp)
    view = make_images(toy_scene, lamp, np.random.default_rng(0), count=1)
    state = view.states[0]
    training_views = [view] * 12
    plain = refine_twin(toy_scene.twin, toy_scene.robot, training_views, np.random.default_rng(0))
    knowing = refine_twin(twin, toy_scene.robot, training_views, np.random.default_rng(0))
    lit, learned, kept = (
        render_state(replace(t, directional_light=None), toy_scene.robot, state, toy_scene.camera).rgb
        for t in (twin, plain, knowing)
    )
    shadow = render_state(twin, toy_scene.robot, state, toy_scene.camera).rgb.mean(-1) < 0.8 * lit.mean(-1)
    assert np.abs(kept - lit)[shadow].mean() < 0.4 * np.abs(learned - lit)[shadow].mean()


def test_the_base_throws_no_shadow_that_moves(toy_scene):
    lamp = lamp_from(0.5, 0.0)
    moving, standing = select_casters(toy_scene.twin, toy_scene.robot)
    base = toy_scene.twin.body(toy_scene.robot.body_names[0])
    assert base in standing.bodies
    assert base not in moving.bodies
    # Right under the base only the base is in the way.
    assert block(toy_scene, lamp, np.array([[-0.02, 0.0, 0.0]]))[0] < 0.2


def test_gaussians_of_a_state_hold_its_shadow(toy_scene):
    lamp, rest = lamp_from(0.2, -0.3), toy_scene.twin.scan_state
    twin = replace(toy_scene.twin, directional_light=lamp)
    state = replace(rest, joints=rest.joints + np.array([0.5, 0.3, -0.3, 0, 0.2, 0]))
    wanted = render_state(twin, toy_scene.robot, state, toy_scene.camera).rgb
    found = render(pose_with_shadow(twin, toy_scene.robot, state), toy_scene.camera).rgb
    without = render_state(toy_scene.twin, toy_scene.robot, state, toy_scene.camera).rgb
    shadow = wanted.mean(-1) < 0.8 * without.mean(-1)
    assert shadow.sum() > 50
    assert np.abs(found - wanted)[shadow].mean() < 0.3 * np.abs(without - wanted)[shadow].mean()
    assert np.abs(found - wanted)[~shadow].mean() < 0.01


def test_a_lamp_is_stored_with_its_twin(toy_scene, tmp_path):
    lamp = lamp_from(0.2, -0.3)
    for twin in (toy_scene.twin, replace(toy_scene.twin, directional_light=lamp)):
        save_artifact(tmp_path, "twin", twin)
        again = load_artifact(tmp_path, "twin", TwinModel).directional_light
        assert (again is None) == (twin.directional_light is None)
        if again is not None:
            np.testing.assert_array_equal(again.directions, lamp.directions)
            np.testing.assert_array_equal(again.share, lamp.share)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda header: header.update(type="Scene"),
        lambda header: header["value"].pop("directional_light"),
        lambda header: header["value"]["directional_light"].update(share=[2.0, 0.5, 0.5]),
        lambda header: header["value"]["directional_light"].update(directions=[[0.0, 0.0, 2.0]]),
        lambda header: header["value"]["directional_light"].update(T_world_plane=[1.0]),
    ],
)
def test_a_spoiled_lamp_is_refused(toy_scene, tmp_path, spoil):
    save_artifact(tmp_path, "twin", replace(toy_scene.twin, directional_light=lamp_from(0.2, -0.3)))
    header = read_json(tmp_path / "twin.json")
    spoil(header)
    write_json(tmp_path / "twin.json", header)
    with pytest.raises(MalformedFileError, match="twin"):
        load_artifact(tmp_path, "twin", TwinModel)


def test_a_lamp_needs_a_direction_and_a_share():
    up = np.array([[0, 0, 1.0]])
    with pytest.raises(ValueError, match="direction"):
        DirectionalLight(directions=0 * up, T_world_plane=PLANE, share=SHARE)
    with pytest.raises(ValueError, match="share"):
        DirectionalLight(directions=up, T_world_plane=PLANE, share=np.ones(3))
