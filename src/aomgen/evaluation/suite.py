"""Suites of trials as JSON files, so that every policy is evaluated in the same trials."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.plan import Variation
from aomgen.core.transforms import rotvec_from_matrix
from aomgen.core.values import Array, freeze_arrays
from aomgen.core.verdict import Setting
from aomgen.datasets.features import ActionSpace
from aomgen.episodes.variations import scale_fit
from aomgen.errors import ConfigError, MalformedFileError
from aomgen.io.artifact import load_artifact, read_json, save_artifact
from aomgen.io.episode_folder import EPISODE_FILE, list_committed
from aomgen.pipeline.manifest import files_digest
from aomgen.pipeline.project_file import read_project
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import PROJECT_FILE, STAGES
from aomgen.results import Results
from aomgen.robots.robot import RobotModel

# Poses whose distances are below both values are regarded as equal, [mm] and [deg].
APART_MM, APART_DEG = 5.0, 1.0
# Largest time to sample or to simulate one trial, [s].
TRIAL_S: Final = 1200.0
REMEDY: Final = "make it with `aomgen evaluate suite`"


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One trial.

    Attributes:
        asset: Index of the object in the assets of the suite.
        variation: Pose and size of the object, and all other differences from the recording.
        setting: Physics setting of the object.
        joints: Initial arm joints (J,), [rad] or [m].
        gripper: Initial gripper position, 0 open .. 1 closed.
    """

    asset: int
    variation: Variation
    setting: Setting
    joints: Annotated[Array, "_"]
    gripper: float

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseDistance:
    """Distance between two poses of an object."""

    mm: float
    deg: float

    @property
    def apart(self) -> float:
        """Normalized distance; poses below 1 are regarded as equal."""
        return max(self.mm / APART_MM, self.deg / APART_DEG)


@dataclass(frozen=True, slots=True, kw_only=True)
class Suite:
    """Trials in the twin of a run.

    Attributes:
        run: Folder of the run, relative to the folder of the suite.
        twin: Digest of the twin, see `twin_digest`.
        task: Language instruction.
        assets: Names of the objects.
        joint_names: Names of the arm joints.
        fps: Actions per second.
        action_space: Meaning of actions, see `datasets.features`.
        cameras: Cameras by name, with the size of the images. The pose of a camera on the robot is relative to its
            body.
        drawn_size: Rendered size of images of fixed cameras, before they are reduced by area averaging, [px].
        max_frames: Largest number of actions in a trial.
        seed: Random seed.
        redrawn: Number of skipped samples by reason.
        nearest: Smallest distance between a trial and a committed episode; None without episodes.
        digest: SHA-256 of all other fields.
    """

    run: str
    twin: str
    task: str
    assets: tuple[str, ...]
    joint_names: tuple[str, ...]
    fps: int
    action_space: ActionSpace
    cameras: Mapping[str, Camera]
    drawn_size: tuple[int, int]
    max_frames: int
    seed: int
    trials: tuple[Trial, ...]
    redrawn: Mapping[str, int]
    nearest: PoseDistance | None
    digest: str = ""

    @property
    def action_size(self) -> int:
        """Number of elements of an action; the last one is the gripper."""
        return {"joint": len(self.joint_names), "ee_absolute": 7, "ee_delta": 6}[self.action_space] + 1

    def seal(self) -> "Suite":
        """Return the suite with its digest."""
        content = asdict(replace(self, digest=""))
        text = json.dumps(content, sort_keys=True, allow_nan=False, default=_plain)
        return replace(self, digest=hashlib.sha256(text.encode()).hexdigest())


def _plain(value: Any) -> Any:
    return value.tolist()


def fixed_cameras(cameras: Mapping[str, Camera], robot: RobotModel) -> dict[str, Camera]:
    """Select the cameras that are not mounted on the robot."""
    return {name: camera for name, camera in cameras.items() if name not in robot.cameras}


def write_suite(path: Path, suite: Suite) -> None:
    """Write a suite, whose `run` is relative to the current folder.

    Raises:
        ConfigError: The file's name does not end in .json.
        StorageError: The file cannot be written.
    """
    require_json(path)
    save_artifact(path.parent, path.stem, suite)


