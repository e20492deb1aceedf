"""Many workers, one tree: nothing that was made is lost, made twice, or depends on who made it."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self
from xml.etree import ElementTree

import numpy as np
import pytest

from aomgen.assets.replay_in_isaac_sim import read_recording
from aomgen.assets.usd_write import REPLAY_SCRIPT
from aomgen.core.boxes import OrientedBox
from aomgen.core.plan import Rejection, Variation
from aomgen.core.transforms import transform
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.generate import generate
from aomgen.episodes.grasp_choice import GRASPS_FOLDER, GraspChoice
from aomgen.episodes.ledger import (
    DRAWS_FILE,
    Request,
    Unit,
    forget_files,
    list_ended_units,
    read_accounts,
    read_draws,
    read_rejection,
    write_rejection,
)
from aomgen.episodes.parameters import GenerationParams
from aomgen.episodes.stage import run
from aomgen.episodes.variations import Ranges
from aomgen.errors import ConfigError, MalformedFileError, NotEnoughEpisodesError
from aomgen.executors import Done
from aomgen.io.artifact import load_artifact
from aomgen.io.atomic import write_json
from aomgen.io.episode_folder import commit_episode, list_committed, read_episode
from aomgen.io.reuse import StoredFileWarning
from aomgen.io.video import encode_video
from aomgen.report.episodes import draws_section
from backwards import closing_of
from drawer_episode import corner_camera, drawer_episode
from toy_drawer import SUPPORT, fitted_drawer
from toy_run import toy_run

VIDEO = encode_video(np.zeros((3, 48, 64, 3), np.uint8), 10)
REQUEST = Request(assets=("a", "b"), episodes=5, attempts=12)


class Scrambled:
    """Does units in this process, in a random order, `slots` at a time, until it has done `stop_after`."""

    def __init__(
        self, work: Callable[[Unit], Any], slots: int, seed: int = 0, stop_after: int = 10**9
    ) -> None:
        self.slots, self._work, self._rng, self._left = slots, work, np.random.default_rng(seed), stop_after
        self._units: list[Unit] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None: ...

    def submit(self, unit: Unit) -> None:
        assert len(self._units) < self.slots
        self._units.append(unit)

    def next_done(self) -> Done:
        if not self._left:
            raise KeyboardInterrupt
        self._left -= 1
        unit = self._units.pop(self._rng.integers(len(self._units)))
        return Done(unit=unit, value=self._work(unit))


def variation(unit: Unit) -> Variation:
    return Variation(seed=0, index=unit.index, x=0.01 * unit.index, y=0.0, yaw=0.0)


def screen(unit: Unit) -> tuple[Variation, Rejection | None]:
    """Every third draw is not tried."""
    rejection = Rejection(reason="out_of_view", detail="beside the image") if unit.index % 3 == 2 else None
    return variation(unit), rejection


def work_in(folder: Path) -> Callable[[Unit], tuple[bool, dict[str, float]]]:
    """Every fourth draw is rejected, of asset b all but one in four."""

    def work(unit: Unit) -> tuple[bool, dict[str, float]]:
        good = unit.index % 4 == 3 if unit.asset else unit.index % 4 != 1
        if good:
            cameras = {"front": corner_camera(64, 48)}
            episode = drawer_episode(unit.number, np.zeros((3, 6)), np.zeros(3), cameras, {}, {})
            commit_episode(folder, episode, {"front": VIDEO})
        else:
            write_rejection(folder, unit, variation(unit), Rejection(reason="collision", detail="the hand"))
        return good, {}

    return work


def fill(folder: Path, executor: Scrambled, request: Request = REQUEST) -> None:
    folder.mkdir(exist_ok=True)
    generate(folder, request, executor, screen, lambda share, text: None)


def tree(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "episodes"
    folder.mkdir()
    fill(folder, Scrambled(work_in(folder), 1))
    return folder


@pytest.mark.parametrize(("slots", "seed"), [(2, 0), (3, 1), (8, 2), (40, 3)])
def test_the_tree_does_not_depend_on_the_number_of_workers(whole, tmp_path, slots, seed):
    fill(tmp_path / "run", Scrambled(work_in(tmp_path / "run"), slots, seed))
    assert tree(tmp_path / "run") == tree(whole)


def test_a_run_that_stops_anywhere_continues_to_the_same_tree(whole, tmp_path):
    folder = tmp_path / "run"
    for stop_after in range(4):
        with pytest.raises(KeyboardInterrupt):
            fill(folder, Scrambled(work_in(folder), 3, stop_after, stop_after))
        balance(folder)
    fill(folder, Scrambled(work_in(folder), 2))
    assert tree(folder) == tree(whole)


def balance(folder: Path) -> None:
    for account in read_accounts(folder):
        assert account.requested == account.committed + account.rejected + account.left
        assert account.left >= 0


def test_the_ledger_counts_what_came_of_the_request(whole):
    full, short = read_accounts(whole)
    assert (full.committed, full.rejected, full.left) == (5, 0, 0)
    # Draws 0 1 3 4 6 7 9 10 12 13 15 16 are tried, 3 7 15 give an episode.
    assert (short.committed, short.rejected, short.left, short.attempts) == (3, 2, 0, 12)
    assert short.reasons == {"collision": 9, "out_of_view": 5}
    draws = [draw for draw in read_draws(whole) if draw["asset"] == 1]
    assert [draw["outcome"] for draw in draws[:4]] == ["rejected", "rejected", "skipped", "committed"]
    assert all(draw["reason"] and draw["detail"] for draw in draws if draw["outcome"] != "committed")


def test_more_episodes_are_added_to_what_is_there_and_fewer_taken_from_it(whole, tmp_path):
    folder = tmp_path / "run"
    more = replace(REQUEST, episodes=7, attempts=30)
    fill(folder, Scrambled(work_in(folder), 2))
    asked: list[Unit] = []
    work = work_in(folder)
    fill(folder, Scrambled(lambda unit: asked.append(unit) or work(unit), 2), more)
    assert not {unit.number for unit in asked} & {int(path.name) for path in list_committed(whole)}
    assert [account.committed for account in read_accounts(folder)] == [7, 7]
    fill(folder, Scrambled(lambda unit: pytest.fail("made again"), 2))
    assert tree(folder) == tree(whole)


def test_draws_that_have_ended_are_not_screened_again(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    screened: list[Unit] = []
    request = replace(REQUEST, episodes=7, attempts=30)
    with pytest.raises(KeyboardInterrupt):
        generate(
            folder,
            request,
            Scrambled(work_in(folder), 1, 0, 0),
            lambda unit: screened.append(unit) or screen(unit),
            lambda share, text: None,
        )
    committed, rejected = list_ended_units(whole)
    assert screened
    assert not set(screened) & (committed | rejected)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("request.json", {"assets": ["a"]}),
        ("draws.json", []),
        ("rejected/000001.json", {"reason": "collision"}),
    ],
)
def test_a_ledger_of_somebody_else_is_named(whole, tmp_path, name, content):
    folder = shutil.copytree(whole, tmp_path / "run")
    write_json(folder / name, content)
    with pytest.raises(MalformedFileError, match=f"{name}: .*; delete it and run again"):
        read_accounts(folder)


def test_what_nothing_comes_of_is_given_up(tmp_path):
    def never(unit: Unit) -> tuple[Variation, Rejection | None]:
        return variation(unit), Rejection(reason="out_of_reach")

    generate(tmp_path, REQUEST, Scrambled(work_in(tmp_path), 2), never, lambda share, text: None)
    assert [(a.committed, a.rejected, a.left) for a in read_accounts(tmp_path)] == [(0, 5, 0)] * 2


def test_damaged_units_are_made_again_and_others_kept(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "run")
    folder, made = tmp_path / "run", list[int]()
    damaged, rejected = sorted(folder.glob("0*"))[0], sorted((folder / "rejected").glob("*"))[0]
    (damaged / "front.mp4").write_bytes(b"")
    forget_files(folder, [f"{damaged.name}/front.mp4", "draws.json", f"rejected/{rejected.name}"])
    assert not damaged.exists()
    assert not rejected.exists()
    assert not (folder / "draws.json").exists()
    other = sorted((folder / "rejected").glob("*"))[0]
    other.write_text("{")

    def work(unit: Unit) -> Any:
        made.append(unit.number)
        return work_in(folder)(unit)

    with pytest.warns(StoredFileWarning, match=f"{other.name}.*computed again") as warned:
        fill(folder, Scrambled(work, 3))
    assert len(warned) == 1
    assert sorted(made) == sorted(int(path.stem) for path in (damaged, rejected, other))
    assert tree(folder) == tree(whole)


def test_a_unit_whose_worker_was_lost_is_a_rejection(tmp_path):
    class Losing(Scrambled):
        def next_done(self) -> Done:
            done = super().next_done()
            return replace(done, value=None, lost="worker_died") if done.unit.index == 0 else done

    def good(unit: Unit) -> tuple[bool, dict[str, float]]:
        return True, {}

    generate(
        tmp_path,
        replace(REQUEST, assets=("a",), episodes=1),
        Losing(good, 1),
        screen,
        lambda share, text: None,
    )
    assert [draw["reason"] for draw in read_draws(tmp_path)] == ["worker_died", ""]


@pytest.mark.slow
def test_episodes_of_a_toy_run_are_real(tmp_path):
    results = toy_run(
        tmp_path,
        params={
            "ranges": {"x_m": [-0.02, 0.05], "yaw_deg": [-15, 15], "scale": [0.9, 1.0]},
            "free_cameras": 1,
        },
    )
    folder = results.folders["episodes"]
    assert results.fitted_assets[0].asset.category == "drawer"
    chosen = load_artifact(folder / GRASPS_FOLDER, "drawer", GraspChoice).usual
    assert chosen is not None
    shutil.rmtree(folder / GRASPS_FOLDER)
    figures = run(results, folder, lambda share, text: None)
    assert (figures["episodes"], figures["short"]) == (2, 0)
    found = load_artifact(folder / GRASPS_FOLDER, "drawer", GraspChoice).usual
    assert found is not None
    assert (found.name, found.turn_ratio) == (chosen.name, chosen.turn_ratio)
    assert (folder / DRAWS_FILE).is_file()
    committed, _ = list_ended_units(folder)
    for path in list_committed(folder):
        item = read_episode(path)
        assert sorted(item.videos) == ["free0", "front", "side"]
        assert item.episode.thetas[-1] > 0.09
        usd = (path / item.episode.asset_usd).resolve()
        assert usd.is_file()
        assert usd.with_name(REPLAY_SCRIPT.name).is_file()
        replayed = read_recording(path)
        assert replayed.usd == usd
        np.testing.assert_array_equal(replayed.commands[1:, :-1], item.episode.action_joints)
        assert 0.9 <= item.episode.verdict["variation"]["scale"] <= 1.0
    shown = "".join(draws_section(results))
    assert "scale: 2 of" in shown
    assert shown.count("<polygon") == 3 * 3, "all places of the map are within reach"
    # The same unit made once more, in this process, is the same to the byte.
    unit = min(committed, key=lambda unit: unit.number)
    other = tmp_path / "again"
    EpisodeFactory(results, other).make(unit)
    name = f"{unit.number:06d}"
    assert tree(other / name).keys() == tree(folder / name).keys()
    assert {k: v for k, v in tree(other / name).items()} == tree(folder / name)


def test_an_episode_that_closes_its_object_begins_open_and_ends_closed(tmp_path):
    results = toy_run(tmp_path, params={"ranges": {"x_m": [0.0, 0.05], "yaw_deg": [-15, 15]}})
    vars(results)["demonstration"] = closing_of(results.demonstration)
    vars(results)["fitted_assets"] = [fitted.backwards() for fitted in results.fitted_assets]
    factory, unit = EpisodeFactory(results, results.folders["episodes"]), Unit(asset=0, index=0)
    assert factory.screen(unit)[1] is None
    assert factory.make(unit)[0]
    (path,) = list_committed(factory.folder)
    episode = read_episode(path).episode
    assert episode.thetas[0] == pytest.approx(0.15, abs=1e-3)
    assert abs(episode.thetas[-1]) < 0.005
    assert (episode.verdict["start_theta"], episode.verdict["target_theta"]) == (0.15, 0.0)


@pytest.mark.slow
def test_an_asset_that_never_opens_far_enough_is_told_with_its_reasons(tmp_path):
    results = toy_run(tmp_path, params={"ranges": {"scale": [0.3, 0.3]}, "attempts_per_episode": 2}, poses=1)
    with pytest.raises(NotEnoughEpisodesError, match="drawer-0: 0 of 1 episodes from 2 planned samples"):
        run(results, results.folders["episodes"], lambda share, text: None)
    assert all(account.left == 0 for account in read_accounts(results.folders["episodes"]))


def test_what_stands_in_the_scene_is_planned_and_verified_with(tmp_path):
    """A wall before the drawer: the hand cannot pass."""
    T = fitted_drawer().T_world_asset
    wall = OrientedBox(
        T_world_box=transform(np.eye(3), T[:3, 3] - [0.45, 0, -0.4]), half_extents=np.array([0.01, 0.5, 0.4])
    )
    results = toy_run(tmp_path, obstacles=(wall,))
    unit = Unit(asset=0, index=0)
    factory = EpisodeFactory(results, results.folders["episodes"])
    assert factory.asset(0).sized(1.0)[1].roles.obstacle.sum() == 1
    assert not factory.make(unit)[0]
    rejection = read_rejection(results.folders["episodes"], unit)
    assert rejection.reason in ("collision", "no_path")
    assert (rejection.excess is not None) == bool(rejection.bodies) == (rejection.reason == "collision")


HOPELESS = {
    "beyond reach": (
        {"x_m": [0.9, 1.2]},
        r"no feasible pose for drawer-0: of 200 samples, at x 1\.\d\d to .*, 200 out of the arm's reach; the arm can hold its handle at",
    ),
    "beside the table": (
        {"polygon": [[5.0, 5.0], [5.5, 5.0], [5.0, 5.5]]},
        r"of 200 samples, at x 5.00 to 5\.\d\d m, y 5.00 to 5\.\d\d m, \d+ off the table, \d+ outside the area; .* the free table is x",
    ),
    "where something stands": ({"x_m": [-0.01, 0.01], "yaw_deg": [0, 0]}, "200 blocked by an obstacle"),
}


@pytest.mark.parametrize("name", HOPELESS)
def test_ranges_that_hold_no_place_are_refused_before_work(tmp_path, name):
    ranges, words = HOPELESS[name]
    around = fitted_drawer().T_world_asset[:2, 3]
    table = replace(SUPPORT, low_xy=around - 2, high_xy=around + 2)
    inside = OrientedBox(T_world_box=fitted_drawer().T_world_asset, half_extents=np.full(3, 0.05))
    obstacles = (inside,) if "something" in name else ()
    results = toy_run(tmp_path, params={"ranges": ranges}, support=table, obstacles=obstacles)
    folder = results.folders["episodes"]
    with pytest.raises(ConfigError, match=words) as caught:
        run(results, folder, lambda share, text: None)
    assert caught.value.exit_code == 2
    (picture,) = set(folder.iterdir()) - {folder / GRASPS_FOLDER}
    assert str(picture) in str(caught.value)
    assert picture.read_text().startswith("<svg")
    ElementTree.parse(picture)


@pytest.mark.slow
def test_an_asset_without_a_place_leaves_the_others_theirs(tmp_path):
    around = fitted_drawer().T_world_asset[:2, 3]
    table = replace(SUPPORT, low_xy=around - 2, high_xy=around + 2)
    results = toy_run(tmp_path, assets=2, poses=1, support=table)
    here, there = results.fitted_assets
    T = there.T_world_asset.copy()
    T[0, 3] += 3.0
    vars(results)["fitted_assets"] = [replace(there, T_world_asset=T), here]
    found = run(results, results.folders["episodes"], lambda share, text: None)
    assert found["episodes"] == 1
    (warning,) = found["warnings"]
    assert warning.startswith("asset drawer-1: 0 of 1 episodes from 0 planned samples")
    assert "off_table" in warning


def test_what_a_user_sets_by_name_arrives(tmp_path):
    named = {"attempts_per_episode": 2, "free_cameras": 1, "ranges": {"x_m": [0, 0.1], "polygon": []}}
    wanted = GenerationParams(attempts_per_episode=2, free_cameras=1, ranges=Ranges(x_m=(0.0, 0.1)))
    assert toy_run(tmp_path, params=named).params("episodes", GenerationParams()) == wanted
