from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.light import light_from_harmonics
from aomgen.core.sh import sh_basis
from aomgen.core.transforms import angle_between, apply, invert, matrix_from_rotvec, transform
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.io.artifact import load_artifact, save_artifact
from aomgen.lighting.shadowed_twin import render_state
from aomgen.splatting.rasterizer import render
from aomgen.twin.binding import object_frame, with_object
from aomgen.twin.twin import PART, TwinModel, body_poses, moving_layer, pose_bodies, pose_twin, static_layer


def test_the_scanned_state_gives_the_scan_back(toy_scene):
    again = pose_twin(toy_scene.twin, toy_scene.robot, toy_scene.twin.scan_state)
    np.testing.assert_allclose(again.means, toy_scene.gaussians.means, atol=1e-6)
    np.testing.assert_allclose(again.sh, toy_scene.gaussians.sh, atol=1e-5)
    picture = render_state(toy_scene.twin, toy_scene.robot, toy_scene.twin.scan_state, toy_scene.camera)
    np.testing.assert_allclose(picture.rgb, render(toy_scene.gaussians, toy_scene.camera).rgb, atol=2e-3)


def test_a_part_moves_by_its_joint_alone(toy_scene):
    twin, state = toy_scene.twin, replace(toy_scene.twin.scan_state, theta=0.8)
    before, after = toy_scene.gaussians, pose_twin(twin, toy_scene.robot, state)
    part = twin.bodies == twin.body(PART)
    np.testing.assert_array_equal(
        after.means[~part & (twin.bodies == 0)], before.means[~part & (twin.bodies == 0)]
    )
    T = state.T_world_object @ twin.joint.motion(0.8) @ invert(state.T_world_object)
    np.testing.assert_allclose(after.means[part], apply(T, before.means[part]), atol=1e-5)


def test_harmonics_turn_with_their_body(toy_scene):
    twin = toy_scene.twin
    colored = replace(
        twin, gaussians=twin.gaussians.with_sh(np.random.default_rng(0).normal(size=(len(twin.bodies), 9, 3)))
    )
    Ts = body_poses(colored, toy_scene.robot, replace(twin.scan_state, joints=twin.scan_state.joints + 0.5))
    after = pose_twin(colored, toy_scene.robot, replace(twin.scan_state, joints=twin.scan_state.joints + 0.5))
    which = int(np.flatnonzero(twin.bodies == 6)[0])
    direction_body = np.array([[0.36, 0.48, 0.8]])
    seen_body = sh_basis(direction_body, 2) @ colored.gaussians.sh[which]
    seen_world = sh_basis(direction_body @ Ts[6][:3, :3].T, 2) @ after.sh[which]
    np.testing.assert_allclose(seen_world, seen_body, atol=1e-4)


def test_moving_the_whole_object_moves_both_of_its_bodies(toy_scene):
    twin = toy_scene.twin
    shift = transform(matrix_from_rotvec(np.array([0, 0, 0.4])), np.array([0.1, 0.0, 0.0]))
    state = replace(twin.scan_state, T_world_object=shift @ twin.T_world_object, theta=0.3)
    Ts = body_poses(twin, toy_scene.robot, state)
    rest = body_poses(twin, toy_scene.robot, replace(twin.scan_state, theta=0.3))
    np.testing.assert_allclose(Ts[twin.body(PART)], shift @ rest[twin.body(PART)], atol=1e-12)


def test_a_door_gets_darker_when_it_turns_away_from_the_light(toy_scene):
    static, moving = toy_scene.surfels
    twin = with_object(
        toy_scene.twin, static, moving, toy_scene.asset.joint, toy_scene.light, toy_scene.twin.T_world_object
    )
    surface = twin.relit
    assert surface is not None
    closed = pose_twin(twin, toy_scene.robot, twin.scan_state)
    opened = pose_twin(twin, toy_scene.robot, replace(twin.scan_state, theta=1.5))
    part = twin.bodies == twin.body(PART)
    assert np.abs(closed.sh[part, 0] - opened.sh[part, 0]).mean() > 0.05
    normals = np.concatenate([static.normals, moving.normals])
    assert len(normals) == len(surface.indices)
    # The same door in a light without direction stays as it is.
    even = light_from_harmonics(toy_scene.light.radiance_sh * (np.arange(9) == 0)[:, None])
    flat = replace(twin, relit=replace(surface, lights=(even,)))
    a = pose_twin(flat, toy_scene.robot, twin.scan_state).sh[part, 0]
    b = pose_twin(flat, toy_scene.robot, replace(twin.scan_state, theta=1.5)).sh[part, 0]
    np.testing.assert_allclose(a, b, atol=1e-5)


def test_with_object_leaves_nothing_of_the_recorded_one(toy_scene):
    static, moving = toy_scene.surfels
    twin = with_object(
        toy_scene.twin, static, moving, toy_scene.asset.joint, toy_scene.light, toy_scene.twin.T_world_object
    )
    recorded = int(np.isin(toy_scene.labels, (2, 3)).sum())
    expected = len(toy_scene.labels) - recorded + len(static.gaussians) + len(moving.gaussians)
    assert len(twin.gaussians) == expected
    chosen = twin.select(twin.moves)
    assert chosen.relit is not None
    np.testing.assert_array_equal(
        np.sort(chosen.relit.indices), np.flatnonzero(np.isin(chosen.labels, (2, 3)))
    )


