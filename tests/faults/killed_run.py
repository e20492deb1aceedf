"""A small run that a test kills: plans a drawer in physics, commits small episodes, builds their dataset.

Started without arguments it serves: for each line "folder capture-digest" it forks a child that runs the
stages there, so that a child starts in no time, and says what it does, one line each.
"""

import os
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.core.episode import Episode
from aomgen.core.progress import Progress
from aomgen.core.project import Project
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.episodes.generate import GenerationParams, PoseRanges
from aomgen.episodes.ik import IkLimits, ik_solver
from aomgen.episodes.planning import PlanParams
from aomgen.episodes.plans_stage import generate_in
from aomgen.io.episode_folder import commit_episode, episode_folder, list_committed
from aomgen.io.video import encode_video
from aomgen.pipeline.runner import Stage, run_stages
from aomgen.results import Results
from aomgen.robots.loading import load_robot

sys.path.append(str(Path(__file__).parents[1] / "helpers"))
from drawer_episode import corner_camera, drawer_episode
from toy_drawer import SUPPORT, fitted_drawer, opening

EPISODES, FRAMES, SIZE = 10, 30, (128, 96)
# An arm so slow that, of this sequence, the first and the fourth attempt pass.
PARAMS = GenerationParams(
    count=2,
    seed=5,
    ranges=PoseRanges(x_m=(-0.02, 0.05), yaw_deg=(-15, 15)),
    plan=PlanParams(ik=IkLimits(speed=0.5), max_slow_down=1.0),
)


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


def episode(index: int) -> Episode:
    """An episode with numbers of its own."""
    rng = np.random.default_rng(index)
    joints = np.cumsum(rng.normal(0, 0.02, (FRAMES, 6)), 0)
    cameras = {"front": corner_camera(*SIZE)}
    thetas = np.linspace(0, 0.2, FRAMES)
    return drawer_episode(index, joints, thetas, cameras, {"passed": True}, {"bolted": True})


def commit_all(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Commit every episode that is not there."""
    for index in range(EPISODES):
        if not episode_folder(folder, index).exists():
            rng = np.random.default_rng(100 + index)
            frames = rng.integers(0, 255, (FRAMES, SIZE[1], SIZE[0], 3), np.uint8)
            commit_episode(folder, episode(index), {"front": encode_video(frames, 10)})
    return {"episodes": EPISODES}


def build(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Build the dataset."""
    return {"episodes": write_lerobot_v3(list_committed(results.folders["episodes"]), folder)["episodes"]}


@cache
def drawer() -> tuple[Any, ...]:
    """Assets, demonstration, robot."""
    robot, fitted = load_robot("ur5e_2f85"), fitted_drawer()
    return [fitted], opening(ik_solver(robot), fitted), robot


def plan(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Real attempts, each kept as it is made."""
    made = generate_in(folder, *drawer(), SUPPORT, PARAMS, progress)
    return {"verified": len(made.episodes), "rejected": len(made.rejected)}


def main(out: Path, digest: str) -> None:
    """Run the stages in a folder."""
    common = {"settings": (), "version": 1, "weight": 1.0, "title": ""}
    stages = (
        Stage(name="plans", folder="plans", needs=("capture",), function=plan, incremental=True, **common),
        Stage(
            name="episodes",
            folder="episodes",
            needs=("plans",),
            function=commit_all,
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
