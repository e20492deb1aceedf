from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.camera import Camera, CameraPath, look_at
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.keypoints import find_keypoints, move_keypoints
from aomgen.core.light import DirectionalLight
from aomgen.core.plan import (
    EpisodePlan,
    FittedAsset,
    LightChange,
    MaterialChange,
    Variation,
    VerifiedEpisode,
)
from aomgen.core.transforms import apply
from aomgen.core.verdict import Check, Setting, SettingOutcome, Verdict
from aomgen.episodes.record import episode_of, store_episode
from aomgen.episodes.render import ImageParams, render_episode, static_layers
from aomgen.errors import CorruptArtifactError, MalformedFileError, StorageError
from aomgen.io.episode_folder import commit_episode, list_committed, read_episode, read_images
from aomgen.io.video import encode_video, read_video
from aomgen.lighting.shadowed_twin import render_state
from aomgen.twin.binding import with_object
from aomgen.twin.twin import TwinModel, TwinState
from aomgen.twin.variation import change_appearance
from drawer_episode import no_contacts

FRAMES = 4
# A shadow of 0.6 times the sRGB color.
SHARE = np.full(3, 1 - 0.6**2.2)
ZEROS_RAD = np.array([0.0, 0.002, -0.003, 0.0, 0.001, 0.0])


@pytest.fixture(scope="module")
def twin(toy_scene) -> TwinModel:
    static, moving = toy_scene.surfels
    return with_object(
        toy_scene.twin, static, moving, toy_scene.asset.joint, toy_scene.light, toy_scene.twin.T_world_object
    )


@pytest.fixture(scope="module")
def cameras(toy_scene) -> dict[str, Camera]:
    other = toy_scene.camera.move(look_at((0.1, 0.9, 0.8), (0.6, -0.1, 0.1)))
    return {"front": toy_scene.camera.resize(80, 60), "side": other.resize(80, 60)}


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
        times_s=np.arange(FRAMES) / 10,
        joints=joints,
        gripper=grip,
        thetas=thetas,
        phases=np.ones(FRAMES, np.int64),
        Ts_world_ee=poses,
        grasp="bar",
        metrics={},
    )
    setting = Setting(name="nominal", damping=0.1, frictionloss=0.1, moving_mass=1.0)
    outcome = SettingOutcome(
        setting=setting,
        final_theta=1.2,
        peak_force_n=3.0,
        peak_reaction_n=3.0,
        hold_s=(0.1, 0.3),
        hold_thetas=(0.0, 1.2),
        checks=(Check(reason="target", figure="target_share", value=1.0, limit=0.9, least=True),),
    )
    verdict = Verdict(
        start_theta=0.0, target_theta=1.2, outcomes=(outcome,), kinematic=(), bolted=False, seed=1, index=4
    )
    return VerifiedEpisode(
        plan=plan,
        reached=plan.at(plan.times_s),
        contacts=no_contacts(),
        verdict=verdict,
    )


def commit(
    toy_scene,
    twin,
    cameras,
    folder: Path,
    episodes: list[VerifiedEpisode],
    images: ImageParams = ImageParams(),
) -> list[Path]:
    folders, robot = [], toy_scene.robot
    for index, made in enumerate(episodes):
        paths = robot.camera_paths(made.reached.joints, made.reached.gripper) if images.robot_cameras else {}
        usd = Path("../asset.usda")
        episode = episode_of(made, index, usd, robot, "open the microwave", cameras, ZEROS_RAD, paths)
        shown = change_appearance(twin, made.plan.variation.light, made.plan.variation.material)
        layers = static_layers(shown, cameras)
        points = move_keypoints(episode.keypoints, episode.joint, episode.thetas)
        drawn = render_episode(
            shown, robot, episode, layers, np.eye(4), paths=paths, points_world=points, params=images
        )
        folders.append(store_episode(folder, episode, drawn, images))
    return folders


