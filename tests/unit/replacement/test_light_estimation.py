import numpy as np
import pytest

from aomgen.conventions import ROBOT
from aomgen.core.environment_map import EnvironmentMap, map_directions
from aomgen.core.gaussians import Gaussians
from aomgen.core.light import cosine_answer, hemisphere_light
from aomgen.core.sh import sh_basis
from aomgen.replacement.light_estimation import (
    LIMITS,
    REFLECTED,
    LitSamples,
    SceneLight,
    estimate_light,
    fit_unseen,
    light_of_map,
    lose_color,
    radiance_around,
)
from aomgen.replacement.probe import Probe, probe_light
from aomgen.splatting.surfaces import sphere_directions

AXES = np.concatenate([np.eye(3), -np.eye(3)])
COUNT = 2000
# Light of a room: what is not seen of it comes from above and from one side.
UNSEEN = np.zeros((9, 3))
UNSEEN[0], UNSEEN[2], UNSEEN[3] = (3.0, 2.8, 2.5), (1.2, 1.2, 1.2), (0.9, 0.7, 0.5)


def probe(seen_below, radiance):
    """A place from which the lower half of the sphere is seen to a share."""
    directions = sphere_directions(COUNT)
    return Probe(
        directions=directions,
        solid_angles=np.full(COUNT, 4 * np.pi / COUNT),
        seen=np.where(directions[:, 2] < 0, seen_below, 0.0),
        radiance_linear=np.broadcast_to(radiance, (COUNT, 3)),
    )


