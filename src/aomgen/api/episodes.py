"""Verified demonstrations: planning, simulation, rendering and export."""

import hashlib
import json
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from aomgen.api.arguments import require_count
from aomgen.api.asset import Asset, asset_source
from aomgen.api.display import CallbackDisplay
from aomgen.api.run import Run, bring_up_to_date, change_project
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation
from aomgen.core.progress import Progress, silent
from aomgen.core.project import Project
from aomgen.core.verdict import Verdict
from aomgen.datasets.formats import export_dataset
from aomgen.datasets.selection import Selection
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.ledger import unit_of
from aomgen.episodes.variations import Ranges
from aomgen.errors import ConfigError
from aomgen.io.episode_folder import CommittedEpisode, list_committed, read_episode
from aomgen.io.review import leave_out_rejected
from aomgen.pipeline.runner import Stage, results_of, share_stages
from aomgen.pipeline.stages import PROJECT_FILE, STAGES, check_params, find_project
from aomgen.simulation.scene import Scene
from aomgen.simulation.verify import verify_plan

# Folder, in that of a run, for the results of `generate` without `out`.
GENERATED_FOLDER = "generated"
# Stages whose results do not depend on ranges; all calls of `generate` share them. Other assets recompute the last one.
SHARED_STAGES = ("structure", "gaussians", "alignment", "parts", "motion", "twin", "replacement")
# Interval between checks for new episodes, [s].
POLL_S = 0.2


class _Stopped(Exception):
    """The caller of `generate` has closed the iterator."""


class _EpisodesDisplay(CallbackDisplay):
    """Passes the progress to a function; `accepted` is set when all episodes in the folder belong to the request."""

    def __init__(self, callback: Progress) -> None:
        super().__init__(callback)
        self.accepted = threading.Event()

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        super().begin(stage, fresh=fresh)
        if stage.name == "episodes":
            self.accepted.set()


def generate(
    run: Run,
    assets: Sequence[Asset | str | Path] = (),
    n: int = 6,
    *,
    ranges: Ranges | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    workers: int = 0,
    progress: Progress = silent,
    **choices: Any,
) -> Iterator[CommittedEpisode]:
    """Generate verified, rendered episodes, and yield each one when it is on disk.

    The results are written to a separate run that shares the twin with `run`. After an interruption the same call
    continues; it yields finished episodes immediately. Closing the iterator stops the generation.

    Args:
        run: A run that has finished stage "twin".
        assets: Assets that replace the recorded object; if empty, the assets of `run`.
        n: Number of episodes for each asset.
        ranges: Ranges from which poses, sizes, speeds, light and cameras are sampled; None selects those of `run`.
        seed: Random seed; None selects that of `run`.
        out: Folder of the new run; None selects a folder in `run.folder` whose name depends on the arguments.
        workers: Number of processes; 0 means one for each CPU core.
        progress: Receives the completed share of a stage and a text.
        choices: Other settings of the project, for example `image_size=(256, 256)`.

    Yields:
        Episodes in the order in which they are committed. An asset has fewer than n if the allowed number of
        samples has been planned.

    Raises:
        ConfigError, AssetError: An argument is wrong; the generation has not started.
        LockedError: Another process uses the folder of the new run.
        NotEnoughEpisodesError: No sample of any asset passes verification.

    Example:
        >>> run = ag.Run.open("out")
        >>> episodes = list(ag.generate(run, [ag.Asset.make("microwave", seed=1)], n=1, image_size=(64, 64)))
        >>> episodes[0].episode.asset, episodes[0].episode.verdict["passed"]
        ('microwave-1', True)
    """
    run.require_stage("twin")
    changes: dict[str, Any] = {"poses": require_count("n", n), **choices}
    if assets:
        changes["assets"] = tuple(asset_source(asset) for asset in assets)
    if seed is not None:
        changes["seed"] = require_count("seed", seed, 0)
    if ranges is not None:
        episodes = run.project.params.get("episodes", {})
        stated = {**episodes, "ranges": _differences(ranges, Ranges())}
        changes["params"] = {**run.project.params, "episodes": stated}
    project = change_project(run.project, changes)
    check_params(project)
    home = run.folder / GENERATED_FOLDER / _request_name(project) if out is None else Path(out).resolve()
    earlier = find_project(home).poses if (home / PROJECT_FILE).is_file() else n
    # Fewer episodes than an earlier call made would delete the others.
    project = project.model_copy(update={"out": home, "poses": max(n, earlier)})
    machine = {"workers": require_count("workers", workers)} if workers else {}
    share_stages((run.results.folders[name] for name in SHARED_STAGES), home)
    return _generate(project, n, progress, machine)


def _request_name(project: Project) -> str:
    """Return a name for the arguments of `generate`; it does not depend on the number of episodes."""
    choices = project.model_dump(mode="json", exclude={"capture", "out", "poses"})
    return hashlib.sha256(json.dumps(choices, sort_keys=True).encode()).hexdigest()[:12]


def _differences(params: Any, usual: Any) -> dict[str, Any]:
    """Return the fields in which two dataclasses differ, as a project file states them."""
    changed = {}
    for item in fields(params):
        value, default = getattr(params, item.name), getattr(usual, item.name)
        if value != default:
            nested = is_dataclass(value)
            changed[item.name] = _differences(value, default) if nested else json.loads(json.dumps(value))
    return changed


