"""`aomgen export` and `aomgen audit`: datasets of the episodes, and files of the twin for other programs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.run import RunFolder
from aomgen.errors import ConfigError, CorruptArtifactError, MissingFileError

# Number of differences that `aomgen audit` prints.
SHOWN_FAULTS = 10
DATASET_FORMATS = "lerobot-v3, lerobot-v2.1, rlds, rlds-array-record or hdf5"


def export(
    out: RunFolder,
    target: Annotated[
        Path,
        typer.Argument(
            help="A file of the twin: .usda, .usdc, .usdz, .xml (MJCF), .ply, .splat, .spz, .glb, .rrd or .mcap; or "
            "with --format the folder of a dataset, replaced if it is one of ours."
        ),
    ],
    format: Annotated[str, typer.Option(help=f"Of a dataset: {DATASET_FORMATS}.")] = "",
    actions: Annotated[
        str,
        typer.Option(help="Space of the actions: joint, ee_absolute or ee_delta; rlds has ee_delta without."),
    ] = "",
    media: Annotated[
        str, typer.Option(help="LeRobot's images: video, image (PNG), or none: the object's pose instead.")
    ] = "",
    size: Annotated[str, typer.Option(help="WxH of the images, [px]; as rendered without.")] = "",
    val: Annotated[
        int | None,
        typer.Option(
            min=0, help="Episodes to validate on; without: a tenth for rlds and hdf5, none for LeRobot."
        ),
    ] = None,
    episode: Annotated[
        int | None,
        typer.Option(min=0, help="Of a file: number of an episode; without, the recorded demonstration."),
    ] = None,
    joint: Annotated[
        float | None, typer.Option(help="Of a file of Gaussians: value of the object's joint, [rad] or [m].")
    ] = None,
    time_s: Annotated[
        float | None, typer.Option("--time", help="Of a file of Gaussians: time of the motion, [s].")
    ] = None,
) -> None:
    """Write the twin as a file for other programs, or the committed episodes that no person rejected as a dataset."""
    from aomgen.exports.formats import TWIN_SUFFIXES, export_twin
    from aomgen.pipeline.runner import results_of
    from aomgen.pipeline.stages import STAGES, find_project

    dataset = {"--format": format, "--actions": actions, "--media": media, "--size": size, "--val": val}
    twin = {"--episode": episode, "--joint": joint, "--time": time_s}
    if target.suffix.lower() in TWIN_SUFFIXES:
        _refuse_options(dataset, f"has no meaning for {target.suffix}", "it is for a dataset")
        results = results_of(find_project(out), STAGES)
        print(f"wrote {target}: {export_twin(results, target, episode=episode, joint=joint, time_s=time_s)}")
        return
    if not format:
        problem = f"has suffix '{target.suffix}'" if target.suffix else "has no suffix of a file"
        remedy = f"known: {', '.join(TWIN_SUFFIXES)}; or name a dataset's --format: {DATASET_FORMATS}"
        raise ConfigError(target, problem, remedy)
    _refuse_options(twin, "has no meaning for a dataset", "it is for a file of the twin")
    from aomgen.datasets.formats import export_dataset

    made = export_dataset(
        _episodes(out), target.resolve(), format, actions=actions, media=media, size=size, val=val
    )
    print(f"wrote {target}: {len(made.train)} + {len(made.val)} episodes, {made.frames} frames")


def _refuse_options(given: Mapping[str, object], problem: str, remedy: str) -> None:
    """Refuse the first option that was given."""
    for option, value in given.items():
        if value not in (None, ""):
            raise ConfigError(option, problem, f"{remedy}; leave it out")


def audit(
    dataset: Annotated[Path, typer.Argument(help="Folder of a dataset, in any format of `aomgen export`.")],
    out: RunFolder,
) -> None:
    """Compare a dataset with the committed episodes of a run that no person has rejected."""
    from aomgen.datasets.audit import audit_dataset

    found = audit_dataset(dataset, _episodes(out))
    splits = " + ".join(f"{count} {name}" for name, count in found.splits.items())
    print(f"episodes  {splits} of {found.committed}, {found.frames} frames, actions {found.actions}")
    print(f"numbers   largest difference {found.difference:.1e} ({found.differing})")
    print(f"images    lowest PSNR {found.psnr_db:.1f} dB ({found.least_like})")
    for fault in found.faults[:SHOWN_FAULTS]:
        print(f"fault     {fault}")
    if found.faults:
        raise CorruptArtifactError(
            dataset, f"differs from the episodes in {len(found.faults)} ways", "export it again"
        )


def _episodes(out: Path) -> list[Path]:
    """Folders of a run's committed episodes, without the rejected ones."""
    from aomgen.io.episode_folder import list_committed
    from aomgen.io.review import REVIEW_FILE, leave_out_rejected
    from aomgen.pipeline.stages import STAGES, find_project

    project = find_project(out)
    folder = project.out / next(stage.folder for stage in STAGES if stage.name == "episodes")
    found = list_committed(folder)
    if not found:
        raise MissingFileError(folder, "holds no committed episode", "run the project first")
    kept = leave_out_rejected(project.out, found)
    if len(kept) < len(found):
        print(f"left out {len(found) - len(kept)} of {len(found)} episodes: {REVIEW_FILE} rejects them")
    return kept
