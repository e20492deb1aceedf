from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial import cKDTree

from aomgen.conventions import ROBOT, linear_from_srgb, srgb_from_linear
from aomgen.core.camera import Camera, look_at
from aomgen.core.environment_map import EnvironmentMap, map_directions
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.light import hemisphere_light, open_transfer
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.sh import sh_basis, sphere_directions
from aomgen.core.transforms import apply
from aomgen.lighting.light_estimation import (
    LIMITS,
    REFLECTED,
    LitSamples,
    SceneLight,
    ToneCurve,
    estimate_light,
    fit_unseen,
    light_of_map,
    radiance_around,
)
from aomgen.lighting.probe import Probe, probe_light
from aomgen.lighting.visibility import BODY_CELLS, Occluders, estimate_transfer
from aomgen.twin.twin import pose_twin

AXES = np.concatenate([np.eye(3), -np.eye(3)])
COUNT = 2000
NO_TABLE = LitSamples(transfer=np.zeros((0, 9)), albedo=np.zeros((0, 3)), seen=np.zeros((0, 3)))
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


def camera_at(place, towards):
    """One that sees 127 degrees."""
    pose = look_at(place, towards)
    return Camera(fx=20, fy=20, cx=40, cy=40, width=80, height=80, T_world_cam=pose)