def _generate(
    project: Project, wanted: int, progress: Progress, machine: Mapping[str, int]
) -> Iterator[CommittedEpisode]:
    """Run the pipeline in a thread and yield the committed episodes."""
    folder = results_of(project, STAGES).folders["episodes"]
    stopped, failures = threading.Event(), list[BaseException]()

    def notify(share: float, text: str) -> None:
        if stopped.is_set():
            raise _Stopped
        progress(share, text)

    shown = _EpisodesDisplay(notify)

    def work() -> None:
        try:
            bring_up_to_date(project, until="episodes", progress=shown, **machine)
        except _Stopped:
            pass
        except BaseException as error:
            failures.append(error)

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    made: Counter[int] = Counter()
    yielded = set[Path]()
    try:
        over = False
        while not over:
            worker.join(POLL_S)
            over = not worker.is_alive()
            # Until the pipeline accepts the folder, it may hold episodes of an earlier request.
            for path in list_committed(folder) if shown.accepted.is_set() else ():
                asset = unit_of(path.name).asset
                if path not in yielded and made[asset] < wanted:
                    made[asset] += 1
                    yielded.add(path)
                    yield read_episode(path)
            # If an earlier call requested more episodes, they are not generated now; otherwise the stage is finished.
            over = over or (wanted < project.poses and sum(made.values()) == wanted * len(project.assets))
        if failures:
            raise failures[0]
    finally:
        stopped.set()
        worker.join()


def build_scene(run: Run, fit: FittedAsset) -> Scene:
    """Build the simulated scene in which episodes of an asset are planned and verified.

    Args:
        run: A run that has finished stage "replacement".
        fit: See `fit_asset`.

    Example:
        >>> run = ag.Run.open("out")
        >>> scene = ag.build_scene(run, run.fits[0])
        >>> scene.model.nu > 6
        True
    """
    run.require_stage("replacement")
    factory = EpisodeFactory(run.results, run.results.folders["episodes"])
    return factory.build_scene(fit)


def plan(
    run: Run, fit: FittedAsset, variation: Variation, scene: Scene | None = None
) -> EpisodePlan | Rejection:
    """Plan the robot's motion for a pose of an asset.

    Args:
        run: A run that has finished stage "replacement".
        fit: See `fit_asset`.
        variation: Pose of the object relative to the recorded one, and all other variations.
        scene: Result of `build_scene`; None builds it.

    Returns:
        The plan, or a rejection with its reason; `passed` is True for a plan.

    Example:
        >>> run = ag.Run.open("out")
        >>> found = ag.plan(run, run.fits[0], ag.Variation(seed=0, index=0, x=5.0, y=0.0, yaw=0.0))
        >>> found.passed, found.reason
        (False, 'unreachable')
    """
    run.require_stage("replacement")
    factory = EpisodeFactory(run.results, run.results.folders["episodes"])
    return factory.plan_for(fit, variation, scene or factory.build_scene(fit))


def verify(plan: EpisodePlan, scene: Scene) -> Verdict | Rejection:
    """Simulate a plan in several physics settings, and check that contact alone moves the object.

    Args:
        plan: Commanded motion.
        scene: Robot, table and the plan's asset.

    Returns:
        The certificate with all margins, or a rejection with its reason; `passed` is True for a certificate.

    Example:
        >>> run = ag.Run.open("out")
        >>> fit = run.fits[0]
        >>> scene = ag.build_scene(run, fit)
        >>> made = ag.plan(run, fit, ag.Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0), scene)
        >>> verdict = ag.verify(made, scene)
        >>> verdict.passed, verdict.margin > 0
        (True, True)
    """
    found = verify_plan(plan, scene)
    return found if isinstance(found, Rejection) else found.verdict


def export(
    episodes: Run | Iterable[CommittedEpisode],
    folder: str | Path,
    format: str = "lerobot-v3",
    *,
    actions: str = "",
    media: str = "",
    size: str = "",
    val: int | None = None,
) -> Selection:
    """Write episodes as a dataset for training.

    Args:
        episodes: Episodes, or a run, whose episodes are written except for those that a person has rejected.
        folder: Folder of the dataset; an existing dataset of AOMGen is replaced.
        format: "lerobot-v3", "lerobot-v2.1", "rlds", "rlds-array-record" or "hdf5".
        actions: "joint", "ee_absolute" or "ee_delta"; if empty, the default of the format.
        media: Images of LeRobot datasets: "video" (default) or "image"; "none" or "keypoints" replace the images by the
            object's pose or its keypoints.
        size: Width and height of the images, for example "128x96"; if empty, the rendered size.
        val: Number of validation episodes; None selects the default of the format.

    Returns:
        Episodes by split, and the number of frames.

    Raises:
        ConfigError: No episodes, an unknown format or option, or a folder with other content.

    Example:
        >>> made = ag.export(ag.Run.open("out"), "dataset", "hdf5", val=1)
        >>> len(made.val)
        1
    """
    made = episodes.episodes if isinstance(episodes, Run) else list(episodes)
    if not made:
        raise ConfigError("episodes", "is empty", "generate episodes first")
    folders = [episode.folder for episode in made]
    if isinstance(episodes, Run):
        folders = leave_out_rejected(episodes.folder, folders)
    return export_dataset(
        folders, Path(folder).resolve(), format, actions=actions, media=media, size=size, val=val
    )
