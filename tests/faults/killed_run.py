"""A short run that a test kills: commits small episodes, then builds their dataset."""

import sys
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.core.camera import Camera, look_at
from aomgen.core.episode import Episode, no_contacts
from aomgen.core.joint import Joint
from aomgen.core.progress import Progress
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.io.episode_folder import commit_episode, episode_folder, list_committed
from aomgen.io.video import encode_video
from aomgen.pipeline.project import Project
from aomgen.pipeline.runner import run_stages
from aomgen.pipeline.stage import Run, Stage

EPISODES, FRAMES, SIZE = 10, 30, (128, 96)


class Quiet:
    """A display that says one word when everything is ready, so that the test can time its kills."""

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        sys.stdout.write("begin\n")
        sys.stdout.flush()

    def progress(self, share: float, text: str) -> None:
        pass

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None:
        pass

    def warn(self, stage: Stage, sentence: str) -> None:
        pass


def episode(index: int) -> Episode:
    """An episode with numbers of its own."""
    rng = np.random.default_rng(index)
    joints = np.cumsum(rng.normal(0, 0.02, (FRAMES, 6)), 0)
    camera = Camera(
        fx=90, fy=90, cx=64, cy=48, width=SIZE[0], height=SIZE[1], T_world_cam=look_at((1, 1, 1), (0, 0, 0))
    )
    return Episode(
        index=index,
        seed=0,
        instruction="open the drawer",
        robot="ur5e_2f85",
        asset="drawer-1",
        asset_usd="asset.usda",
        joint_names=tuple("abcdef"),
        fps=10,
        joints=joints,
        gripper=np.zeros(FRAMES),
        action_joints=joints,
        action_gripper=np.zeros(FRAMES),
        Ts_world_ee=np.tile(np.eye(4), (FRAMES, 1, 1)),
        Ts_world_ee_action=np.tile(np.eye(4), (FRAMES, 1, 1)),
        thetas=np.linspace(0, 0.2, FRAMES),
        phases=np.zeros(FRAMES, np.int64),
        contacts=no_contacts(),
        joint=Joint(type="prismatic", axis=(0, -1, 0), origin=(0, 0, 0), lower=0, upper=0.3),
        T_world_object=np.eye(4),
        cameras={"front": camera},
        verdict={"passed": True},
        simulation={"bolted": True},
    )


def commit_all(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """Commit every episode that is not there."""
    for index in range(EPISODES):
        if not episode_folder(folder, index).exists():
            rng = np.random.default_rng(100 + index)
            frames = rng.integers(0, 255, (FRAMES, SIZE[1], SIZE[0], 3), np.uint8)
            commit_episode(folder, episode(index), {"front": encode_video(frames, 10)})
    return {"episodes": EPISODES}


def build(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """Build the dataset."""
    return {"episodes": write_lerobot_v3(list_committed(run.folders["episodes"]), folder).episodes}


def main(out: Path) -> None:
    """Run both stages in a folder."""
    common = {"settings": (), "version": 1, "weight": 1.0, "title": ""}
    stages = (
        Stage(
            name="episodes",
            folder="episodes",
            needs=("capture",),
            function=commit_all,
            incremental=True,
            **common,
        ),
        Stage(name="dataset", folder="dataset", needs=("episodes",), function=build, **common),
    )
    run_stages(Project(capture=out, out=out), stages, Quiet(), capture_digest="same")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
