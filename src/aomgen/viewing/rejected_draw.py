"""A sample without an episode, planned again for the twin page: planning is deterministic, states are not stored."""

import json
from dataclasses import asdict, replace

import numpy as np

from aomgen.core.demonstration import Trajectory
from aomgen.core.episode import ContactLog, Episode
from aomgen.core.keypoints import find_keypoints
from aomgen.core.plan import EpisodePlan, Rejection
from aomgen.core.transforms import apply
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.ledger import unit_of
from aomgen.io.episode_folder import CommittedEpisode, episode_folder
from aomgen.results import Results
from aomgen.viewing.draw_list import Draw

# Keys of a sample's verdict: a sentence for the person who reviews it, and the names of the colliding bodies.
NOTE, PAIR = "note", "pair"


def replan_draw(results: Results, draw: Draw) -> CommittedEpisode:
    """Plan a rejected sample again, and return its motion as an episode without videos.

    If the simulation has refused the plan, the motion is the whole plan. Otherwise it is the state with the
    largest violation in the candidate that progressed farthest, or else the arm at the demonstrated start.

    Args:
        results: Results of a run whose stage "replacement" has finished.
        draw: Sample with the outcome "rejected" or "skipped".

    Returns:
        An episode whose verdict contains the variation, a sentence `NOTE`, and names `PAIR`.
    """
    folder = results.folders["episodes"]
    factory, unit = EpisodeFactory(results, folder), unit_of(draw.number)
    variation, screened = factory.screen(unit)
    opened = factory.asset(unit.asset)
    fitted, _ = opened.sized(variation.scale)
    planned = screened or factory.plan(opened, variation)
    shown: Trajectory = results.demonstration[:1]
    if isinstance(planned, EpisodePlan):
        shown, what = planned, "The page shows the plan, which failed in the simulation."
    elif planned.worst is not None:
        shown, what = (
            planned.worst,
            "The page shows the worst violation of the candidate that progressed farthest.",
        )
    else:
        what = "The state of the arm is not known; the page shows its start."
    T_world_object, robot = variation.place_at(fitted), results.robot
    path = replace(shown.with_object(T_world_object), times_s=np.arange(len(shown)) / results.fps)
    verdict = {
        # Same form as in the file of a committed episode.
        "variation": json.loads(json.dumps(asdict(variation))),
        "bolted": factory.params.bolted,
        NOTE: f"Sample {draw.number} gave no episode: {_state_reason(planned, draw)}. {what}",
        PAIR: planned.bodies if isinstance(planned, Rejection) else (),
    }
    episode = Episode(
        index=draw.number,
        seed=variation.seed,
        instruction="",
        robot=robot.name,
        asset=draw.asset,
        asset_usd="",
        joint_names=robot.joint_names,
        fps=round(results.fps),
        times_s=path.times_s,
        joints=path.joints,
        gripper=path.gripper,
        thetas=path.thetas,
        T_world_object=T_world_object,
        action_joints=path.joints,
        action_gripper=path.gripper,
        Ts_world_ee=path.ee_poses(robot),
        Ts_world_ee_action=path.ee_poses(robot),
        phases=np.zeros(len(path), np.int64),
        contacts=_NO_CONTACTS,
        joint=fitted.asset.joint.move(T_world_object),
        keypoints=apply(T_world_object, find_keypoints(fitted.asset)),
        cameras=factory.place.views(variation, fitted),
        verdict=verdict,
        simulation={},
    )
    return CommittedEpisode(
        folder=episode_folder(folder, draw.number),
        episode=episode,
        videos={},
        sha256={},
        codec="h264",
        color_counts={},
        images={},
    )


def _state_reason(planned: EpisodePlan | Rejection, draw: Draw) -> str:
    """Return the reason of a sample; that of this planning if a changed parameter or version gives another."""
    stated = f"{draw.reason.replace('_', ' ')}, {draw.detail}"
    if not isinstance(planned, Rejection) or planned.reason == draw.reason:
        return stated
    return f"{stated}; planned again it gives {planned.reason.replace('_', ' ')}, {planned.detail}"


_NO_CONTACTS = ContactLog(
    frames=np.zeros(0, np.int64),
    fingers=np.zeros(0, np.int64),
    points_world=np.zeros((0, 3)),
    normals_world=np.zeros((0, 3)),
    forces=np.zeros(0),
)