def require_json(path: Path) -> None:
    """Refuse an invalid name of a suite.

    Raises:
        ConfigError: The name does not end in .json.
    """
    if path.suffix != ".json":
        raise ConfigError(path, "is not a valid name of a suite", "expected one that ends in .json")


def read_suite(path: Path) -> Suite:
    """Read a suite.

    Raises:
        MissingFileError, LimitExceededError: The file is missing or too large.
        ConfigError, MalformedFileError: The file is not a suite, is empty, or was modified.
    """
    require_json(path)
    suite = load_artifact(path.parent, path.stem, Suite)
    if suite.seal().digest != suite.digest:
        raise MalformedFileError(path, "does not match its digest", REMEDY)
    if not suite.trials:
        raise MalformedFileError(path, "holds no trial", REMEDY)
    return suite


def open_suite(path: Path) -> tuple[Suite, Results]:
    """Open a suite and its run.

    Raises:
        MissingFileError: The run does not exist.
        ConfigError: The run has another twin.
        AomgenError: See `read_suite`.
    """
    suite = read_suite(path)
    results = open_results((path.parent / suite.run).resolve())
    require_twin(path, suite, results)
    return suite, results


def open_results(run: Path) -> Results:
    """Open the results of a run, whose folder may have been moved.

    Raises:
        MissingFileError: The run does not exist.
        ConfigError: Its project file is not valid.
    """
    project = read_project(run / PROJECT_FILE)
    return results_of(project.model_copy(update={"out": run.resolve()}), STAGES)


def require_twin(path: Path, suite: Suite, results: Results) -> None:
    """Refuse a suite whose trials were sampled for another twin.

    Raises:
        ConfigError: The run has another twin.
    """
    have = twin_digest(results)
    if have != suite.twin:
        raise ConfigError(
            path, f"belongs to the twin {suite.twin[:12]}, {results.out} has {have[:12]}", f"{REMEDY} again"
        )


def twin_digest(results: Results) -> str:
    """Compute the digest of scene, objects and their twins.

    Raises:
        MissingFileError: The run has not finished the required stages.
    """
    folder = results.folders["replacement"]
    names = ("twin.json", "twin.npz", "fitted.json", "fitted.npz")
    homes = [results.asset_folder(number) for number in range(len(results.fitted_assets))]
    return files_digest(
        [folder / "scene.json", *(home / name for home in homes for name in names if (home / name).is_file())]
    )


def training_poses(results: Results) -> dict[str, Array]:
    """Return the object pose (4, 4) of every committed episode of a run, by the name of its folder."""
    folders = list_committed(results.folders["episodes"])
    return {path.name: np.array(read_json(path / EPISODE_FILE)["T_world_object"]) for path in folders}


def nearest_pose(T_world_object: Array, poses: Mapping[str, Array]) -> tuple[PoseDistance, str] | None:
    """Find the nearest of some poses (4, 4); return distance and name, or None without poses."""
    if not poses:
        return None
    Ts = np.stack(list(poses.values()))
    mm = 1000 * np.linalg.norm(Ts[:, :3, 3] - T_world_object[:3, 3], axis=1)
    deg = np.rad2deg(np.linalg.norm(rotvec_from_matrix(Ts[:, :3, :3] @ T_world_object[:3, :3].T), axis=1))
    found = int(np.argmin(np.maximum(mm / APART_MM, deg / APART_DEG)))
    return PoseDistance(mm=float(mm[found]), deg=float(deg[found])), list(poses)[found]


def require_apart(suite: Suite, results: Results) -> PoseDistance | None:
    """Compute the smallest distance between trials and committed episodes, and refuse equal poses.

    Raises:
        ConfigError: The pose of a trial is that of an episode.
    """
    poses, smallest = training_poses(results), None
    for number, trial in enumerate(suite.trials):
        fitted = results.fitted_assets[trial.asset]
        found = nearest_pose(trial.variation.place_at(scale_fit(fitted, trial.variation.scale)), poses)
        if found is None:
            return None
        distance, name = found
        if not distance.apart >= 1:
            raise ConfigError(
                f"trial {number} of the suite",
                f"is {distance.mm:.1f} mm and {distance.deg:.2f} deg from episode {name} of the training, "
                f"expected at least {APART_MM:g} mm or {APART_DEG:g} deg",
                f"{REMEDY} and another --seed",
            )
        smallest = distance if smallest is None or distance.apart < smallest.apart else smallest
    return smallest
