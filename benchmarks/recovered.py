"""A demonstration recovered in a motion world, and a generated object fitted to it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.assets.choice import make_asset
from aomgen.assets.usd_write import write_usd
from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.demonstration import Demonstration, RecordedObject, SupportPlane
from aomgen.core.motion import Direction
from aomgen.core.parts import surface_points
from aomgen.core.plan import FittedAsset, Rejection
from aomgen.core.values import Array
from aomgen.errors import ConfigError, EstimationError, ReconstructionError
from aomgen.io.artifact import load_artifact, save_artifact
from aomgen.motion.estimate import estimate_motion
from aomgen.motion.inputs import MotionInput
from aomgen.replacement.correspondence import RecordedContact, describe_contact
from aomgen.replacement.fitting import FitParams, fit_asset
from aomgen.results import ASSET_USD, resample_demonstration
from aomgen.simulation.judge import PassRule
from aomgen.twin.binding import object_frame
from aomgen.twin.support import find_support
from benchmarks.motion_worlds import motion_world

# Worlds tried before a category is given up: nine of ten are recovered.
MAX_WORLDS: Final = 5
# Offset of the generated object's seed from that of the world, so that it is never the recorded object.
OTHER_OBJECT: Final = 1000
# A video with a shorter path of the end effector before the grasp shows no approach that
# could be generalized, [m].
MIN_APPROACH_M: Final = 0.05
# Name of a kept demonstration in its folder.
RECOVERED: Final = "recovered"


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovered:
    """Input of planning, recovered from a video without its truth.

    Attributes:
        demo: The demonstration.
        fitted: A generated asset in the recorded object's place.
        support: The table's plane; its outline counts as unknown.
        fps: Rate of the video, [1/s].
        world: Seed of the motion world.
        refused: Why worlds of the previous seeds gave no demonstration.
    """

    demo: Demonstration
    fitted: FittedAsset
    support: SupportPlane
    fps: float
    world: int
    refused: tuple[str, ...]


def recover(category: str, seed: int, folder: Path, direction: Direction = "opening") -> Recovered:
    """Find the first world from a seed on whose motion is recovered; its fit and USD are kept in a folder.

    Args:
        category: Category of the object.
        seed: Seed of the first world.
        folder: Folder of this category and direction.
        direction: Direction of the demonstrated motion.

    Raises:
        ConfigError: None of MAX_WORLDS is recovered.
    """
    if (folder / f"{RECOVERED}.json").is_file():
        return load_artifact(folder, RECOVERED, Recovered)
    refused: list[str] = []
    for number in range(seed, seed + MAX_WORLDS):
        try:
            kind = "open" if direction == "opening" else "closing"
            world = motion_world(category, number, folder / "worlds", kind)
            found = _fitted(world.demonstration, category, number, direction)
        except (ConfigError, EstimationError, ReconstructionError) as error:
            refused.append(f"{category}-{number}: {error}")
            continue
        found = replace(found, refused=tuple(refused))
        write_usd(found.fitted.asset, folder / ASSET_USD)
        save_artifact(folder, RECOVERED, found)
        return found
    raise ConfigError(f"category {category}", f"no world gives a demonstration ({'; '.join(refused)})")


def recorded_motion(
    given: MotionInput, direction: Direction
) -> tuple[Demonstration, SupportPlane, RecordedContact, float]:
    """Compute demonstration, support, contact and the video's rate, [1/s], by the stages of a run.

    Raises:
        EstimationError, ReconstructionError: One of them is not found.
    """
    motion = estimate_motion(given)
    if motion.direction != direction:
        problem = f"is taken for {motion.direction} and shows {direction}"
        raise EstimationError("demonstration video", problem, "try another world")
    fps = float(round(given.video.fps))
    demo = resample_demonstration(motion, given.log, given.robot, fps)
    way = _approach_m(demo)
    if not way >= MIN_APPROACH_M:
        problem = (
            f"begins {1000 * way:.0f} mm before the grasp, at least {1000 * MIN_APPROACH_M:.0f} mm wanted"
        )
        raise EstimationError("demonstration video", problem, "try another world")
    support = _support(given, demo)
    moving, static = (surface_points(given.scene, given.labels, label) for label in (MOVING, STATIC))
    recorded = RecordedObject(moving_points_world=moving, static_points_world=static, support=support)
    return demo, support, describe_contact(demo, recorded, motion.direction), fps


def _fitted(given: MotionInput, category: str, number: int, direction: Direction) -> Recovered:
    """Fit a generated object to the recorded motion."""
    demo, support, contact, fps = recorded_motion(given, direction)
    asset = make_asset(category, number + OTHER_OBJECT)
    fitted = fit_asset(asset, contact, demo.joint.type, "trajectory", FitParams())
    if isinstance(fitted, Rejection):
        raise EstimationError(f"asset {asset.name}", fitted.detail, "try another world")
    travel, least = abs(fitted.travel), PassRule().least_travel(asset.joint.type)
    if not travel >= least:
        problem = f"moves by {travel:.3f}, limit {least:.3f}"
        raise EstimationError(f"asset {asset.name}", problem, "try another world")
    return Recovered(demo=demo, fitted=fitted, support=support, fps=fps, world=number, refused=())


def _approach_m(demo: Demonstration) -> float:
    """Compute the path length of the end effector until the part moves, [m]."""
    hand = demo.Ts_world_ee[: demo.contact_frames[0] + 1, :3, 3]
    return float(np.linalg.norm(np.diff(hand, axis=0), axis=1).sum())


def _support(given: MotionInput, demo: Demonstration) -> SupportPlane:
    scene, labels = given.scene, given.labels
    of_object = np.isin(labels, (STATIC, MOVING))
    points: list[Array] = [surface_points(scene, labels, label) for label in (STATIC, MOVING)]
    frame = object_frame(points[0], demo.joint, points[1])
    found = find_support(scene.select(of_object), scene.select(labels == BACKGROUND), frame)
    unknown = np.full(2, np.inf)
    return SupportPlane(height=float(found.T_world_plane[2, 3]), low_xy=-unknown, high_xy=unknown)
