"""The bench of replayed demonstrations: what is feasible, what counts, and that it can be continued."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.assets.usd_write import write_usd
from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation, VerifiedEpisode
from aomgen.core.transforms import apply
from aomgen.episodes.ik import ik_solver
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.episodes.record import episode_of
from aomgen.episodes.variations import scale_fit
from aomgen.io.artifact import read_json, save_artifact
from aomgen.results import ASSET_USD
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import Scene, build_scene
from aomgen.simulation.verify import verify_plan
from backwards import closing_of
from benchmarks import replay_runs
from benchmarks.exported import Opening, exported_of
from benchmarks.reachability import can_hold
from benchmarks.recovered import RECOVERED, Recovered, recover
from benchmarks.replay import (
    PAPER,
    draw,
    interval_95,
    judge_exported,
    judge_opening,
    recheck,
    summary,
)
from toy_drawer import SUPPORT, fitted_drawer, opening

HERE = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0)


@pytest.fixture(scope="module")
def fitted() -> FittedAsset:
    return fitted_drawer()


@pytest.fixture(scope="module")
def demo(robot: RobotModel, fitted: FittedAsset) -> Demonstration:
    return opening(ik_solver(robot), fitted)


@pytest.fixture(scope="module")
def scene(robot: RobotModel, fitted: FittedAsset) -> Scene:
    return build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)


@pytest.fixture(scope="module")
def plan(robot: RobotModel, fitted: FittedAsset, demo: Demonstration, scene: Scene) -> EpisodePlan:
    planned = plan_episode(fitted, demo, HERE, scene, ik_solver(robot), PlanParams())
    assert isinstance(planned, EpisodePlan)
    return planned


@pytest.fixture(scope="module")
def verified(plan: EpisodePlan, scene: Scene) -> VerifiedEpisode:
    outcome = verify_plan(plan, scene)
    assert isinstance(outcome, VerifiedEpisode)
    return outcome


def test_the_demonstrated_place_is_feasible_and_one_out_of_reach_is_not(
    fitted: FittedAsset, demo: Demonstration, scene: Scene
) -> None:
    for x, feasible in ((0.0, True), (2.0, False), (-0.85, False)):
        placed = scene.place_at(replace(HERE, x=x).place_at(fitted))
        assert can_hold(placed, fitted, demo.joints[0], np.random.default_rng(0), 60) == feasible, x


def test_a_wall_before_the_handle_makes_it_infeasible(
    fitted: FittedAsset, demo: Demonstration, robot: RobotModel
) -> None:
    high = replace(SUPPORT, height=float(apply(fitted.T_world_asset, fitted.contact_asset)[2]))
    sunk = build_scene(robot, fitted.asset, fitted.T_world_asset, high)
    assert not can_hold(sunk, fitted, demo.joints[0], np.random.default_rng(0), 60)


def test_draws_are_independent_uniform_and_repeatable() -> None:
    draws = [draw(PAPER, "drawer", 7, index) for index in range(400)]
    assert draws[3] == draw(PAPER, "drawer", 7, 3)
    assert draws[3].x != draw(PAPER, "laptop", 7, 3).x
    values = np.array([[item.x, item.y, np.rad2deg(item.yaw)] for item in draws])
    low, high = np.array([-0.05, -0.05, -45.0]), np.array([0.30, 0.05, 45.0])
    shares = (values - low) / (high - low)
    assert shares.min() >= 0
    assert shares.max() <= 1
    np.testing.assert_allclose(shares.mean(0), 0.5, atol=0.06)
    np.testing.assert_allclose(np.corrcoef(shares.T), np.eye(3), atol=0.15)


@pytest.mark.parametrize(("successes", "trials"), [(196, 200), (0, 25), (25, 25), (7, 10)])
def test_intervals_are_wilsons(successes: int, trials: int) -> None:
    z, share = 1.959964, successes / trials
    middle = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * np.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    np.testing.assert_allclose(interval_95(successes, trials), [middle - half, middle + half], atol=1e-6)


def test_exported_actions_open_the_drawer_and_miss_a_moved_one(
    robot: RobotModel, verified: VerifiedEpisode, tmp_path: Path
) -> None:
    write_usd(verified.plan.fitted.asset, tmp_path / ASSET_USD)
    row = judge_exported(verified, robot, tmp_path / ASSET_USD)
    assert row["failure"] == ""
    assert row["near"]
    assert row["theta_worst"] < 2.0
    assert not row["opened_when_moved"]


def test_a_drawer_of_another_file_is_not_opened(
    robot: RobotModel, verified: VerifiedEpisode, tmp_path: Path
) -> None:
    smaller = scale_fit(verified.plan.fitted, 0.7).asset
    write_usd(smaller, tmp_path / ASSET_USD)
    assert judge_exported(verified, robot, tmp_path / ASSET_USD)["failure"].startswith("replay")


def test_a_refused_plan_is_a_failure_with_its_reason(robot: RobotModel, tmp_path: Path) -> None:
    row = judge_exported(Rejection(reason="contact", detail="lost"), robot, tmp_path / ASSET_USD)
    assert row == {"failure": "contact", "failure_detail": "lost"}


def test_an_opening_counts_when_the_fingers_did_it(robot: RobotModel, verified: VerifiedEpisode) -> None:
    thetas = np.asarray(np.linspace(0.0, verified.plan.fitted.target_theta, 20), np.float64)
    carried = np.arange(20) > 0
    usd = Path(ASSET_USD)
    exported = exported_of(episode_of(verified, 0, usd, robot, "", {}, np.zeros(6)), usd)
    assert judge_opening(Opening(thetas=thetas, carried=carried), exported) == ""
    assert judge_opening(Opening(thetas=0.85 * thetas, carried=carried), exported) == "target"
    assert judge_opening(Opening(thetas=thetas, carried=np.zeros(20, bool)), exported) == "moved_early"
    assert judge_opening(Opening(thetas=thetas, carried=np.arange(20) == 0), exported) == "contact"


def test_a_plan_is_rechecked_by_forward_kinematics(robot: RobotModel, plan: EpisodePlan) -> None:
    good = recheck(plan, robot, PlanParams())
    assert good["mm"] <= 1.0
    assert good["deg"] <= 0.5
    assert good["step"] <= 1.0
    row = np.flatnonzero(plan.phases == 1)[5]
    bent = plan.joints.copy()
    bent[row, 3] += 0.02
    wrong = recheck(replace(plan, joints=bent), robot, PlanParams())
    assert wrong["mm"] > 1.0
    assert wrong["deg"] > 0.5
    fast = plan.joints.copy()
    fast[row:, 5] += 0.3
    assert recheck(replace(plan, joints=fast), robot, PlanParams())["step"] > 1.0


@pytest.mark.slow
def test_a_killed_bench_goes_on(
    fitted: FittedAsset, demo: Demonstration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One thread of this process: others would compile everything again.
    monkeypatch.setattr(replay_runs, "start_workers", lambda: ThreadPoolExecutor(1))
    found = Recovered(demo=demo, fitted=fitted, support=SUPPORT, fps=10.0, world=7001, refused=("7000",))
    closed = replace(found, demo=closing_of(demo), fitted=fitted.backwards())
    home = tmp_path / "drawer"
    for place, item in ((home, found), (tmp_path / "closing" / "drawer", closed)):
        place.mkdir(parents=True)
        write_usd(fitted.asset, place / ASSET_USD)
        save_artifact(place, RECOVERED, item)
    assert recover("drawer", 7000, home).fitted.target_theta == fitted.target_theta
    told: list[str] = []
    figures = replay_runs.run_replay_bench(tmp_path, 2, 7000, told.append, ("drawer",), ())
    row = figures["drawer"]
    assert (row["attempts"], row["success_rate"], row["opened_when_moved"]) == (2, 1.0, 0)
    assert row["demonstrations_refused"] == ["7000"]
    assert row["attempts"] <= row["feasible"] <= row["drawn"]
    assert figures["ik"]["plans"] == 2
    assert figures["ik"]["mm"] <= 1.0
    assert figures["closing"]["drawer"]["attempts"] == 1
    assert figures["closing"]["drawer"]["success_rate"] == 1.0
    assert figures["closing"]["drawer"]["opened_when_moved"] == 0
    # What a killed bench leaves behind is not made again.
    kept = sorted((home / "paper").glob("*.json"))
    rows = [read_json(path) for path in kept][: row["drawn"]]
    assert summary(rows)["attempts"] == 2
    stamps = [path.stat().st_mtime_ns for path in kept]
    assert replay_runs.run_replay_bench(tmp_path, 2, 7000, told.append, ("drawer",), ()) == figures
    assert [path.stat().st_mtime_ns for path in kept] == stamps
