"""Changes of light, material and size: nothing changes nothing, and one after the other is both at once."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.conventions import linear_from_srgb
from aomgen.core.joint import Joint
from aomgen.core.light import DirectionalLight
from aomgen.core.plan import LightChange, MaterialChange
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.lighting.shadowed_twin import render_state
from aomgen.twin.binding import with_object
from aomgen.twin.relighting import ResidualAppearance
from aomgen.twin.twin import TwinModel, pose_bodies
from aomgen.twin.variation import change_appearance, light_gains, material_matrix, scale_object

NO_LIGHT, NO_MATERIAL = LightChange(), MaterialChange()


@pytest.fixture(scope="module")
def twin(toy_scene) -> TwinModel:
    static, moving = toy_scene.surfels
    T = toy_scene.twin.T_world_object
    made = with_object(toy_scene.twin, static, moving, toy_scene.asset.joint, toy_scene.light, T)
    rows = np.flatnonzero(made.relit_bodies == made.body("part"))
    residual = ResidualAppearance(
        body=made.body("part"),
        rows=rows,
        Rs_world_body=np.eye(3)[None],
        difference_srgb=np.full((1, len(rows), 3), 0.05),
        reach_rad=0.4,
    )
    lamp = DirectionalLight(
        directions=np.array([[0.6, 0.0, 0.8]]), T_world_plane=np.eye(4), share=np.full(3, 0.5)
    )
    return replace(made, relit=replace(made.relit, residuals=(residual,)), directional_light=lamp)


def scene_colors(twin: TwinModel) -> np.ndarray:
    return linear_from_srgb(np.maximum(0.5 + 0.28209479 * np.asarray(twin.gaussians.sh[:, 0], float), 0))


def test_nothing_changes_nothing(twin):
    assert change_appearance(twin, NO_LIGHT, NO_MATERIAL) is twin
    assert scale_object(twin, 1.0) is twin
    np.testing.assert_array_equal(light_gains(NO_LIGHT), 1.0)
    np.testing.assert_allclose(material_matrix(NO_MATERIAL), np.eye(3), atol=1e-15)


def test_intensity_is_a_factor_on_all_linear_light_and_factors_multiply(twin):
    half = change_appearance(twin, LightChange(intensity=0.5), NO_MATERIAL)
    np.testing.assert_allclose(scene_colors(half), 0.5 * scene_colors(twin), atol=1e-5)
    np.testing.assert_array_equal(half.relit.lights[0].radiance_sh, 0.5 * twin.relit.lights[0].radiance_sh)
    both = change_appearance(
        change_appearance(twin, LightChange(intensity=0.5), NO_MATERIAL),
        LightChange(intensity=1.2),
        NO_MATERIAL,
    )
    at_once = change_appearance(twin, LightChange(intensity=0.6), NO_MATERIAL)
    np.testing.assert_allclose(both.gaussians.sh, at_once.gaussians.sh, atol=2e-5)
    np.testing.assert_array_equal(half.relit.albedo_linear, twin.relit.albedo_linear)


def test_warm_light_is_redder_cold_light_bluer_and_white_keeps_its_luminance():
    luminance = np.array([0.2126, 0.7152, 0.0722])
    for kelvin in (1700.0, 2500.0, 4000.0, 5000.0, 6500.0, 9000.0, 20_000.0):
        assert light_gains(LightChange(temperature_k=kelvin)) @ luminance == pytest.approx(1.0, abs=1e-3)
    gains = np.array(
        [light_gains(LightChange(temperature_k=kelvin)) for kelvin in (2500, 4001, 3999, 6500, 9000)]
    )
    ratio = gains[:, 0] / gains[:, 2]
    assert ratio[0] > ratio[1] > ratio[3] == 1 > ratio[4]
    np.testing.assert_allclose(gains[1], gains[2], atol=0.01)
    for kelvin in (1000.0, np.nan):
        with pytest.raises(ValueError, match="temperature"):
            light_gains(LightChange(temperature_k=kelvin))


def test_bodies_that_turn_with_the_light_look_as_before(twin):
    turned = change_appearance(twin, LightChange(turn=0.8), NO_MATERIAL)
    T = transform(matrix_from_rotvec([0.0, 0.0, 0.8]), [0.1, 0.2, 0.0])
    Ts = np.tile(np.eye(4), (len(twin.body_names), 1, 1))
    rows = twin.relit.indices
    before, after = pose_bodies(twin, Ts).sh[rows, 0], pose_bodies(turned, T @ Ts).sh[rows, 0]
    np.testing.assert_allclose(after, before, atol=2e-3)
    assert np.abs(pose_bodies(turned, Ts).sh[rows, 0] - before).max() > 0.05
    np.testing.assert_allclose(
        turned.directional_light.directions[0], T[:3, :3] @ (0.6, 0.0, 0.8), atol=1e-12
    )
    np.testing.assert_array_equal(turned.gaussians.sh, twin.gaussians.sh)
    back = change_appearance(turned, LightChange(turn=-0.8), NO_MATERIAL)
    np.testing.assert_allclose(back.relit.lights[0].radiance_sh, twin.relit.lights[0].radiance_sh, atol=1e-12)


def test_material_is_of_the_object_alone_and_changes_add_up(twin):
    painted = change_appearance(twin, NO_LIGHT, MaterialChange(hue=1.0, saturation=0.8, brightness=0.9))
    mine = np.isin(twin.bodies, [twin.body("object"), twin.body("part")])
    np.testing.assert_array_equal(painted.gaussians.sh[~mine], twin.gaussians.sh[~mine])
    others = ~np.isin(twin.relit_bodies, [twin.body("object"), twin.body("part")])
    np.testing.assert_array_equal(painted.relit.albedo_linear[others], twin.relit.albedo_linear[others])
    assert np.abs(painted.relit.albedo_linear - twin.relit.albedo_linear).max() > 0.05
    assert painted.relit.lights is twin.relit.lights
    first, second = (
        material_matrix(MaterialChange(hue=1.0, saturation=0.5)),
        material_matrix(MaterialChange(hue=-0.3, saturation=0.5, brightness=0.7)),
    )
    at_once = material_matrix(MaterialChange(hue=0.7, saturation=0.25, brightness=0.7))
    np.testing.assert_allclose(second @ first, at_once, atol=1e-12)
    grey = material_matrix(MaterialChange(saturation=0.0)) @ [0.2, 0.4, 0.9]
    np.testing.assert_allclose(grey, 0.5, atol=1e-12)


def test_the_object_is_scaled_about_its_origin_and_comes_back(twin):
    double = scale_object(twin, 2.0)
    mine = np.isin(twin.bodies, [twin.body("object"), twin.body("part")])
    np.testing.assert_allclose(double.gaussians.means[mine], 2 * twin.gaussians.means[mine], rtol=1e-6)
    np.testing.assert_allclose(double.gaussians.scales[mine], 2 * twin.gaussians.scales[mine], rtol=1e-6)
    np.testing.assert_array_equal(double.gaussians.means[~mine], twin.gaussians.means[~mine])
    np.testing.assert_allclose(double.joint.origin, 2 * twin.joint.origin)
    assert double.joint.upper == twin.joint.upper
    again = scale_object(double, 0.5)
    np.testing.assert_allclose(again.gaussians.means, twin.gaussians.means, atol=1e-7)
    drawer = Joint(type="prismatic", axis=(0, -1, 0), origin=(0, 0.1, 0), lower=0, upper=0.3)
    slid = scale_object(replace(twin, joint=drawer), 2.0)
    assert slid.joint.upper == 0.6
    # The part keeps its place relative to the object.
    np.testing.assert_allclose(slid.joint.motion(0.4)[:3, 3], 2 * drawer.motion(0.2)[:3, 3])


def test_a_dimmed_twin_draws_a_dimmed_picture(twin, toy_scene):
    state = replace(twin.scan_state, theta=0.7)
    bright = render_state(twin, toy_scene.robot, state, toy_scene.camera).rgb
    dim = render_state(
        change_appearance(twin, LightChange(intensity=0.6), NO_MATERIAL),
        toy_scene.robot,
        state,
        toy_scene.camera,
    ).rgb
    solid = bright.min(-1) > 0.1
    ratio = linear_from_srgb(dim[solid]) / linear_from_srgb(bright[solid])
    assert np.median(ratio) == pytest.approx(0.6, abs=0.01)
    assert (np.abs(ratio - 0.6) < 0.06).mean() > 0.97
