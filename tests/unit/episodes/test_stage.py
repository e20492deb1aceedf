from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.episode import no_contacts
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation, VerifiedEpisode
from aomgen.core.verdict import Check, Hold, Setting, SettingOutcome, Verdict
from aomgen.episodes.render import Trajectory, render_frames, static_layers
from aomgen.episodes.stage import run_episodes
from aomgen.errors import CorruptArtifactError, MalformedFileError, StorageError
from aomgen.io.atomic import STAGING_PREFIX
from aomgen.io.episode_folder import commit_episode, list_committed, read_episode
from aomgen.io.video import read_video
from aomgen.twin.binding import with_object
from aomgen.twin.shadow import DirectionalLight
from aomgen.twin.twin import Twin, TwinState, render_state

FRAMES = 4
ZEROS_RAD = np.array([0.0, 0.002, -0.003, 0.0, 0.001, 0.0])


@pytest.fixture(scope="module")
def twin(toy_scene) -> Twin:
    static, moving = toy_scene.surfels
    return with_object(
        toy_scene.twin, static, moving, toy_scene.asset.joint, toy_scene.light, toy_scene.twin.T_world_object
    )


@pytest.fixture(scope="module")
def cameras(toy_scene) -> dict[str, Camera]:
    other = toy_scene.camera.moved(look_at((0.1, 0.9, 0.8), (0.6, -0.1, 0.1)))
    return {"front": toy_scene.camera.resized(80, 60), "side": other.resized(80, 60)}


def verified(toy_scene, turn: float) -> VerifiedEpisode:
    joints = toy_scene.twin.scan_state.joints + np.linspace(0, turn, FRAMES)[:, None]
    poses, grip, thetas = (
        toy_scene.robot.ee_poses(joints),
        np.linspace(0, 1, FRAMES),
        np.linspace(0, 1.2, FRAMES),
    )
    fitted = FittedAsset(
        asset=toy_scene.asset,
        T_world_asset=toy_scene.twin.T_world_object,
        contact_asset=toy_scene.asset.handle_point,
        shares=[0.0, 1.0],
        thetas=[0.0, 1.2],
        scale=1.0,
        mirrored=False,
        mode="object",
        residual_mm=0.0,
    )
    plan = EpisodePlan(
        variation=Variation(seed=1, index=4, x=0, y=0, yaw=0),
        fitted=fitted,
        T_world_object=toy_scene.twin.T_world_object,
        fps=10.0,
        joints=joints,
        gripper=grip,
        thetas=thetas,
        phases=np.ones(FRAMES, np.int64),
        Ts_world_ee=poses,
        grasp="bar",
        metrics={},
    )
    outcome = SettingOutcome(
        setting=Setting(name="nominal", damping=0.1, frictionloss=0.1, moving_mass=1.0),
        final_theta=1.2,
        peak_force_n=3.0,
        peak_reaction_n=3.0,
        hold=Hold(first_s=0.1, last_s=0.3, first_theta=0.0, last_theta=1.2),
        checks=(Check(reason="target", figure="target_share", value=1.0, limit=0.9, least=True),),
    )
    verdict = Verdict(target_theta=1.2, outcomes=(outcome,), kinematic=(), bolted=False, seed=1, index=4)
    return VerifiedEpisode(
        plan=plan,
        joints=joints,
        gripper=grip,
        thetas=thetas,
        Ts_world_ee=poses,
        contacts=no_contacts(),
        verdict=verdict,
    )


def run(toy_scene, twin, cameras, folder: Path, count: int = 2, workers: int = 2) -> list[Path]:
    episodes = [verified(toy_scene, 0.2 * (k + 1)) for k in range(count)]
    return run_episodes(
        episodes,
        {toy_scene.asset.name: twin},
        {toy_scene.asset.name: folder / "asset.usda"},
        toy_scene.robot,
        cameras,
        folder,
        instruction="open the microwave",
        joint_zeros_rad=ZEROS_RAD,
        T_world_plane=np.eye(4),
        workers=workers,
    )


@pytest.fixture(scope="module")
def committed(toy_scene, twin, cameras, tmp_path_factory) -> list[Path]:
    return run(toy_scene, twin, cameras, tmp_path_factory.mktemp("run") / "episodes")


def test_an_episode_comes_back_as_it_was(toy_scene, committed):
    item = read_episode(committed[1])
    assert (item.episode.index, item.episode.fps, len(item.episode)) == (1, 10, FRAMES)
    np.testing.assert_array_equal(item.episode.joints, verified(toy_scene, 0.4).joints)
    np.testing.assert_array_equal(item.episode.action_joints[:-1], verified(toy_scene, 0.4).plan.joints[1:])
    np.testing.assert_array_equal(item.episode.action_joints[-1], verified(toy_scene, 0.4).plan.joints[-1])
    assert item.episode.asset_usd == "../asset.usda"
    assert item.episode.simulation["joint_zeros_rad"] == ZEROS_RAD.tolist()
    assert [run["name"] for run in item.episode.simulation["settings"]] == ["nominal"]
    assert item.episode.joint_names == toy_scene.robot.joint_names
    assert item.episode.verdict["passed"]
    for path in item.videos.values():
        assert read_video(path).frames_srgb.shape == (FRAMES, 60, 80, 3)


