"""The bench of trained policies counts rightly, and makes what is missing once."""

import json
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pyarrow import table
from pyarrow.parquet import write_table

from aomgen.core.camera import Camera
from aomgen.core.project import Project
from aomgen.episodes.parameters import GenerationParams
from aomgen.errors import BackendError, ConfigError, NotEnoughEpisodesError
from aomgen.evaluation.known_objects import FIRST_SEED, KNOWN
from aomgen.evaluation.lerobot_policy import WEIGHTS
from aomgen.evaluation.suite import Suite
from aomgen.exports.image_dataset import ImageSetRequest
from aomgen.io.artifact import load_artifact
from aomgen.io.schema import override
from aomgen.pipeline.runner import LOCK_FILE
from benchmarks import policy_data, policy_finder, policy_training, policy_video
from benchmarks.policy import PolicyBench, beats, folder_digest, table_figures
from benchmarks.policy_data import (
    MANY,
    NEIGHBORS,
    UNSEEN,
    WITH_NEIGHBOR,
    WORLDS,
    PolicyData,
    Trials,
    moved_cameras,
)
from benchmarks.policy_finder import LEARNED, OTHERS, TESTED, measure_finder, train_finder
from benchmarks.policy_tables import FILMED, FINDERS, QUICK, TABLES, VIDEO, Row, Training, chosen_tables
from benchmarks.policy_training import ASSET, Trainer, first_draws, front_features, list_cameras
from benchmarks.policy_video import mean_trajectory_error, video_error

FROM_EVALUATION = ("suite", "dataset", "versions", "redrawn", "nearest_mm", "nearest_deg", "failures")


def tried(successes: list[bool]) -> dict[str, Any]:
    rollouts = [{"fail_reason": "" if success else "target"} for success in successes]
    return {
        "trials": len(successes),
        "successes": sum(successes),
        "success_rate": sum(successes) / len(successes),
        "rollouts": rollouts,
        "touched_obstacle": 1,
        **dict.fromkeys(FROM_EVALUATION),
    }


def test_more_successes_in_the_same_trials_must_not_be_chance() -> None:
    none, all_of_them = tried([False] * 10), tried([True] * 10)
    assert beats(all_of_them, none)
    assert not beats(none, all_of_them)
    # Five to none: two-sided p is 0.0625.
    assert not beats(tried([True] * 5 + [False] * 5), none)
    assert beats(tried([True] * 6 + [False] * 4), none)
    # Trials that both do count nothing, however many they are.
    assert not beats(tried([True] * 100 + [True] * 3), tried([True] * 100 + [False] * 3))
    assert not beats(all_of_them, all_of_them)


def test_seeds_are_counted_together_and_others_only_in_the_same_trials() -> None:
    here, there = Trials(world="microwave"), Trials(world="microwave", scale=0.6)
    policies = (Training(world="microwave", seed=3), Training(world="microwave", seed=4))
    rows = [
        (
            Row(label={"name": "learned"}, policies=policies, test=here),
            [tried([True] * 10), tried([False] * 10)],
        ),
        (Row(label={"name": "floor"}, policies=("nearest_replay",), test=here), [tried([False] * 10)]),
        (Row(label={"name": "elsewhere"}, policies=("nearest_replay",), test=there), [tried([False] * 10)]),
    ]
    learned, floor, _ = table_figures(iter(rows))
    assert (learned["name"], learned["trials"], learned["success_rate"]) == ("learned", 20, 0.5)
    assert (learned["seeds"], learned["by_seed"]) == ([3, 4], [1.0, 0.0])
    assert learned["beats"] == [{"name": "floor"}]
    assert (learned["touched_obstacle"], floor["touched_obstacle"]) == (2, 1)
    assert (floor["seeds"], floor["beats"]) == ([], [])
    assert learned["interval_95"][0] < 0.5 < learned["interval_95"][1]


