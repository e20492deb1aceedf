"""A small run that a test kills: plans a drawer in physics, commits small episodes, builds their dataset.

Started without arguments it serves: for each line "folder capture-digest" it forks a child that runs the
stages there, so that a child starts in no time, and says what it does, one line each.
"""

import os
import sys
from functools import cache, partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from aomgen.core.plan import Rejection, Variation
from aomgen.core.progress import Progress
from aomgen.core.project import Project
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.episodes.factory import Outcome
from aomgen.episodes.generate import generate
from aomgen.episodes.ik import ik_solver
from aomgen.episodes.joint_limits import IkLimits
from aomgen.episodes.ledger import Request, Unit, write_rejection
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.episodes.record import episode_of
from aomgen.episodes.variations import Ranges, draw
from aomgen.executors import Done, Work
from aomgen.io.episode_folder import commit_episode, list_committed
from aomgen.io.video import encode_video
from aomgen.pipeline.runner import Stage, run_stages
from aomgen.results import Results
from aomgen.robots.loading import load_robot
from aomgen.simulation.scene import build_scene
from aomgen.simulation.verify import verify_plan

sys.path.append(str(Path(__file__).parents[1] / "helpers"))
from drawer_episode import corner_camera
from toy_drawer import SUPPORT, fitted_drawer, opening

SIZE = (64, 48)
# An arm so slow that, of this sequence, the first and the fourth attempt pass.
RANGES = Ranges(x_m=(-0.02, 0.05), yaw_deg=(-15, 15))
PLAN = PlanParams(ik=IkLimits(speed=0.5), max_slow_down=1.0)
REQUEST = Request(assets=("drawer-1",), episodes=4, attempts=20)


class Told:
    """A display that says which stage begins, so that the test can time its kills."""

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        if not fresh:
            say(f"begin {stage.name}")

    def progress(self, share: float, text: str) -> None:
        pass

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None:
        say(f"end {stage.name}")

    def warn(self, stage: Stage, sentence: str) -> None:
        pass


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


class Here:
    """Does units in this process, as soon as somebody waits for them."""

    slots = 1

    def __init__(self, work: Work) -> None:
        self._work, self._units = work, []

    def submit(self, unit: Unit) -> None:
        self._units.append(unit)

    def next_done(self) -> Done:
        unit = self._units.pop()
        return Done(unit=unit, value=self._work(unit))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None: ...


@cache
def drawer() -> tuple[Any, ...]:
    """Asset, demonstration, solver, scene."""
    robot, fitted = load_robot("ur5e_2f85"), fitted_drawer()
    solver = ik_solver(robot)
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    return fitted, opening(solver, fitted), solver, scene


def screen(unit: Unit) -> tuple[Variation, None]:
    """Every draw is tried."""
    return draw(5, unit.asset, unit.index, RANGES), None


def make(folder: Path, unit: Unit) -> Outcome:
    """A real plan and a real verification; the pictures are noise."""
    fitted, demo, solver, scene = drawer()
    variation, _ = screen(unit)
    made = plan_episode(fitted, demo, variation, scene, solver, PLAN)
    if not isinstance(made, Rejection):
        made = verify_plan(made, scene)
    if isinstance(made, Rejection):
        write_rejection(folder, unit, variation, made)
        return Outcome(committed=False, seconds={})
    cameras = {"front": corner_camera(*SIZE)}
    robot = scene.robot
    episode = episode_of(made, unit.number, Path("asset.usda"), robot, "open", cameras, np.zeros(6))
    frames = np.random.default_rng(unit.number).integers(
        0, 255, (len(episode), SIZE[1], SIZE[0], 3), np.uint8
    )
    commit_episode(folder, episode, {"front": encode_video(frames, episode.fps)})
    return Outcome(committed=True, seconds={})


def episodes(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Real attempts, each kept as it is made."""
    generate(folder, REQUEST, Here(partial(make, folder)), screen, progress)
    return {"episodes": len(list_committed(folder))}


def build(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Build the dataset."""
    return {"episodes": write_lerobot_v3(list_committed(results.folders["episodes"]), folder)["episodes"]}


def main(out: Path, digest: str) -> None:
    """Run the stages in a folder."""
    common = {"settings": (), "version": 1, "weight": 1.0, "title": ""}
    stages = (
        Stage(
            name="episodes",
            folder="episodes",
            needs=("capture",),
            function=episodes,
            incremental=True,
            **common,
        ),
        Stage(name="dataset", folder="dataset", needs=("episodes",), function=build, **common),
    )
    run_stages(Project(capture=out, out=out), stages, Told(), inputs={"capture": digest})


def serve() -> None:
    """Fork a child for every line of the input, and say its process id and in the end how it ended."""
    drawer()
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            say(f"child {os.getpid()}")
            out, digest = line.split()
            main(Path(out), digest)
            os._exit(0)
        say(f"ended {os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}")


if __name__ == "__main__":
    serve()