def test_the_video_shows_what_the_twin_draws(toy_scene, twin, cameras, committed):
    video = read_video(read_episode(committed[1]).videos["front"])
    plan = verified(toy_scene, 0.4).plan
    last = TwinState(
        joints=plan.joints[-1], gripper=1.0, theta=plan.thetas[-1], T_world_object=plan.T_world_object
    )
    drawn = render_state(twin, toy_scene.robot, last, cameras["front"]).rgb
    error = video.frames_srgb[-1] / 255 - drawn
    assert 10 * np.log10(1 / np.mean(error**2)) > 25
    assert np.abs(video.frames_srgb[-1].astype(int) - video.frames_srgb[0]).mean() > 1


def test_same_bytes_for_any_number_of_workers(toy_scene, twin, cameras, committed, tmp_path):
    again = run(toy_scene, twin, cameras, tmp_path / "episodes", workers=1)
    for a, b in zip(committed, again, strict=True):
        names = sorted(p.name for p in a.iterdir())
        assert names == ["episode.json", "frames.npz", "front.mp4", "side.mp4"]
        for name in names:
            assert (a / name).read_bytes() == (b / name).read_bytes()


def test_a_second_run_keeps_what_is_committed(toy_scene, twin, cameras, tmp_path):
    folder = tmp_path / "episodes"
    (first,) = run(toy_scene, twin, cameras, folder, count=1)
    stamp = (first / "front.mp4").stat().st_mtime_ns
    (folder / f"{STAGING_PREFIX}left-by-a-kill").mkdir()
    run(toy_scene, twin, cameras, folder, count=2)
    assert (first / "front.mp4").stat().st_mtime_ns == stamp
    assert [p.name for p in sorted(folder.iterdir())] == ["000000", "000001"]


def test_shadow_only_darkens_the_static_picture(toy_scene, twin, cameras):
    plan = verified(toy_scene, 0.1).plan
    trajectory = Trajectory(
        joints=plan.joints, gripper=plan.gripper, thetas=plan.thetas, T_world_object=plan.T_world_object
    )
    layers = static_layers(twin, cameras)
    bright = render_frames(twin, toy_scene.robot, trajectory, layers)["front"].astype(int)
    dark = render_frames(twin, toy_scene.robot, trajectory, layers, np.eye(4))["front"].astype(int)
    assert (dark <= bright + 1).all()
    assert (dark < bright - 8).any()


def test_nothing_is_left_of_an_episode_that_cannot_be_written(toy_scene, committed, tmp_path):
    episode = read_episode(committed[0]).episode
    with pytest.raises(ValueError, match="do not match"):
        commit_episode(tmp_path, episode, {"front": b"x"})
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError):
        commit_episode(tmp_path / "file", episode, {"front": b"x", "side": b"y"})
    assert list_committed(tmp_path) == []


def test_damage_is_noticed(toy_scene, twin, cameras, tmp_path):
    (folder,) = run(toy_scene, twin, cameras, tmp_path / "episodes", count=1)
    data = bytearray((folder / "front.mp4").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "front.mp4").write_bytes(data)
    with pytest.raises(CorruptArtifactError, match=r"front\.mp4"):
        read_episode(folder)
    (folder / "front.mp4").unlink()
    with pytest.raises(CorruptArtifactError, match="missing"):
        read_episode(folder)
    (folder / "episode.json").write_text('{"format": 1}')
    with pytest.raises(MalformedFileError):
        read_episode(folder)


def test_the_arm_throws_its_shadow_in_episodes_as_in_the_twin(toy_scene):
    direction = np.array([0.2, -0.3, 1.0])
    lamp = DirectionalLight(
        direction=direction / np.linalg.norm(direction), T_world_plane=np.eye(4), shade=np.full(3, 0.6)
    )
    plain, lit = toy_scene.twin, replace(toy_scene.twin, directional_light=lamp)
    rest = plain.scan_state
    states = [replace(rest, joints=rest.joints + share) for share in (0.0, 0.2)]
    trajectory = Trajectory(
        joints=np.stack([state.joints for state in states]),
        gripper=np.zeros(2),
        thetas=np.zeros(2),
        T_world_object=rest.T_world_object,
    )
    layers = static_layers(plain, {"front": toy_scene.camera})
    drawn, without = (
        render_frames(twin, toy_scene.robot, trajectory, layers)["front"].astype(float) / 255
        for twin in (lit, plain)
    )
    for index, state in enumerate(states):
        wanted = render_state(lit, toy_scene.robot, state, toy_scene.camera).rgb
        missing = np.abs(without[index] - wanted).mean()
        assert missing > 0.002
        assert np.abs(drawn[index] - wanted).mean() < 0.3 * missing