def test_tables_are_chosen_by_the_beginning_of_their_names() -> None:
    assert chosen_tables(["curve"]) == ["curve.microwave", "curve.drawer"]
    assert (
        set(chosen_tables([]))
        == TABLES.keys() - {QUICK, "gpu.act", "gpu.diffusion"} | {VIDEO} | FINDERS.keys()
    )
    assert chosen_tables(["gpu"]) == ["gpu.act", "gpu.diffusion"]
    with pytest.raises(ConfigError, match=r"'curv\.x' is unknown"):
        chosen_tables(["curv.x"])


def test_worlds_ask_for_what_a_project_understands() -> None:
    for world in WORLDS.values():
        found = override(GenerationParams(), dict(world.episodes), "episodes")
        assert (found != GenerationParams()) == bool(world.episodes)


def test_who_learned_with_a_hand_camera_is_tried_with_one() -> None:
    for world in (WORLDS[name] for name in ("microwaves", *UNSEEN.values())):
        assert override(GenerationParams(), dict(world.episodes), "episodes").images.robot_cameras


def test_every_cell_has_its_worlds() -> None:
    for rows in TABLES.values():
        for row in rows:
            assert row.test.world in WORLDS
            for policy in row.policies:
                assert isinstance(policy, str) or WORLDS[policy.world].demonstrations > 0
                assert isinstance(policy, str) or policy.demonstrations <= WORLDS[policy.world].demonstrations
    for category, unseen in UNSEEN.items():
        known = {f"{category}:{FIRST_SEED + number}" for number in range(KNOWN)}
        learned = {*WORLDS[category].assets, *known}
        assert not learned & set(WORLDS[unseen].assets)
        assert {name.partition(":")[0] for name in (*learned, *WORLDS[unseen].assets)} == {category}


def test_objects_of_the_user_are_opened_but_not_learned_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    categories = {"mine.usda": "microwave", "chest.usda": "drawer"}
    monkeypatch.setattr(policy_data, "open_asset", lambda spec: SimpleNamespace(category=categories[spec]))
    made: dict[str, tuple[str, ...]] = {}

    def run_project(project: Project, until: str, **_: Any) -> None:
        assert until == "replacement", "policies are tested on these objects, without demonstrations"
        project.out.mkdir(parents=True, exist_ok=True)
        (project.out / LOCK_FILE).touch()
        made[project.out.name] = project.assets

    data = PolicyData(
        folder=tmp_path,
        capture=tmp_path,
        run_project=run_project,
        workers=1,
        notify=lambda _: None,
        assets=tuple(categories),
    )
    unseen = UNSEEN["microwave"]
    data.run(unseen)
    assert made == {"microwave": ("microwave:1",), unseen: (*WORLDS[unseen].assets, "mine.usda")}
    # Both may be worked on at the same time.
    locks = [tmp_path / "runs" / name / LOCK_FILE for name in made]
    assert len({lock.stat().st_ino for lock in locks}) == 2


def test_a_neighbor_is_added_to_a_run_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    added = list[tuple[str, str]]()

    def run_project(project: Project, **_: Any) -> None:
        project.out.mkdir(parents=True, exist_ok=True)
        (project.out / "scene").write_text("empty")

    def add(run: Path, spec: str) -> None:
        added.append(((run / "scene").read_text(), spec))
        (run / "scene").write_text("full")

    monkeypatch.setattr(policy_data, "add_neighbor", add)
    data = PolicyData(
        folder=tmp_path, capture=tmp_path, run_project=run_project, workers=1, notify=lambda _: None
    )
    homes = {data.run(WITH_NEIGHBOR["microwave"]) for _ in range(2)}
    assert added == [("empty", NEIGHBORS["microwave"])]
    assert (homes.pop() / "scene").read_text() == "full"
    assert (data.run("microwave") / "scene").read_text() == "empty"


def test_cameras_move_by_the_asked_way_the_same_way_for_all_lengths() -> None:
    cameras = {
        name: Camera(width=4, height=4, fx=1.0, fy=1.0, cx=2.0, cy=2.0, T_world_cam=np.eye(4))
        for name in ("front", "side")
    }
    near, far = moved_cameras(cameras, 0.05), moved_cameras(cameras, 0.10)
    for name, camera in cameras.items():
        ways = [m[name].T_world_cam[:3, 3] - camera.T_world_cam[:3, 3] for m in (near, far)]
        assert np.linalg.norm(ways[0]) == pytest.approx(0.05)
        np.testing.assert_allclose(2 * ways[0], ways[1])
        np.testing.assert_array_equal(near[name].T_world_cam[:3, :3], np.eye(3))
    assert not np.allclose(near["front"].T_world_cam, near["side"].T_world_cam)


