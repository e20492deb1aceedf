"""`aomgen export` and `aomgen audit`: datasets of a run's episodes in other formats."""

from pathlib import Path
from typing import Annotated

import typer

from aomgen.errors import CorruptArtifactError, MissingFileError

RunFolder = Annotated[Path, typer.Argument(help="Folder of a run, or its project file.")]
# How many of the differences are printed.
SHOWN_FAULTS = 10


def export(
    out: RunFolder,
    folder: Annotated[Path, typer.Argument(help="Dataset to write; replaced if it is one of ours.")],
    format: Annotated[str, typer.Option(help="lerobot-v3, lerobot-v2.1, rlds, rlds-array-record or hdf5.")],
    actions: Annotated[
        str,
        typer.Option(help="Space of the actions: joint, ee_absolute or ee_delta; rlds has ee_delta without."),
    ] = "",
    media: Annotated[
        str, typer.Option(help="LeRobot's pictures: video, image (PNG), or none: the object's pose instead.")
    ] = "",
    size: Annotated[str, typer.Option(help="WxH of the pictures, [px]; as rendered without.")] = "",
    val: Annotated[
        int | None,
        typer.Option(
            min=0, help="Episodes to validate on; without: a tenth for rlds and hdf5, none for LeRobot."
        ),
    ] = None,
) -> None:
    """Write the committed episodes of a run as a dataset."""
    from aomgen.datasets.formats import export_dataset

    made = export_dataset(
        _episodes(out), folder.resolve(), format, actions=actions, media=media, size=size, val=val
    )
    print(f"wrote {folder}: {len(made.train)} + {len(made.val)} episodes, {made.frames} frames")


def audit(
    dataset: Annotated[Path, typer.Argument(help="Folder of a dataset, in any format of `aomgen export`.")],
    out: RunFolder,
) -> None:
    """Compare a dataset with the committed episodes of a run."""
    from aomgen.datasets.audit import audit_dataset

    found = audit_dataset(dataset, _episodes(out))
    splits = " + ".join(f"{count} {name}" for name, count in found.splits.items())
    print(f"episodes  {splits} of {found.committed}, {found.frames} frames, actions {found.actions}")
    print(f"numbers   largest difference {found.difference:.1e} ({found.differing})")
    print(f"pictures  lowest PSNR {found.psnr_db:.1f} dB ({found.least_like})")
    for fault in found.faults[:SHOWN_FAULTS]:
        print(f"fault     {fault}")
    if found.faults:
        raise CorruptArtifactError(
            dataset, f"differs from the episodes in {len(found.faults)} ways", "export it again"
        )


def _episodes(out: Path) -> list[Path]:
    """Folders of a run's committed episodes."""
    from aomgen.io.episode_folder import list_committed
    from aomgen.pipeline.stages import STAGES, find_project

    project = find_project(out)
    folder = project.out / next(stage.folder for stage in STAGES if stage.name == "episodes")
    found = list_committed(folder)
    if not found:
        raise MissingFileError(folder, "holds no committed episode", "run the project first")
    return found
