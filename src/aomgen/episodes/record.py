"""The record that a verified plan becomes."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.episode import Episode
from aomgen.core.plan import VerifiedEpisode
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.simulation.verify import assumptions


def episode_of(
    verified: VerifiedEpisode,
    index: int,
    usd: Path,
    robot: RobotModel,
    instruction: str,
    cameras: Mapping[str, Camera],
    joint_zeros_rad: Array,
) -> Episode:
    """The episode that a verified plan becomes; its actions are the plan one frame ahead."""
    plan = verified.plan
    asset = plan.fitted.asset
    settings = tuple(outcome.setting for outcome in verified.verdict.outcomes)
    return Episode(
        index=index,
        seed=plan.variation.seed,
        instruction=instruction,
        robot=robot.name,
        asset=asset.name,
        asset_usd=usd.as_posix(),
        joint_names=robot.joint_names,
        fps=round(plan.fps),
        joints=verified.joints,
        gripper=verified.gripper,
        action_joints=_ahead(plan.joints),
        action_gripper=_ahead(plan.gripper),
        Ts_world_ee=verified.Ts_world_ee,
        Ts_world_ee_action=_ahead(plan.Ts_world_ee),
        thetas=verified.thetas,
        phases=plan.phases,
        contacts=verified.contacts,
        joint=asset.joint.moved(plan.T_world_object),
        T_world_object=plan.T_world_object,
        cameras=cameras,
        verdict={**verified.verdict.as_json(), "variation": asdict(plan.variation), "grasp": plan.grasp},
        simulation=assumptions(asset, settings, joint_zeros_rad, bolted=verified.verdict.bolted),
    )


def _ahead(samples: Array) -> Array:
    """What comes one sample later (T, ...); the last stays."""
    return np.concatenate([samples[1:], samples[-1:]])