def render_frames(*arguments, **options) -> dict[str, np.ndarray]:
    return {name: shown.images_srgb for name, shown in render_episode(*arguments, **options).items()}


def usual(toy_scene) -> list[VerifiedEpisode]:
    return [verified(toy_scene, 0.2), verified(toy_scene, 0.4)]


@pytest.fixture(scope="module")
def committed(toy_scene, twin, cameras, tmp_path_factory) -> list[Path]:
    return commit(toy_scene, twin, cameras, tmp_path_factory.mktemp("run") / "episodes", usual(toy_scene))


def test_an_episode_comes_back_as_it_was(toy_scene, committed):
    item = read_episode(committed[1])
    assert (item.episode.index, item.episode.fps, len(item.episode)) == (1, 10, FRAMES)
    np.testing.assert_array_equal(item.episode.joints, verified(toy_scene, 0.4).reached.joints)
    np.testing.assert_array_equal(item.episode.action_joints[:-1], verified(toy_scene, 0.4).plan.joints[1:])
    np.testing.assert_array_equal(item.episode.action_joints[-1], verified(toy_scene, 0.4).plan.joints[-1])
    assert item.episode.asset_usd == "../asset.usda"
    assert item.episode.simulation["joint_zeros_rad"] == ZEROS_RAD.tolist()
    assert [run["name"] for run in item.episode.simulation["settings"]] == ["nominal"]
    assert item.episode.joint_names == toy_scene.robot.joint_names
    assert item.episode.verdict["passed"]
    for path in item.videos.values():
        assert read_video(path).frames_srgb.shape == (FRAMES, 60, 80, 3)


def test_keypoints_are_visible_where_nothing_hides_them(toy_scene, twin, cameras):
    """A camera between arm and object sees the handle, one behind the object does not."""
    path = verified(toy_scene, 0.1).plan
    T, asset = path.T_world_object, toy_scene.asset
    points = move_keypoints(apply(T, find_keypoints(asset)), asset.joint.move(T), np.zeros(FRAMES))
    grasp, front = points[0, 0], -T[:3, 1]
    views = {
        name: cameras["front"].move(look_at(grasp + side * front + [0, 0, 0.1], grasp))
        for name, side in (("before", 0.3), ("behind", -1.2))
    }
    closed = replace(path, thetas=np.zeros(FRAMES))
    drawn = render_episode(twin, toy_scene.robot, closed, static_layers(twin, views), points_world=points)
    assert drawn["before"].visible[:, :3].all()
    assert not drawn["behind"].visible[:, :3].any()


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


def test_shadow_only_darkens_the_static_picture(toy_scene, twin, cameras):
    trajectory = verified(toy_scene, 0.1).plan
    layers = static_layers(twin, cameras)
    bright = render_frames(twin, toy_scene.robot, trajectory, layers)["front"].astype(int)
    dark = render_frames(twin, toy_scene.robot, trajectory, layers, np.eye(4))["front"].astype(int)
    assert (dark <= bright + 1).all()
    assert (dark < bright - 8).any()


def test_a_lamp_throws_the_shadow_of_the_whole_object_to_its_other_side(toy_scene, twin, cameras):
    """Light that a lamp sends is missing behind the body too, not only behind its door."""
    trajectory = verified(toy_scene, 0.1).plan
    T = trajectory.T_world_object
    x_side = {}
    for sign in (1.0, -1.0):
        lamp = DirectionalLight(
            directions=np.array([[0.8 * sign, 0.0, 0.6]]),
            T_world_plane=np.eye(4),
            share=np.full(3, 1 - 0.5**2.2),
        )
        lit = replace(twin, directional_light=lamp)
        above = Camera(
            fx=60, fy=60, cx=40, cy=30, width=80, height=60,
            T_world_cam=look_at((T[0, 3] + 0.01, T[1, 3], 2.2), (T[0, 3], T[1, 3], 0.0)),
        )  # fmt: skip
        layers = static_layers(lit, {"above": above})
        bright, dark = (
            render_frames(lit, toy_scene.robot, trajectory, layers, plane)["above"][0].mean(-1)
            for plane in (None, np.eye(4))
        )
        hit = above.center + above.directions() * (-above.center[2] / above.directions()[..., 2])[..., None]
        x, y = hit[..., 0] - T[0, 3], hit[..., 1] - T[1, 3]
        ratio = dark / np.maximum(bright, 1)
        for side in (1.0, -1.0):
            beside = (np.abs(y) < 0.1) & (side * x > 0.3) & (side * x < 0.4)
            x_side[sign, side] = float(ratio[beside].mean())
    assert x_side[1.0, -1.0] < x_side[1.0, 1.0] - 0.1
    assert x_side[-1.0, 1.0] < x_side[-1.0, -1.0] - 0.1