def test_the_object_frame_is_found_from_points(toy_scene):
    means, labels = toy_scene.gaussians.means, toy_scene.labels
    T_true = toy_scene.twin.T_world_object
    joint = toy_scene.asset.joint.move(T_true)
    T = object_frame(means[labels == 2], joint, means[labels == 3])
    assert np.rad2deg(angle_between(T[:3, 1], T_true[:3, 1])) < 5
    np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-12)
    assert np.linalg.norm(T[:3, 3] - T_true[:3, 3]) < 0.06


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_the_front_of_a_lid_is_opposite_its_hinge(tilt: float):
    rng = np.random.default_rng(0)
    static = rng.uniform([-0.2, -0.125, 0.0], [0.2, 0.125, 0.15], (2000, 3))
    lid = rng.uniform([-0.2, -0.125, 0.19], [0.2, 0.125, 0.2], (2000, 3))
    lid += rng.normal(0, 0.001, lid.shape) + tilt * lid[:, :1] * [0.0, 0.0, 1.0]
    hinge = Joint(type="revolute", axis=(-1, 0, 0), origin=(0, 0.125, 0.19), lower=0, upper=1.5)
    T = object_frame(static, hinge, lid)
    assert np.rad2deg(angle_between(-T[:3, 1], np.array([0.0, -1.0, 0.0]))) < 1


def test_layers_are_the_picture_of_everything(toy_scene):
    twin, state = toy_scene.twin, replace(toy_scene.twin.scan_state, theta=0.9)
    everything = render_state(twin, toy_scene.robot, state, toy_scene.camera).rgb
    layer, moving = static_layer(twin, toy_scene.camera), moving_layer(twin.select(twin.moves))
    motion = moving.motion(body_poses(twin, toy_scene.robot, state)[None])
    (layered,) = layer.session.draw_many(moving.gaussians, motion)
    # Rounded to 8 bits; posing by numpy rounds a little otherwise.
    assert np.abs(layered / 255 - everything).max() < 0.502 / 255 + 2e-3
    assert np.abs(layered / 255 - everything).mean() < 0.3 / 255
    alone, _ = layer.session.picture(twin.gaussians.select(np.zeros(0, int)))
    assert np.mean(np.abs(layered.astype(int) - alone) > 12) > 0.02  # something does move
    assert np.isfinite(layer.depth).any()


def test_lit_surfaces_of_a_layer_move_as_the_posed_twin_does(toy_scene):
    static, moving = toy_scene.surfels
    twin = with_object(
        toy_scene.twin, static, moving, toy_scene.asset.joint, toy_scene.light, toy_scene.twin.T_world_object
    )
    states = [replace(twin.scan_state, theta=theta) for theta in (0.0, 0.0, 1.2)]
    Ts = np.stack([body_poses(twin, toy_scene.robot, state) for state in states])
    layer = static_layer(twin, toy_scene.camera)
    prepared = moving_layer(twin.select(twin.moves))
    frames = layer.session.draw_many(prepared.gaussians, prepared.motion(Ts))
    np.testing.assert_array_equal(frames[0], frames[1])
    assert (frames[2] != frames[1]).any()
    bodies_alone = twin.select(twin.moves)
    for frame, poses in zip(frames[1:], Ts[1:], strict=True):
        want = layer.session.draw(pose_bodies(bodies_alone, poses)).rgb
        assert np.abs(frame / 255 - want).max() < 0.502 / 255 + 2e-3


def test_a_twin_survives_storage_byte_for_byte(toy_scene, tmp_path):
    static, moving = toy_scene.surfels
    twin = with_object(
        toy_scene.twin, static, moving, toy_scene.asset.joint, toy_scene.light, toy_scene.twin.T_world_object
    )
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    save_artifact(tmp_path / "a", "twin", twin)
    again = load_artifact(tmp_path / "a", "twin", TwinModel)
    save_artifact(tmp_path / "b", "twin", again)
    for name in ("twin.json", "twin.npz"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    np.testing.assert_array_equal(again.gaussians.sh, twin.gaussians.sh)
    np.testing.assert_array_equal(again.scan_state.T_world_object, twin.scan_state.T_world_object)


def test_damaged_twins_are_refused(toy_scene, tmp_path):
    with pytest.raises(MissingFileError):
        load_artifact(tmp_path, "twin", TwinModel)
    save_artifact(tmp_path, "twin", toy_scene.twin)
    data = (tmp_path / "twin.npz").read_bytes()
    (tmp_path / "twin.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(MalformedFileError):
        load_artifact(tmp_path, "twin", TwinModel)
    (tmp_path / "twin.npz").write_bytes(data)
    text = (tmp_path / "twin.json").read_text().replace('"part"', '"lid"').replace('"object",', "")
    (tmp_path / "twin.json").write_text(text)
    with pytest.raises(MalformedFileError):
        load_artifact(tmp_path, "twin", TwinModel)