def robot_in(around, loss, rng, glints=0.0):
    normals = rng.normal(size=(1500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    palette = np.array([[0.64, 0.64, 0.64], [0.2, 0.42, 0.6], [0.07, 0.07, 0.07]])
    albedo = palette[rng.integers(0, 3, 1500)]
    irradiance = np.maximum(cosine_answer(normals) @ radiance_around(around, UNSEEN, loss), 0)
    seen = lose_color((albedo + REFLECTED) * irradiance, loss)
    seen[rng.random(1500) < glints] = 1.0
    return LitSamples(normals=normals, albedo=albedo, seen=np.clip(seen, 0, 1))


@pytest.mark.parametrize(("loss", "glints"), [(0.0, 0.0), (0.4, 0.0), (0.2, 0.1)])
def test_light_from_where_nothing_was_scanned_is_found_on_the_robot(loss, glints):
    around = probe(1.0, (0.2, 0.15, 0.1))
    samples = robot_in(around, loss, np.random.default_rng(0), glints)
    unseen, found = fit_unseen(samples, around)
    assert abs(found - loss) < 0.06
    true, ours = (
        cosine_answer(AXES) @ lose_color(radiance_around(around, light, share), share)
        for light, share in ((UNSEEN, loss), (unseen, found))
    )
    np.testing.assert_allclose(ours, true, atol=0.06)


def test_at_another_place_what_is_seen_there_counts():
    """Beside a dark wall less light comes than where the robot stands."""
    around = probe(0.0, (0.0, 0.0, 0.0))
    unseen, loss = fit_unseen(robot_in(around, 0.0, np.random.default_rng(1)), around)
    directions = sphere_directions(COUNT)
    beside = Probe(
        directions=directions,
        solid_angles=np.full(COUNT, 4 * np.pi / COUNT),
        seen=(directions[:, 0] > 0).astype(float),
        radiance_linear=np.zeros((COUNT, 3)),
    )
    free, shaded = (cosine_answer(AXES) @ radiance_around(item, unseen, loss) for item in (around, beside))
    assert (shaded[0] < 0.25 * free[0]).all()
    assert (shaded[3] > 0.7 * free[3]).all()


def test_a_loss_of_color_keeps_greys_and_can_be_undone():
    colors = np.random.default_rng(0).uniform(0, 1, (50, 3))
    lost = lose_color(colors, 0.3)
    np.testing.assert_allclose(lost.mean(-1), colors.mean(-1))
    np.testing.assert_allclose(lose_color(lost, -0.3 / 0.7), colors, atol=1e-12)


def test_a_probe_sees_the_whole_sphere_once_and_a_wall_where_it_is():
    wall = np.stack(np.meshgrid([1.0], np.arange(-6, 6, 0.05), np.arange(-6, 6, 0.05)), -1).reshape(-1, 3)
    gaussians = Gaussians(
        means=wall,
        quats=np.tile([1.0, 0, 0, 0], (len(wall), 1)),
        scales=np.tile([0.005, 0.05, 0.05], (len(wall), 1)),
        opacities=np.full(len(wall), 0.99),
        sh=np.full((len(wall), 1, 3), 0.5 / 0.28209479),
    )
    found = probe_light(gaussians, np.zeros(3))
    assert found.solid_angles.sum() == pytest.approx(4 * np.pi)
    np.testing.assert_allclose(found.project(np.ones((len(found.seen), 1)))[1:], 0, atol=0.02)
    towards = found.directions[:, 0] > 0.3
    away = found.directions[:, 0] < 0
    assert found.seen[towards].min() > 0.9
    assert found.seen[away].max() == 0
    np.testing.assert_allclose(found.radiance_linear[towards], 1.0, atol=0.02)


def test_light_is_read_from_the_robot_of_a_scene(toy_scene):
    eyes = np.array([[0.5 * np.cos(a), 0.5 * np.sin(a), 1.0] for a in np.linspace(0, 6, 12)]) * 2
    still = toy_scene.twin.gaussians.select(toy_scene.twin.bodies == 0)
    nothing = still.select(np.zeros(0, np.int64))
    place = np.array([0.6, 0.0, 0.1])
    found = estimate_light(toy_scene.twin, toy_scene.robot, nothing, place, eyes, np.random.default_rng(0))
    assert found.source == "robot"
    up, side = found.light.irradiance(AXES)[2], found.light.irradiance(AXES)[3]
    np.testing.assert_allclose(up, toy_scene.light.irradiance(AXES)[2], atol=0.2)
    assert side.mean() < up.mean()


def test_without_a_robot_light_comes_from_above(toy_scene):
    bare = toy_scene.twin.select(toy_scene.labels != ROBOT)
    still = bare.gaussians.select(bare.bodies == 0)
    found = estimate_light(
        bare, toy_scene.robot, still, np.zeros(3), np.array([[0.0, 0.0, 2.0]]), np.random.default_rng(0)
    )
    assert (found.source, found.color_loss) == ("scene", 0.0)
    up, down = found.light.irradiance(np.array([[0, 0, 1], [0, 0, -1.0]])).mean(1)
    assert up > down
    assert LIMITS[0] * 0.9 <= up <= LIMITS[1]


def test_harmonics_answer_as_a_cosine_does():
    normals, directions = AXES, sphere_directions(20_000)
    radiance = np.maximum(sh_basis(directions, 2) @ UNSEEN, 0)
    around = Probe(
        directions=directions,
        solid_angles=np.full(20_000, 4 * np.pi / 20_000),
        seen=np.ones(20_000),
        radiance_linear=radiance,
    )
    by_hand = np.maximum(normals @ directions.T, 0) @ radiance * 4 / 20_000
    np.testing.assert_allclose(cosine_answer(normals) @ around.project(radiance), by_hand, atol=0.01)


@pytest.mark.parametrize(("gain", "loss"), [(1e-3, 0.0), (1e3, 0.4)])
def test_a_map_is_as_bright_as_the_scene_and_keeps_its_directions_and_colors(gain, loss):
    """A red lamp on the side of +y, under a grey sky."""
    radiance = np.full((32, 64, 3), 0.5)
    radiance[map_directions(32, 64) @ [0.0, 0.8, 0.6] > 0.95] += (20.0, 5.0, 5.0)
    scan = SceneLight(hemisphere_light(np.ones(3), np.full(3, 0.4)), loss, "robot")
    found = light_of_map(EnvironmentMap(radiance_linear=gain * radiance), scan, "file")
    assert (found.color_loss, found.source) == (loss, "file")
    answer = found.light.irradiance(AXES)
    assert answer[2].mean() == pytest.approx(scan.light.irradiance(AXES)[2].mean())
    assert answer[1, 0] > 3 * answer[4, 0] > 0
    assert answer[1, 0] / answer[1, 1] == pytest.approx(1 + 1.3 * (1 - loss), abs=0.7)
