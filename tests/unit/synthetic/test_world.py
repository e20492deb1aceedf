"""Synthetic captures: complete, deterministic, opened by contact alone, truthful."""

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from aomgen.assets.choice import MAKERS, make_asset
from aomgen.capture.read import read_capture
from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.errors import ConfigError
from aomgen.io.artifact import load_artifact, read_json
from aomgen.io.images import read_labels
from aomgen.io.video import read_video
from aomgen.robots.robot import RobotModel
from benchmarks.truth import read_truth
from synthetic.demonstration_search import Performance, find_demonstration, simulate
from synthetic.grasp_selection import draw_usual_style
from synthetic.layout import build_world, draw_layout
from synthetic.room import add_room
from synthetic.scene_recording import Conditions
from synthetic.style import draw_style
from synthetic.tabletop_objects import SIZES
from synthetic.world import find_moved_range, make_capture, make_prompt

SIZE = (128, 96)
VIEWS = 12
CONDITIONS = Conditions(size=SIZE, scan_views=VIEWS, fps=3)


@pytest.fixture(scope="module", params=sorted(MAKERS))
def performance(robot: RobotModel, request: pytest.FixtureRequest) -> Performance:
    return find_demonstration(robot, make_asset(request.param, 2), np.random.default_rng(2))


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic") / "drawer"
    make_capture(folder, category="drawer", seed=4, conditions=CONDITIONS)
    return folder


def test_object_moves_only_while_the_fingers_hold_it(performance: Performance) -> None:
    shown = performance.demonstration
    start, goal = performance.script.theta_start, performance.style.goal
    touched = np.array([len(touches) > 0 for touches in shown.contacts])
    first = int(np.argmax(touched))
    assert 1000 < first < 3000
    assert np.abs(shown.theta[:first] - start).max() < 1e-3 * goal
    assert shown.theta[-1] == pytest.approx(goal, rel=0.1)
    held = {c.finger for step in range(2500, 3800) for c in shown.contacts[step] if c.force > 1.0}
    assert {"left", "right"} <= held
    steps = np.diff(shown.theta, prepend=start)
    assert steps[touched].sum() > 0.85 * (goal - start)
    assert not shown.foreign
    assert not shown.diverged


def test_contact_normals_point_into_the_part(performance: Performance) -> None:
    """Left and right fingers press from opposite sides of the bar."""
    shown, layout = performance.demonstration, performance.layout
    middle = shown.contacts[2700]
    normals = {side: np.mean([c.normal for c in middle if c.finger == side], 0) for side in ("left", "right")}
    assert normals["left"] @ normals["right"] < -0.5
    T_world_moving = layout.joint_world.motion(shown.theta[2700]) @ layout.T_world_object
    handle = apply(T_world_moving, layout.asset.handle_point)
    for contact in middle:
        assert np.linalg.norm(contact.point - handle) < 0.03
        assert (handle - contact.point) @ contact.normal > 0


def test_without_a_grasp_nothing_opens(robot: RobotModel, performance: Performance) -> None:
    world = build_world(robot, performance.layout, visual=False)
    open_hand = replace(performance.script, gripper=np.zeros_like(performance.script.gripper))
    no_handle = world.names.handle_geoms
    for name in no_handle:
        world.model.geom(name).contype = 0
        world.model.geom(name).conaffinity = 0
    shown = simulate(world, open_hand)
    start, goal = performance.script.theta_start, performance.style.goal
    assert abs(shown.theta[-1] - start) < 0.05 * goal


def test_the_part_stays_where_it_is_left(performance: Performance) -> None:
    """Also a lid, whose weight pulls at it."""
    shown = performance.demonstration
    last = max(step for step, touches in enumerate(shown.contacts) if touches)
    assert last < len(shown.theta) - 300
    limit = {"revolute": np.deg2rad(0.2), "prismatic": 0.001}[performance.layout.asset.joint.type]
    assert np.ptp(shown.theta[last:]) < limit


def test_arm_follows_its_script_closely(performance: Performance) -> None:
    error = np.abs(performance.demonstration.joints - performance.script.joints).max()
    assert error < 0.02