def test_without_lerobot_nothing_is_begun(tmp_path: Path) -> None:
    data: Any = SimpleNamespace(folder=tmp_path)
    bench = PolicyBench(data=data, trainer=Trainer(data=data, command=tmp_path / "absent"))
    with pytest.raises(BackendError, match="make policy-env"):
        bench.figures(chosen_tables([QUICK]))
    assert list(tmp_path.iterdir()) == []


def test_without_the_plugin_no_finder_is_begun(tmp_path: Path) -> None:
    if find_spec("lerobot_policy_aomgen") is not None:
        pytest.skip("the plug-in is installed")
    data: Any = SimpleNamespace(folder=tmp_path)
    with pytest.raises(BackendError, match="make policy-env"):
        measure_finder(data, "drawer")
    assert list(tmp_path.iterdir()) == []


def test_a_finder_is_tested_on_objects_that_no_policy_is_trained_or_tested_on() -> None:
    seeds = [set(LEARNED), set(OTHERS), set(TESTED) - set(LEARNED)]
    policies = {name for world in WORLDS.values() for name in world.assets}
    assert not seeds[0] & seeds[1]
    assert not seeds[2]
    assert not policies & {f"{category}:{seed}" for category in UNSEEN for seed in (*LEARNED, *OTHERS)}


def test_policies_do_not_share_a_folder() -> None:
    policies = {
        p for rows in TABLES.values() for row in rows for p in row.policies if isinstance(p, Training)
    }
    policies |= set(FILMED.values())
    assert len({policy.name for policy in policies}) == len(policies)


def write_episodes(dataset: Path, *assets: str) -> None:
    """What a dataset for LeRobot tells of its demonstrations' objects."""
    path = dataset / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    write_table(table({ASSET: list(assets)}), path)


def test_few_demonstrations_are_of_as_many_objects_as_there_are(tmp_path: Path) -> None:
    write_episodes(tmp_path / "one", *"aaaaa")
    assert first_draws(tmp_path / "one", 3) == [0, 1, 2]
    write_episodes(tmp_path / "several", *"aaabbccc")
    assert first_draws(tmp_path / "several", 2) == [0, 3]
    assert first_draws(tmp_path / "several", 5) == [0, 1, 3, 4, 5]
    assert first_draws(tmp_path / "several", 8) == list(range(8))
    with pytest.raises(NotEnoughEpisodesError, match="several: has 8 episodes, want 9"):
        first_draws(tmp_path / "several", 9)


# Stands in for LeRobot: writes down what it was told, and leaves a checkpoint of the last step.
LEROBOT = """#!/bin/sh
printf '%s\\n' "$@" >>"$WORDS"
for word in "$@"; do case "$word" in --output_dir=*) home="${word#*=}";; --steps=*) steps="${word#*=}";; esac; done
[ -n "$home" ] || exit 3
mkdir -p "$home/checkpoints/$(printf %06d $steps)/pretrained_model"
ln -sfn "$(printf %06d $steps)" "$home/checkpoints/last"
touch "$home/checkpoints/last/pretrained_model/model.safetensors" "$home/checkpoints/last/pretrained_model/train_config.json"
"""