def robot_in(around, tone, rng, glints=0.0):
    normals = rng.normal(size=(1500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    palette = np.array([[0.64, 0.64, 0.64], [0.2, 0.42, 0.6], [0.07, 0.07, 0.07]])
    albedo = palette[rng.integers(0, 3, 1500)]
    transfer = open_transfer(normals).astype(float)
    irradiance = np.maximum(transfer @ radiance_around(around, UNSEEN, tone), 0)
    seen = tone.show((albedo + REFLECTED) * irradiance)
    seen[rng.random(1500) < glints] = 1.0
    return LitSamples(transfer=transfer, albedo=albedo, seen=np.clip(seen, 0, 1))


def table_in(around, tone, albedo):
    """A table beside a box, in which a half sphere of directions is hidden from some of the cells."""
    normals = np.tile([0.0, 0.0, 1.0], (400, 1))
    box = np.stack(
        np.meshgrid(np.arange(0.02, 0.4, 0.01), np.arange(-0.5, 0.5, 0.01), np.arange(0, 0.4, 0.01)), -1
    ).reshape(-1, 3)
    points = np.column_stack([-np.linspace(0.01, 1.5, 400), np.zeros(400), np.full(400, 0.001)])
    transfer = estimate_transfer(points, normals, Occluders(box, BODY_CELLS))[0]
    seen = tone.show(albedo * np.maximum(transfer @ radiance_around(around, UNSEEN, tone), 0))
    return LitSamples(transfer=transfer, albedo=np.ones((400, 3)), seen=np.clip(seen, 0, 1))


@pytest.mark.parametrize(
    ("tone", "glints"),
    [
        (ToneCurve(), 0.0),
        (ToneCurve(color_loss=0.6), 0.0),
        (ToneCurve(shoulder=0.8, color_loss=0.3), 0.0),
        (ToneCurve(shoulder=0.3, color_loss=0.2), 0.1),
    ],
)
def test_light_from_where_nothing_was_scanned_is_found_on_the_robot(tone, glints):
    around = probe(1.0, tone.show(np.array([0.2, 0.15, 0.1])))
    samples = robot_in(around, tone, np.random.default_rng(0), glints)
    unseen, found = fit_unseen(samples, around, NO_TABLE, around)
    assert found.shoulder == pytest.approx(tone.shoulder, abs=0.08)
    # One blue tells little of what is lost of it.
    assert found.color_loss == pytest.approx(tone.color_loss, abs=0.2)
    true, ours = (
        curve.show(open_transfer(AXES) @ radiance_around(around, light, curve))
        for light, curve in ((UNSEEN, tone), (unseen, found))
    )
    np.testing.assert_allclose(ours, true, atol=0.06)


def test_a_shadow_tells_from_where_the_light_comes_when_little_of_the_robot_is_seen():
    """All that is seen of the robot looks up; the light comes from +x, where a box keeps it from a table."""
    around, tone = probe(1.0, (0.2, 0.15, 0.1)), ToneCurve()
    robot = robot_in(around, tone, np.random.default_rng(0))
    up = robot.transfer[:, 2] > 0.95 * robot.transfer[:, 2].max()
    robot = LitSamples(transfer=robot.transfer[up], albedo=robot.albedo[up], seen=robot.seen[up])
    true = open_transfer(AXES) @ radiance_around(around, UNSEEN, tone)
    errors = []
    for table in (NO_TABLE, table_in(around, tone, np.array([0.5, 0.35, 0.2]))):
        unseen, found = fit_unseen(robot, around, table, around)
        ours = found.show(open_transfer(AXES) @ radiance_around(around, unseen, found))
        errors.append(float(np.abs(ours - true)[[0, 3]].mean()))
    assert errors[1] < 0.6 * errors[0]


def test_at_another_place_what_is_seen_there_counts():
    """Beside a dark wall less light comes than where the robot stands."""
    around = probe(0.0, (0.0, 0.0, 0.0))
    samples = robot_in(around, ToneCurve(), np.random.default_rng(1))
    unseen, tone = fit_unseen(samples, around, NO_TABLE, around)
    directions = sphere_directions(COUNT)
    beside = Probe(
        directions=directions,
        solid_angles=np.full(COUNT, 4 * np.pi / COUNT),
        seen=(directions[:, 0] > 0).astype(float),
        radiance_linear=np.zeros((COUNT, 3)),
    )
    free, shaded = (open_transfer(AXES) @ radiance_around(item, unseen, tone) for item in (around, beside))
    assert (shaded[0] < 0.25 * free[0]).all()
    assert (shaded[3] > 0.7 * free[3]).all()


def test_a_tone_curve_can_be_undone():
    tone = ToneCurve(shoulder=0.7, color_loss=0.6)
    colors = np.random.default_rng(0).uniform(0, 1, (50, 3))
    np.testing.assert_allclose(tone.undo(tone.show(colors)), colors, atol=1e-12)
    np.testing.assert_allclose(ToneCurve().show(colors), colors)


def test_bright_colors_lose_more_than_dark_ones():
    red = np.array([0.9, 0.45, 0.45])
    ratios = [
        float(np.ptp(shown) / shown.max()) for shown in (ToneCurve(0.0, 0.6).show(red * k) for k in (1, 0.1))
    ]
    assert ratios[0] < 0.8 * ratios[1]


@pytest.fixture(scope="module")
def wall():
    """White, a metre away along x."""
    places = np.stack(np.meshgrid([1.0], np.arange(-6, 6, 0.05), np.arange(-6, 6, 0.05)), -1).reshape(-1, 3)
    return Gaussians(
        means=places,
        quats=np.tile([1.0, 0, 0, 0], (len(places), 1)),
        scales=np.tile([0.005, 0.05, 0.05], (len(places), 1)),
        opacities=np.full(len(places), 0.99),
        sh=np.full((len(places), 1, 3), 0.5 / 0.28209479),
    )


def test_a_probe_sees_the_whole_sphere_once_and_a_wall_where_it_is(wall):
    outside = camera_at((-3.0, 0.5, 0.0), (1.0, 0.0, 0.0))
    found = probe_light(wall, np.zeros(3), [outside])
    assert found.solid_angles.sum() == pytest.approx(4 * np.pi)
    np.testing.assert_allclose(found.project(np.ones((len(found.seen), 1)))[1:], 0, atol=0.02)
    towards = found.directions[:, 0] > 0.3
    away = found.directions[:, 0] < 0
    assert found.seen[towards].min() > 0.9
    assert found.seen[away].max() == 0
    np.testing.assert_allclose(found.radiance_linear[towards], 1.0, atol=0.02)


def test_what_lies_in_no_frame_of_the_scan_is_not_known(wall):
    """A camera before the wall that looks along it has the side of +y in its frame."""
    beside = camera_at((-0.5, 0.0, 0.0), (-0.3, 1.0, 0.0))
    found = probe_light(wall, np.zeros(3), [beside])
    towards = (found.directions[:, 0] > 0.5) & (np.abs(found.directions[:, 2]) < 0.3)
    left, right = (found.seen[towards & (sign * found.directions[:, 1] > 0.5)] for sign in (1, -1))
    assert left.min() > 0.9
    assert right.max() == 0


def shaded_by_itself(scene, rays=64):
    """The twin of a scene whose robot has the colors that rays among its meshes find, one bounce included."""
    spec = mujoco.MjSpec()
    Ts = scene.robot.link_poses(scene.twin.scan_state.joints[None], [0.0])[0]
    rng, points, normals = np.random.default_rng(5), [], []
    for k, mesh in enumerate(scene.robot.meshes):
        vertices = apply(Ts[mesh.body], mesh.vertices_body)
        spec.add_mesh(name=str(k), uservert=vertices.ravel(), userface=mesh.faces.ravel())
        spec.meshes[-1].inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(k))
        places, faces, _ = sample_surface(vertices, mesh.faces, 2000, rng)
        points.append(places)
        normals.append(face_normals_areas(vertices, mesh.faces)[0][faces])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    palette = np.array([linear_from_srgb(mesh.color_srgb) for mesh in scene.robot.meshes])
    nearest = cKDTree(np.concatenate(points))
    normals = np.concatenate(normals)
    world = pose_twin(scene.twin, scene.robot, scene.twin.scan_state)
    sh = np.array(scene.twin.gaussians.sh)
    hits, distances = np.zeros(rays, np.int32), np.zeros(rays)
    mean = scene.light.irradiance(sphere_directions(200)).mean(0)
    for row in np.flatnonzero(scene.twin.labels == ROBOT):
        which = int(nearest.query(world.means[row])[1])
        ways = sphere_directions(rays) + normals[which]
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        start = world.means[row] + 0.002 * normals[which]
        mujoco.mj_multiRay(model, data, start, ways.ravel(), None, 1, -1, hits, distances, None, rays, 10.0)
        sent = np.where(
            hits[:, None] < 0,
            np.maximum(sh_basis(ways, 2) @ scene.light.radiance_sh, 0),
            palette[hits] * mean,
        )
        color = srgb_from_linear(np.minimum((palette[which // 2000] + REFLECTED) * sent.mean(0), 1))
        sh[row, 0] = (color - 0.5) / SH_C0
    return replace(scene.twin, gaussians=scene.twin.gaussians.with_sh(sh))


@pytest.mark.slow
def test_light_is_read_from_the_robot_of_a_scene_past_its_shadow_on_itself(toy_scene):
    twin = shaded_by_itself(toy_scene)
    views = [camera_at((np.cos(a), np.sin(a), 2.0), (0.0, 0.0, 0.2)) for a in np.linspace(0, 6, 12)]
    still = twin.gaussians.select(twin.bodies == 0)
    place = np.array([0.3, 0.4, 0.1])
    found = estimate_light(twin, toy_scene.robot, still, place, NO_TABLE, views, np.random.default_rng(0))
    ours, true = (light.irradiance(AXES).mean(1) for light in (found.shown, toy_scene.light))
    assert found.source == "robot"
    np.testing.assert_allclose(ours[2], true[2], rtol=0.1)
    assert ours[3] < ours[2]
    # Without its shadow a tone curve would explain what is dark.
    np.testing.assert_allclose(found.tone, ToneCurve(), atol=0.2)


def test_without_a_robot_light_comes_from_above(toy_scene):
    bare = toy_scene.twin.select(toy_scene.labels != ROBOT)
    still = bare.gaussians.select(bare.bodies == 0)
    found = estimate_light(
        bare, toy_scene.robot, still, np.zeros(3), NO_TABLE, [toy_scene.camera], np.random.default_rng(0)
    )
    assert (found.source, found.tone) == ("scene", ToneCurve())
    up, down = found.shown.irradiance(np.array([[0, 0, 1], [0, 0, -1.0]])).mean(1)
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
    np.testing.assert_allclose(open_transfer(normals) @ around.project(radiance), by_hand, atol=0.01)


@pytest.mark.parametrize(("gain", "tone"), [(1e-3, ToneCurve()), (1e3, ToneCurve(0.7, 0.4))])
def test_a_map_is_as_bright_as_the_scene_and_keeps_its_directions_and_colors(gain, tone):
    """A red lamp on the side of +y, under a grey sky."""
    radiance = np.full((32, 64, 3), 0.5)
    radiance[map_directions(32, 64) @ [0.0, 0.8, 0.6] > 0.95] += (20.0, 5.0, 5.0)
    scan = SceneLight(hemisphere_light(np.ones(3), np.full(3, 0.4)), tone, "robot")
    found = light_of_map(EnvironmentMap(radiance_linear=gain * radiance), scan, "file")
    assert (found.tone, found.source) == (tone, "file")
    answer = found.shown.irradiance(AXES)
    assert answer[2].mean() == pytest.approx(scan.shown.irradiance(AXES)[2].mean(), rel=0.05)
    arriving = found.arriving.irradiance(AXES)
    assert arriving[2].mean() == pytest.approx(scan.arriving.irradiance(AXES)[2].mean())
    assert arriving[1, 0] > 3 * arriving[4, 0] > 0
    assert arriving[1, 0] / arriving[1, 1] == pytest.approx(2.3, abs=0.7)
    assert 1 < answer[1, 0] / answer[1, 1] <= arriving[1, 0] / arriving[1, 1] * 1.001