def test_capture_is_complete(capture: Path) -> None:
    recording = read_capture(capture)
    assert recording is not None
    manifest = tomllib.loads((capture / "capture.toml").read_text())
    assert manifest["category"] == "drawer"
    assert {prompt["part"] for prompt in manifest["prompts"]} == {"robot", "static", "moving"}
    video = read_video(capture / "demo" / "front.mp4")
    assert video.frames_srgb.shape[1:] == (SIZE[1], SIZE[0], 3)
    assert len(list((capture / "scan").glob("*.jpg"))) == VIEWS
    assert len(list((capture / "truth" / "masks" / "scan").glob("*.png"))) == VIEWS
    assert len(list((capture / "truth" / "masks" / "front").glob("*.png"))) == len(video.times_s)
    log = np.genfromtxt(capture / "demo" / "joints.csv", delimiter=",", names=True)
    offset = read_json(capture / "truth" / "truth.json")["clock_offset_s"]
    assert log["time_s"][0] < offset
    assert log["time_s"][-1] > video.times_s[-1] + offset


def test_same_seed_same_files(capture: Path, tmp_path: Path) -> None:
    make_capture(tmp_path / "again", category="drawer", seed=4, conditions=CONDITIONS)
    files = sorted(p.relative_to(capture) for p in capture.rglob("*") if p.is_file())
    again = sorted(p.relative_to(tmp_path / "again") for p in (tmp_path / "again").rglob("*") if p.is_file())
    assert files == again
    for name in files:
        if name.suffix != ".npz":
            assert (capture / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_moving_part_follows_joint_and_theta(capture: Path) -> None:
    known = read_truth(capture)
    data = read_json(capture / "truth" / "truth.json")
    poses = np.array(data["Ts_world_moving"])
    T_world_object = np.array(data["object"]["T_world_object"])
    expected = known.joint.motion(known.theta["front"]) @ T_world_object
    assert poses == pytest.approx(expected, abs=1e-9)
    assert known.joint.type == "prismatic"
    assert known.theta["front"][-1] > 0.1
    assert 0 < known.start_frame < known.end_frame < len(poses)


def test_log_holds_the_true_joints_at_the_stated_offset(capture: Path) -> None:
    known = read_truth(capture)
    log = np.genfromtxt(capture / "demo" / "joints.csv", delimiter=",")[1:]
    times = read_video(capture / "demo" / "front.mp4").times_s + known.clock_offset_s
    for column in range(6):
        logged = np.interp(times, log[:, 0], log[:, 1 + column])
        assert np.abs(logged - known.qpos[:, column]).max() < 0.004


def _visible_share(asset: ArticulatedAsset, T: Array, camera: Camera, labels: Array, label: int) -> float:
    """Share of the projected outer box corners' hull middle that carries the label."""
    link = asset.moving if label == MOVING else asset.static
    mesh = link.meshes[0]
    centroids = apply(T, mesh.vertices[mesh.faces].mean(1))
    pixels, depths = camera.project(centroids)
    inside = (depths > 0) & (pixels >= 1).all(1) & (pixels < np.array(SIZE) - 1).all(1)
    if not inside.any():
        return np.nan
    columns, rows = pixels[inside].astype(int).T
    return float(np.mean(np.isin(labels[rows, columns], [label, ROBOT, MOVING, STATIC])))


def test_known_points_project_onto_their_masks(capture: Path) -> None:
    known = read_truth(capture)
    data = read_json(capture / "truth" / "truth.json")
    asset = load_artifact(capture / "truth", "asset", ArticulatedAsset)
    fx, fy, cx, cy = data["intrinsics"]["scan"]

    def camera(T_world_cam: Array) -> Camera:
        return Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=SIZE[0], height=SIZE[1], T_world_cam=T_world_cam)

    shares = []
    for name, T_world_cam in known.scan.items():
        labels = read_labels(capture / "truth" / "masks" / "scan" / name.replace("jpg", "png"))
        T = np.array(data["object"]["T_world_object"])
        shares.append(_visible_share(asset, T, camera(T_world_cam), labels, MOVING))
    front = camera(known.demo_cameras["front"])
    for frame in (known.start_frame, known.end_frame):
        labels = read_labels(capture / "truth" / "masks" / "front" / f"{frame:04d}.png")
        shares.append(_visible_share(asset, np.array(data["Ts_world_moving"])[frame], front, labels, MOVING))
    assert np.nanmean(shares) > 0.9


def test_end_effector_projects_onto_the_robot(capture: Path, robot: RobotModel) -> None:
    known = read_truth(capture)
    fx, fy, cx, cy = read_json(capture / "truth" / "truth.json")["intrinsics"]["front"]
    T_world_cam = known.demo_cameras["front"]
    camera = Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=SIZE[0], height=SIZE[1], T_world_cam=T_world_cam)
    wrist = robot.body_names.index("gripper_base")
    hits = []
    for frame, (joints, grip) in enumerate(zip(known.qpos, known.gripper, strict=True)):
        centre = robot.link_poses(joints[None], np.array([grip]))[0, wrist]
        pixel, _ = camera.project(apply(centre, np.array([[0.0, 0.0, 0.05]])))
        column, row = pixel[0].astype(int)
        if 0 <= column < SIZE[0] and 0 <= row < SIZE[1]:
            labels = read_labels(capture / "truth" / "masks" / "front" / f"{frame:04d}.png")
            hits.append(labels[row, column] == ROBOT)
    assert len(hits) > 10
    assert np.mean(hits) > 0.7