@pytest.fixture
def lerobot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The stand-in, and the file to which it writes its arguments."""
    command, words = tmp_path / "lerobot-train", tmp_path / "words"
    command.write_text(LEROBOT)
    command.chmod(0o755)
    monkeypatch.setenv("WORDS", str(words))
    return command, words


def test_a_training_is_done_once_and_goes_on_where_it_ended(
    tmp_path: Path, lerobot: tuple[Path, Path]
) -> None:
    command, words = lerobot
    data: Any = SimpleNamespace(
        folder=tmp_path, dataset=lambda world, sees: tmp_path / "dataset", notify=lambda text: None
    )
    write_episodes(tmp_path / "dataset", *"aaaa")
    policy = Training(world="microwave", demonstrations=3, kind="act", seed=5)
    Trainer(data=data, steps=20, command=command).train(policy)
    told = words.read_text().splitlines()
    assert {"--steps=20", "--seed=5", "--policy.type=act", "--dataset.episodes=[0, 1, 2]"} <= set(told)
    Trainer(data=data, steps=20, command=command).train(policy)
    assert words.read_text().splitlines() == told
    # More steps than there are: LeRobot is told to continue, which the stand-in, without a folder, refuses.
    with pytest.raises(BackendError, match="exit code 3"):
        Trainer(data=data, steps=30, command=command).train(policy)
    assert words.read_text().splitlines()[len(told) + 1 :] == ["--resume=true", "--steps=30"]


def test_a_policy_with_a_finder_is_trained_with_finder_and_suite(
    tmp_path: Path, lerobot: tuple[Path, Path]
) -> None:
    command, words = lerobot
    finder = tmp_path / "finders" / "microwave" / "finder.safetensors"
    finder.parent.mkdir(parents=True)
    finder.touch()
    data: Any = SimpleNamespace(
        folder=tmp_path,
        dataset=lambda world, sees: tmp_path / sees,
        finder_suite=lambda test, actions: tmp_path / f"{test.name}-{actions}.json",
        notify=lambda text: None,
    )
    write_episodes(tmp_path / "keypoints", *"abc")
    policy = Training(world="microwaves", demonstrations=3, sees="keypoints", kind="handle_act")
    Trainer(data=data, steps=20, command=command).train(policy)
    suite = tmp_path / "unseen_microwaves-1-0mm-ee_absolute.json"
    expected = {f"--policy.finder={finder}", f"--policy.suite={suite}", "--policy.type=handle_act"}
    assert expected <= set(words.read_text().splitlines())


@pytest.mark.parametrize("category", UNSEEN)
def test_a_policy_with_a_planner_is_created_once_from_the_run_of_its_objects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, category: str
) -> None:
    made = list[tuple[Any, ...]]()

    def create(*arguments: Any) -> None:
        _, out, *_ = arguments
        made.append(arguments)
        out.mkdir(parents=True)
        (out / WEIGHTS).touch()

    monkeypatch.setattr(
        policy_training, "import_plugin", lambda module: SimpleNamespace(create_policy=create)
    )
    monkeypatch.setattr(
        policy_training,
        "train_finder",
        lambda data, category, seed, variant: tmp_path / f"{category}{seed}{variant}",
    )
    data: Any = SimpleNamespace(
        folder=tmp_path,
        finder_suite=lambda test, actions: tmp_path / f"{test.world}-{actions}",
        run=lambda world, until: tmp_path / world / until,
    )
    trainer = Trainer(data=data, steps=20, command=tmp_path / "absent")
    policy = Training(
        world=category,
        demonstrations=0,
        sees="keypoints",
        kind="handle_plan",
        others=("laptop",),
        seed=2,
        variant="one_look",
    )
    homes = {trainer.train(policy) for _ in range(2)}
    suite = tmp_path / f"{UNSEEN[category]}-joint"
    runs = [tmp_path / world / "replacement" for world in policy.worlds]
    finders = [tmp_path / f"{name}2one_look" for name in (category, "laptop")]
    assert made == [(suite, homes.pop(), list(zip(runs, finders, strict=True)), [], policy.known)]


@dataclass(frozen=True)
class Known:
    workers: int


def test_a_finder_learns_from_images_of_its_category(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, asked = list[str](), dict[str, ImageSetRequest]()

    def export(results: Any, folder: Path, request: ImageSetRequest, progress: Any) -> None:
        asked[f"{folder.parent.name}/{folder.name}"] = request

    def train(words: list[str]) -> int:
        given.extend(words)
        return 0

    monkeypatch.setattr(policy_finder, "import_plugin", lambda module: SimpleNamespace(main=train))
    monkeypatch.setattr(policy_finder, "open_results", lambda path: Known(workers=1))
    monkeypatch.setattr(policy_finder, "export_images", export)
    data: Any = SimpleNamespace(
        folder=tmp_path, workers=1, run=lambda world, until: tmp_path, notify=lambda text: None
    )
    train_finder(data, "drawer")
    images = tmp_path / "images" / "drawer"
    assert given[:4] == [
        str(images / "learned"), str(tmp_path / "finders" / "drawer"), "--validation", str(images / "objects"),
    ]  # fmt: skip
    assert given[-4:] == ["--seed=0", "--crop", "96", "40"]
    assert {name: len(request.assets) for name, request in asked.items()} == {
        "drawer/learned": 300,
        "drawer/objects": 30,
    }
    assert train_finder(data, "drawer", 1, "one_look").parent == tmp_path / "finders" / "drawer-1-one_look"
    assert given[-2:] == ["--seed=1", "--crop"]


def test_a_policy_without_wrist_camera_uses_the_fixed_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    suite = SimpleNamespace(cameras=dict.fromkeys(("front", "side", "wrist")))
    robot = SimpleNamespace(cameras={"wrist": None})
    monkeypatch.setattr(policy_training, "open_suite", lambda path: (suite, SimpleNamespace(robot=robot)))
    rows = [row for row in TABLES["planner_table.drawer"] if not row.label["wrist_camera"]]
    (policy,) = (policy for row in rows for policy in row.policies if isinstance(policy, Training))
    assert list_cameras(policy, Path("suite.json")) == ["front", "side"]
    assert list_cameras(replace(policy, wrist_camera=True), Path("suite.json")) == []


def test_the_finder_gets_larger_images_of_the_same_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = Camera(width=96, height=96, fx=80.0, fy=90.0, cx=48.0, cy=50.0, T_world_cam=np.eye(4))
    suite = Suite(
        run=".",
        twin="",
        task="",
        assets=(),
        joint_names=(),
        fps=10,
        action_space="joint",
        cameras={"front": camera},
        drawn_size=(192, 192),
        max_frames=9,
        seed=3,
        trials=(),
        redrawn={},
        nearest=None,
    ).seal()
    test = Trials(world="microwave")
    data = PolicyData(
        folder=tmp_path, capture=tmp_path, run_project=lambda: None, workers=1, notify=lambda text: None
    )
    (tmp_path / "suites").mkdir()
    (tmp_path / "suites" / f"{test.name}.json").touch()
    monkeypatch.setattr(policy_data, "open_suite", lambda path: (suite, None))
    path = data.finder_suite(test, "ee_absolute")
    written = load_artifact(path.parent, path.stem, Suite)
    resized = written.cameras["front"]
    assert (resized.width, resized.height) == (240, 240)
    assert (resized.fx, resized.cy) == pytest.approx((200, 125))
    assert (written.action_space, written.drawn_size) == ("ee_absolute", (240, 240))
    assert (written.seed, written.max_frames) == (suite.seed, suite.max_frames)
    assert written.digest != suite.digest


def test_a_policy_of_the_fixed_camera_sees_only_that(tmp_path: Path) -> None:
    features = {
        "observation.state": {"shape": [7]},
        "observation.images.front": {"shape": [96, 80, 3]},
        "observation.images.side": {"shape": [96, 80, 3]},
    }
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"features": features}))
    assert front_features(tmp_path) == {
        "observation.state": {"type": "STATE", "shape": [7]},
        "observation.images.front": {"type": "VISUAL", "shape": [3, 96, 80]},
    }


@pytest.mark.parametrize("off_m", [0.0, 0.004])
def test_foreseen_hands_are_held_against_the_recorded_ones(
    off_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot whose hand stands where its three joints say, and a policy that knows the frame from the picture."""
    frames, ahead = 12, 3
    path = np.random.default_rng(0).normal(size=(frames, 3))
    Ts = np.tile(np.eye(4), (frames, 1, 1))
    Ts[:, :3, 3] = path
    pictures = np.broadcast_to(np.arange(frames, dtype=np.uint8)[:, None, None, None], (frames, 8, 8, 3))
    camera = Camera(width=4, height=4, fx=1.0, fy=1.0, cx=2.0, cy=2.0, T_world_cam=np.eye(4))

    def ee_poses(joints: np.ndarray) -> np.ndarray:
        found = np.tile(np.eye(4), (len(joints), 1, 1))
        found[:, :3, 3] = joints
        return found

    class Knows:
        def __init__(self, trained: Path, suite: Any) -> None:
            pass

        def chunk(self, seen: dict[str, Any]) -> np.ndarray:
            frame = int(seen["pixels"]["front"][0, 0, 0])
            assert seen["pixels"]["front"].shape == (4, 4, 3)
            np.testing.assert_allclose(seen["agent_pos"], [*path[frame], 0.5], rtol=1e-6)
            return np.pad(path[frame + 1 : frame + 1 + 2 * ahead] + [off_m, 0, 0], [(0, 0), (0, 1)])

    monkeypatch.setattr(policy_video, "LerobotPolicy", Knows)
    times = np.arange(frames) / ahead
    results: Any = SimpleNamespace(
        demo_camera="front",
        fps=float(ahead),
        robot=SimpleNamespace(ee_poses=ee_poses),
        videos={"front": SimpleNamespace(times_s=times + 0.01, frames_srgb=pictures)},
        demonstration=SimpleNamespace(
            times_s=times, joints=path, gripper=np.full(frames, 0.5), Ts_world_ee=Ts
        ),
    )
    suite: Any = SimpleNamespace(cameras={"front": camera})
    assert video_error(Path(), suite, results) == pytest.approx(1000 * off_m, abs=1e-9)


