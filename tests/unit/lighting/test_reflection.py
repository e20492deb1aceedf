from dataclasses import replace

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.conventions import srgb_from_linear
from aomgen.core.gaussians import SH_C0
from aomgen.core.light import hemisphere_light, light_from_harmonics, open_transfer
from aomgen.core.sh import sh_basis
from aomgen.core.transforms import matrix_from_rotvec
from aomgen.lighting.light_estimation import REFLECTED, SceneLight, ToneCurve
from aomgen.lighting.reflection import show_in_light
from aomgen.splatting.surfels import surfels_of

UPRIGHT = np.eye(3)


@pytest.fixture(scope="module")
def link():
    return surfels_of(make_asset("microwave", 3).moving.meshes, 2000, np.random.default_rng(0))


def scene_light(loss=0.0, sky=(0.9, 0.9, 0.9), ground=(0.2, 0.2, 0.2)):
    return SceneLight(hemisphere_light(sky, ground), ToneCurve(color_loss=loss), "robot")


def seen_from(surfels, light, ways):
    """Linear colors (N, 3) of surfels seen in directions (N, 3), lit."""
    arriving = surfels.transfer @ light.shown.radiance_sh
    base = srgb_from_linear(np.clip(surfels.albedo_linear * arriving, 0, 1))
    rest = np.einsum("nk,nkc->nc", sh_basis(ways, 2)[:, 1:], surfels.gaussians.sh[:, 1:])
    return base + rest


def test_a_mirror_shows_what_lies_in_the_mirrored_direction(link):
    """A smooth dark surface: from above the dark ground is seen in it, from below the bright sky."""
    count = len(link.normals)
    glass = replace(
        link,
        albedo_linear=np.full((count, 3), 0.01, np.float32),
        roughness=np.zeros(count, np.float32),
        metallic=np.zeros(count, np.float32),
    )
    light = scene_light()
    shown = show_in_light(glass, light, UPRIGHT)
    front = glass.normals[:, 1] < -0.95
    down, up = (np.tile([0.0, np.cos(a), np.sin(a)], (count, 1)) for a in (-0.7, 0.7))
    from_above, from_below = (seen_from(shown, light, way)[front].mean() for way in (down, up))
    assert from_below > 1.3 * from_above
    open_front = front & (glass.transfer[:, 0] > 0.25)
    radiance = [
        float(
            np.maximum(
                sh_basis(np.array([[0, -np.cos(a), np.sin(a)]]), 2) @ light.shown.radiance_sh, 0
            ).mean()
        )
        for a in (-0.7, 0.7)
    ]
    true = srgb_from_linear(0.01 * 0.55 + REFLECTED * np.array(radiance))
    ours = [seen_from(shown, light, way)[open_front].mean() for way in (down, up)]
    np.testing.assert_allclose(ours, true, atol=0.05)


def test_rough_surfaces_reflect_less_of_a_difference(link):
    light = scene_light()
    sizes = []
    for roughness in (0.1, 0.9):
        rough = replace(link, roughness=np.full(len(link.normals), roughness, np.float32))
        sizes.append(np.abs(show_in_light(rough, light, UPRIGHT).gaussians.sh[:, 1:]).mean())
    assert sizes[1] < 0.6 * sizes[0]


def test_the_flatter_the_look_the_more_a_smooth_surface_reflects(link):
    """A dark plate in an even light of 1: Schlick's law, and nothing of it when rough."""
    count = len(link.normals)
    front = np.tile([0.0, -1.0, 0.0], (count, 1)).astype(np.float32)
    even = SceneLight(hemisphere_light(np.ones(3), np.ones(3)), ToneCurve(), "robot")
    angles = np.radians([0, 30, 50, 65])
    for roughness, grazing in ((0.2, 0.8), (1.0, REFLECTED)):
        plate = replace(
            link,
            normals=front,
            bends=np.zeros_like(front),
            transfer=open_transfer(front),
            albedo_linear=np.full((count, 3), 0.05, np.float32),
            roughness=np.full(count, roughness, np.float32),
            metallic=np.zeros(count, np.float32),
        )
        shown = show_in_light(plate, even, UPRIGHT)
        ours = [
            seen_from(shown, even, np.tile([np.sin(a), np.cos(a), 0.0], (count, 1))).mean() for a in angles
        ]
        true = srgb_from_linear(0.05 + REFLECTED + (grazing - REFLECTED) * (1 - np.cos(angles)) ** 5)
        # Nine harmonics are too few for a kink.
        np.testing.assert_allclose(ours, true, atol=0.06)


def test_turning_object_and_light_together_changes_nothing(link):
    radiance = np.random.default_rng(0).normal(size=(9, 3)) * 0.2
    radiance[0] = 3.0
    light = light_from_harmonics(radiance)
    R = matrix_from_rotvec([0.0, 0.0, 0.8])
    turned, tone = light_from_harmonics(light.view_from(R.T)), ToneCurve(0.8, 0.1)
    one = show_in_light(link, SceneLight(light, tone, "robot"), UPRIGHT)
    other = show_in_light(link, SceneLight(turned, tone, "robot"), R)
    np.testing.assert_allclose(one.albedo_linear, other.albedo_linear, atol=1e-4)
    np.testing.assert_allclose(one.gaussians.sh, other.gaussians.sh, atol=1e-4)


def test_a_camera_that_loses_color_shows_greyer_surfaces(link):
    red = replace(
        link, albedo_linear=np.tile(np.array([[0.6, 0.1, 0.1]], np.float32), (len(link.normals), 1))
    )
    full, lost = (show_in_light(red, scene_light(loss), UPRIGHT).albedo_linear for loss in (0.0, 0.9))
    spreads = [np.ptp(albedo, axis=1).mean() for albedo in (full, lost)]
    assert spreads[1] < 0.85 * spreads[0]
    # In proportion to how bright a surface is shown.
    brightness = (full * (red.transfer @ scene_light().shown.radiance_sh)).mean(1)
    expected = np.ptp(full, axis=1) * (1 - 0.9 * brightness)
    assert spreads[1] == pytest.approx(expected.mean(), rel=0.1)


def test_the_fitted_color_is_kept_for_its_own_sake(link):
    shown = show_in_light(link, scene_light(), UPRIGHT)
    np.testing.assert_array_equal(shown.gaussians.sh[:, 0], link.gaussians.sh[:, 0])
    assert shown.gaussians.sh.shape[1] == 9
    assert np.isfinite(shown.gaussians.sh).all()
    assert SH_C0 * np.abs(shown.gaussians.sh[:, 1:]).max() < 1