def test_all_kinds_of_images_are_stored(toy_scene, twin, cameras, tmp_path):
    wanted = ImageParams(codec="av1", depth=True, labels=True, robot_cameras=True)
    small = {"front": cameras["front"].resize(96, 72)}
    (folder,) = commit(toy_scene, twin, small, tmp_path / "episodes", usual(toy_scene)[:1], wanted)
    item = read_episode(folder)
    assert set(item.videos) == {"front", "wrist"}
    assert item.codec == "av1"
    Ts_world_ee = toy_scene.robot.ee_poses(item.episode.joints)
    # A camera on the hand stands still before it.
    Ts_ee_cam = np.linalg.inv(Ts_world_ee) @ item.episode.camera_poses["wrist"]
    np.testing.assert_allclose(Ts_ee_cam, np.tile(Ts_ee_cam[:1], (FRAMES, 1, 1)), atol=1e-9)
    assert Ts_ee_cam[0, 2, 2] > 0.9  # looks along the approach
    for name, camera in item.episode.cameras.items():
        depth, labels = (read_images(item.images[kind][name]) for kind in ("depth", "labels"))
        assert depth.shape == labels.shape == (FRAMES, camera.height, camera.width)
        assert set(np.unique(labels)) <= {0, 1, 2, 3}
    front = read_images(item.images["labels"]["front"])
    assert {1, 2, 3} <= set(np.unique(front))


def test_an_episode_in_half_the_light_is_stored_so(toy_scene, twin, cameras, committed, tmp_path):
    made = verified(toy_scene, 0.2)
    dim = replace(made.plan.variation, light=LightChange(intensity=0.5), material=MaterialChange(hue=1.0))
    made = replace(made, plan=replace(made.plan, variation=dim))
    (folder,) = commit(toy_scene, twin, cameras, tmp_path / "episodes", [made])
    shown, before = (
        read_video(read_episode(path).videos["front"]).frames_srgb for path in (folder, committed[0])
    )
    assert 0.6 < shown.mean() / before.mean() < 0.85  # 0.5 in linear light is 0.73 in sRGB
    assert read_episode(folder).episode.verdict["variation"]["light"]["intensity"] == 0.5


def test_depth_and_labels_are_what_the_twin_shows(toy_scene, twin, cameras):
    layers, trajectory = static_layers(twin, cameras), verified(toy_scene, 0.3).plan
    params = ImageParams(depth=True, labels=True)
    drawn = render_episode(twin, toy_scene.robot, trajectory, layers, params=params)["front"]
    state = TwinState(
        joints=trajectory.joints[2],
        gripper=trajectory.gripper[2],
        theta=trajectory.thetas[2],
        T_world_object=trajectory.T_world_object,
    )
    want = render_state(twin, toy_scene.robot, state, cameras["front"], with_ids=True)
    seen = want.alpha > 0.9
    assert seen.mean() > 0.2
    off = np.abs(drawn.depth_mm[2] - 1000 * want.median_depth)[seen]
    assert (off < 1).mean() > 0.99
    assert (drawn.labels[2] == np.where(want.median_depth > 0, twin.labels[want.max_id], 0)).mean() > 0.99