def test_prompts_lie_on_their_parts(capture: Path) -> None:
    manifest = tomllib.loads((capture / "capture.toml").read_text())
    value = {"robot": ROBOT, "static": STATIC, "moving": MOVING}
    for prompt in manifest["prompts"]:
        labels = read_labels(capture / "truth" / "masks" / "scan" / prompt["image"].replace("jpg", "png"))
        column, row, _ = prompt["points"][0]
        assert labels[int(row), int(column)] == value[prompt["part"]]
        x0, y0, x1, y1 = prompt["box"]
        assert x0 <= column <= x1
        assert y0 <= row <= y1


def test_prompt_of_a_ring_is_on_the_ring() -> None:
    v, u = np.mgrid[:40, :60]
    radius = np.hypot(v - 20, u - 30)
    mask = (radius < 15) & (radius > 9)
    (column, row), bounds = make_prompt(mask)
    assert mask[int(row), int(column)]
    assert bounds == [16.0, 6.0, 45.0, 35.0]


def test_moved_range_names_the_moving_frames(performance: Performance) -> None:
    joint = performance.layout.asset.joint
    scale = 1.0 if joint.type == "revolute" else 0.1
    theta = scale * np.array([0, 0, 0.001, 0.3, 0.7, 0.999, 1.0, 1.0])
    assert find_moved_range(theta, joint) == (3, 4)


def test_unknown_category_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="toaster"):
        make_capture(tmp_path / "x", category="toaster", seed=0)
    assert not (tmp_path / "x").exists()


def test_laptops_are_found_closed_or_ajar(made: Callable[[str, int], ArticulatedAsset]) -> None:
    rng = np.random.default_rng(0)
    starts = np.rad2deg([draw_usual_style(made("laptop", 0), rng)[0].start for _ in range(40)])
    ajar = starts[starts > 0]
    assert 0.3 < len(ajar) / len(starts) < 0.9
    assert 3 <= ajar.min() <= ajar.max() <= 12
    assert {draw_usual_style(made("dresser", 0), rng)[0].start for _ in range(10)} == {0.0}


@pytest.mark.slow
def test_objects_beside_a_laptop_collide_and_hide_none_of_it(
    made: Callable[[str, int], ArticulatedAsset],
) -> None:
    kinds = set()
    for seed in range(4):
        layout = draw_layout(made("laptop", seed), np.random.default_rng(seed))
        rooms = []
        for visual in (False, True):
            spec = mujoco.MjSpec()
            add_room(spec, layout.room, np.random.default_rng(layout.room_seed), visual=visual)
            rooms.append([geom for geom in spec.geoms if geom.name.rstrip("0123456789_") in SIZES])
        solids, shown = rooms
        assert [geom.name for geom in solids] == [geom.name for geom in shown]
        kinds |= {geom.name.rstrip("0123456789_") for geom in solids}
        x0, x1, y0, y1 = layout.room.keep_free
        for geom in solids:
            (x, y, _), (a, b, _) = geom.pos, geom.size
            assert x + a < x0 or x - a > x1 or y + b < y0 or y - b > y1
    assert kinds == {"mug", "mouse", "adapter", "book"}
    dresser = draw_layout(made("dresser", 0), np.random.default_rng(0))
    assert not dresser.room.desk


def test_a_capture_of_a_drawer_shows_a_dresser(capture: Path) -> None:
    stated = tomllib.loads((capture / "capture.toml").read_text("utf-8"))
    assert stated["category"] == "drawer"
    asset = load_artifact(capture / "truth", "asset", ArticulatedAsset)
    assert sum(box.name.endswith("handle_bar") for box in asset.static.colliders) >= 1


def test_a_lid_is_closed_by_its_rim(robot: RobotModel) -> None:
    asset, rng = make_asset("laptop", 6000), np.random.default_rng(6000)
    style = draw_style(asset, rng, direction="closing")
    shown = find_demonstration(robot, asset, rng, style)
    assert shown.theta[-1] == pytest.approx(style.travel, rel=0.1)
