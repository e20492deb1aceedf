"""A run folder with small episodes, rejections and an untried draw, none of them planned or rendered."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.core.plan import Rejection, Variation
from aomgen.core.project import Project
from aomgen.core.verdict import Check, Setting, SettingOutcome, Verdict
from aomgen.episodes.ledger import Request, Unit, write_draws, write_rejection, write_request
from aomgen.io.episode_folder import commit_episode
from aomgen.io.video import encode_video
from aomgen.pipeline.project_file import write_project
from aomgen.pipeline.stages import PROJECT_FILE
from small_episodes import FPS, make_episode, make_frames

FRAMES = 12
COLLISION = "penetration_mm is 3.0, limit 1.0 (wrist_1_link and table)"
OUT_OF_VIEW = "camera front shows 69% of the action, limit 85%"


def make_variation(index: int) -> Variation:
    return Variation(seed=5, index=index, x=0.01 * index, y=0.02, yaw=0.1)


def make_verdict(torque_share: float) -> Verdict:
    """Make a verdict whose drives are nearest to their limit in the setting "stiff"."""
    outcomes = [
        SettingOutcome(
            setting=Setting(name=name, damping=1.0, frictionloss=1.0, moving_mass=1.0),
            final_theta=1.2,
            peak_force_n=40.0,
            peak_reaction_n=10.0,
            hold_s=(0.1, 1.0),
            hold_thetas=(0.0, 1.2),
            checks=(
                Check(reason="torque", figure="torque_share", value=share, limit=0.9),
                Check(reason="target", figure="target_share", value=1.0, limit=0.9, least=True),
            ),
        )
        for name, share in (("stiff", torque_share), ("nominal", 0.1))
    ]
    return Verdict(
        start_theta=0.0,
        target_theta=1.2,
        outcomes=tuple(outcomes),
        kinematic=(Check(reason="residual", figure="residual_mm", value=0.1, limit=1.0),),
        bolted=True,
        seed=5,
        index=0,
    )


def commit_reviewed(out: Path, index: int, torque_share: float) -> Path:
    """Commit an episode; its verdict is as `make_verdict` states."""
    phases = np.repeat([0, 1, 2], [3, 6, 3])
    stated: dict[str, Any] = make_verdict(torque_share).as_json()
    stated |= {"variation": asdict(make_variation(index)), "grasp": "by the rim"}
    episode = replace(make_episode(index, FRAMES), verdict=stated, phases=phases)
    videos = {
        name: encode_video(make_frames(index % 10, FRAMES, k), FPS) for k, name in enumerate(episode.cameras)
    }
    return commit_episode(out / "08_episodes", episode, videos)


def write_reviewed_run(out: Path) -> Path:
    """Write a run with episodes 1, 2 and 4, rejection 3, and draw 0, which was not tried."""
    folder = out / "08_episodes"
    write_request(folder, Request(assets=("microwave-1",), episodes=3, attempts=15))
    for index, share in ((1, 0.3), (2, 0.85), (4, 0.5)):
        commit_reviewed(out, index, share)
    rejection = Rejection(
        reason="collision",
        detail=COLLISION,
        metrics={"penetration_mm": 3.0, "in_contact": 0.0},
        excess=2.0,
        bodies=("wrist_1_link", "table"),
    )
    write_rejection(folder, Unit(asset=0, index=3), make_variation(3), rejection)
    skipped = {"asset": 0, "name": "microwave-1", "number": 0, "variation": asdict(make_variation(0)), "outcome": "skipped", "reason": "out_of_view", "detail": OUT_OF_VIEW, "excess": 16 / 85}  # fmt: skip
    write_draws(folder, iter([skipped]))
    write_project(out / PROJECT_FILE, Project(capture=out, out=out, assets=("microwave:1",)))
    return out