def test_a_moving_camera_that_stands_still_sees_what_a_fixed_one_sees(toy_scene, twin, cameras):
    plane, trajectory = np.eye(4), verified(toy_scene, 0.3).plan
    camera = cameras["front"]
    path = CameraPath(camera=camera, Ts_world_cam=np.tile(camera.T_world_cam, (FRAMES, 1, 1)))
    lamp = DirectionalLight(directions=np.array([[0.0, 0.6, 0.8]]), T_world_plane=plane, share=SHARE)
    for lit in (twin, replace(twin, directional_light=lamp)):
        layers = static_layers(lit, {"front": camera})
        drawn = render_episode(lit, toy_scene.robot, trajectory, layers, plane, paths={"moving": path})
        error = np.abs(drawn["moving"].images_srgb.astype(float) - drawn["front"].images_srgb).mean()
        bare = render_episode(twin, toy_scene.robot, trajectory, layers, paths={"moving": path})
        shadow = np.abs(bare["front"].images_srgb.astype(float) - drawn["front"].images_srgb).mean()
        # Shadows end with a pixel, not with a share of one.
        assert error < 0.2 * shadow
        assert np.abs(bare["moving"].images_srgb.astype(int) - bare["front"].images_srgb).max() <= 1


def test_what_stands_still_changes_no_picture(toy_scene, twin, cameras):
    """Against the posed twin, all of it drawn anew for each frame."""
    trajectory = verified(toy_scene, 0.3).plan
    drawn = render_frames(twin, toy_scene.robot, trajectory, static_layers(twin, cameras))
    alone = render_frames(twin, toy_scene.robot, trajectory, static_layers(twin, cameras), threads=1)
    for name, camera in cameras.items():
        np.testing.assert_array_equal(drawn[name], alone[name])
        for index in range(FRAMES):
            state = TwinState(
                joints=trajectory.joints[index],
                gripper=trajectory.gripper[index],
                theta=trajectory.thetas[index],
                T_world_object=trajectory.T_world_object,
            )
            want = 255 * render_state(twin, toy_scene.robot, state, camera).rgb
            assert np.abs(drawn[name][index] - want).max() <= 1


def test_nothing_is_left_of_an_episode_that_cannot_be_written(toy_scene, committed, tmp_path):
    episode = read_episode(committed[0]).episode
    with pytest.raises(ValueError, match="do not match"):
        commit_episode(tmp_path, episode, {"front": b"x"})
    videos = {name: path.read_bytes() for name, path in read_episode(committed[0]).videos.items()}
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError):
        commit_episode(tmp_path / "file", episode, videos)
    for wrong in (b"x", encode_video(np.zeros((FRAMES - 1, 60, 80, 3), np.uint8), 10), videos["side"][:-400]):
        with pytest.raises(CorruptArtifactError, match=r"side\.mp4"):
            commit_episode(tmp_path, episode, videos | {"side": wrong})
    with pytest.raises(ValueError, match="depth of front"):
        commit_episode(
            tmp_path, episode, videos, {"depth": dict.fromkeys(videos, np.zeros((1, 2, 3), np.uint16))}
        )
    assert list_committed(tmp_path) == []


def test_damage_is_noticed(toy_scene, twin, cameras, tmp_path):
    (folder,) = commit(toy_scene, twin, cameras, tmp_path / "episodes", usual(toy_scene)[:1])
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
        directions=direction[None] / np.linalg.norm(direction), T_world_plane=np.eye(4), share=SHARE
    )
    plain, lit = toy_scene.twin, replace(toy_scene.twin, directional_light=lamp)
    rest = plain.scan_state
    states = [replace(rest, joints=rest.joints + share) for share in (0.0, 0.2)]
    trajectory = SceneTrajectory(
        times_s=[0.0, 0.1],
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