def test_the_mean_trajectory_is_of_demonstrations_that_stay_where_they_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two demonstrations go 10 mm to either side of the recorded line; the second one is over after five frames."""

    def path(frames: int, aside_m: float) -> np.ndarray:
        Ts = np.tile(np.eye(4), (frames, 1, 1))
        Ts[:, 0, 3], Ts[:, 1, 3] = np.minimum(np.arange(frames), 4) / 100, aside_m
        return Ts

    episodes = [path(12, 0.01), path(5, -0.01)]
    monkeypatch.setattr(policy_video, "list_committed", lambda folder: [0, 1])
    monkeypatch.setattr(
        policy_video,
        "read_episode",
        lambda number: SimpleNamespace(episode=SimpleNamespace(Ts_world_ee=episodes[number])),
    )
    recorded = path(10, 0.004)
    results: Any = SimpleNamespace(
        fps=3.0,
        folders={"episodes": Path()},
        demonstration=SimpleNamespace(times_s=np.arange(10) / 3, Ts_world_ee=recorded),
    )
    assert mean_trajectory_error(results) == pytest.approx(4.0)


def test_kept_rollouts_need_neither_lerobot_nor_data(tmp_path: Path) -> None:
    small = [f"{name}-0" for name in ("microwave-150", "microwaves-150", f"microwaves-{MANY}")]
    located = [f"microwaves-{MANY}-{seed}-keypoints-handle_act" for seed in range(3)]
    for name in (*small, *located, "microwave-0-0-keypoints-handle_plan"):
        figures = json.dumps(tried([True] * 5 + [False] * 5))
        kept = tmp_path / "rollouts" / f"{name}-on-unseen_microwaves-1-0mm-splat.json"
        kept.parent.mkdir(exist_ok=True)
        kept.write_text(figures)
    data: Any = SimpleNamespace(folder=tmp_path, workers=1)
    bench = PolicyBench(data=data, trainer=Trainer(data=data, command=tmp_path / "absent"))
    table = bench.figures(["unseen_table.microwave"])["unseen_table.microwave"]
    assert [row["success_rate"] for row in table] == [0.5] * 5


def test_a_dataset_is_known_by_names_and_contents(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    first = folder_digest(tmp_path)
    (tmp_path / "a").rename(tmp_path / "b")
    assert folder_digest(tmp_path) != first
    (tmp_path / "b").rename(tmp_path / "a")
    assert folder_digest(tmp_path) == first
    (tmp_path / "a").write_text("2")
    assert folder_digest(tmp_path) != first
