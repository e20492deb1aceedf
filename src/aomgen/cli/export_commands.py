"""`aomgen export` and `aomgen audit`: datasets of the episodes, and files of the twin for other programs."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from aomgen.cli.run import RunFolder
from aomgen.errors import ConfigError, CorruptArtifactError, MissingFileError

# Number of differences that `aomgen audit` prints.
SHOWN_FAULTS = 10
DATASET_FORMATS = "lerobot-v3, lerobot-v2.1, rlds, rlds-array-record or hdf5"
IMAGES = "images"
IMAGES_SIZE = "256x256"


def export(
    out: RunFolder,
    target: Annotated[
        Path,
        typer.Argument(
            help="File of the twin: .usda, .usdc, .usdz, .xml (MJCF), .ply, .splat, .spz, .glb, .rrd or .mcap. With --format: "
            "folder of the dataset; an existing dataset of AOMGen is replaced."
        ),
    ],
    format: Annotated[
        str,
        typer.Option(
            help=f"Format of a dataset of episodes: {DATASET_FORMATS}; or images: labelled images of random objects."
        ),
    ] = "",
    actions: Annotated[
        str,
        typer.Option(
            help="Action space: joint, ee_absolute or ee_delta. Default: ee_delta for rlds, otherwise joint."
        ),
    ] = "",
    media: Annotated[
        str,
        typer.Option(
            help="Images of LeRobot datasets: video (default) or image (PNG); or none or keypoints: the "
            "object's pose or its keypoints instead of images."
        ),
    ] = "",
    size: Annotated[
        str,
        typer.Option(help=f"Image size WxH, [px]. Default: as rendered; {IMAGES_SIZE} for --format images."),
    ] = "",
    val: Annotated[
        int | None,
        typer.Option(
            min=0, help="Number of validation episodes. Default: a tenth for rlds and hdf5, none for LeRobot."
        ),
    ] = None,
    shard: Annotated[
        str,
        typer.Option(
            help="Write part i of n (for example 2/8): episodes i, i+n, i+2n and so on. The part is a folder inside the "
            "target. A part that is already complete is not written again."
        ),
    ] = "",
    episode: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="File of the twin: number of the episode to write. Default: the recorded demonstration.",
        ),
    ] = None,
    joint: Annotated[
        float | None, typer.Option(help="File of Gaussians: value of the object's joint, [rad] or [m].")
    ] = None,
    time_s: Annotated[
        float | None, typer.Option("--time", help="File of Gaussians: time in the motion, [s].")
    ] = None,
    n: Annotated[int | None, typer.Option("--n", min=1, help="Labelled images: their number.")] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Labelled images: random seed of objects and scenes. Default: 0."),
    ] = None,
    per_object: Annotated[
        int | None,
        typer.Option(min=1, help="Labelled images: number for each object, in one shard. Default: 100."),
    ] = None,
    categories: Annotated[
        list[str] | None,
        typer.Option(
            "--category",
            help="Labelled images: category of parametric objects; repeatable. Default: those of the run.",
        ),
    ] = None,
    assets: Annotated[
        list[str] | None,
        typer.Option(
            "--asset",
            help="Labelled images: category:seed or a USD file; alternates with the objects of --category; repeatable.",
        ),
    ] = None,
    styles: Annotated[
        list[str] | None,
        typer.Option(
            "--style", help="Labelled images: style of parametric objects; repeatable. Default: all styles."
        ),
    ] = None,
    workers: Annotated[
        int, typer.Option(min=0, help="Labelled images: number of processes; 0 means one for each CPU core.")
    ] = 0,
    ray: Annotated[
        str,
        typer.Option(
            help="Labelled images: address of a Ray cluster that shares these folders: auto or HOST:PORT."
        ),
    ] = "",
) -> None:
    """Write the twin, a dataset of the episodes, or labelled images.

    Without --format, the command writes the twin as a file for other programs, in the format of the target's suffix.
    With --format and the name of a dataset format, it writes the committed episodes as a dataset; episodes that a
    person has rejected in `aomgen view` are left out. With --format images, it renders labelled images of random
    objects; these are neither planned nor simulated.
    """
    from aomgen.exports.formats import TWIN_SUFFIXES, export_twin
    from aomgen.pipeline.runner import results_of
    from aomgen.pipeline.stages import STAGES, find_project

    episodes = {"--actions": actions, "--media": media, "--val": val, "--shard": shard}
    dataset = {"--format": format, "--size": size, **episodes}
    twin = {"--episode": episode, "--joint": joint, "--time": time_s}
    request = {"--n": n, "--seed": seed, "--per-object": per_object, "--category": categories}
    request |= {"--asset": assets, "--style": styles, "--workers": workers or None, "--ray": ray}
    if format != IMAGES:
        _refuse_options(request, "has no meaning without --format images", "it is for labelled images")
    if target.suffix.lower() in TWIN_SUFFIXES:
        _refuse_options(dataset, f"has no meaning for {target.suffix}", "it is for a dataset")
        results = results_of(find_project(out), STAGES)
        print(f"wrote {target}: {export_twin(results, target, episode=episode, joint=joint, time_s=time_s)}")
        return
    if not format:
        problem = f"has suffix '{target.suffix}'" if target.suffix else "has no suffix of a file"
        remedy = f"known: {', '.join(TWIN_SUFFIXES)}; or name a dataset's --format: {DATASET_FORMATS}, images"
        raise ConfigError(target, problem, remedy)
    _refuse_options(twin, "has no meaning for a dataset", "it is for a file of the twin")
    if format == IMAGES:
        _refuse_options(episodes, "has no meaning for --format images", "it is for a dataset of episodes")
        choices = {"images": n, "seed": seed or 0, "per_object": per_object}
        named = {"categories": categories, "assets": assets, "styles": styles}
        choices |= {name: tuple(values or ()) for name, values in named.items()}
        _export_images(out, target.resolve(), size or IMAGES_SIZE, choices, workers, ray)
        return
    from aomgen.datasets.formats import export_dataset, export_shard
    from aomgen.datasets.selection import shard_name

    options = {"actions": actions, "media": media, "size": size, "val": val}
    if shard:
        made = export_shard(_episodes(out), target.resolve(), format, shard, **options)
        target = target / shard_name(shard)
    else:
        made = export_dataset(_episodes(out), target.resolve(), format, **options)
    if made is None:
        print(f"kept {target}: it is complete")
        return
    print(
        f"wrote {target}: {len(made.train)} training and {len(made.val)} validation episodes, {made.frames} frames"
    )


def _export_images(
    out: Path, target: Path, size: str, choices: Mapping[str, Any], workers: int, ray: str
) -> None:
    from aomgen.datasets.selection import parse_size
    from aomgen.exports.image_dataset import ImageSetRequest, export_images
    from aomgen.pipeline.runner import results_of
    from aomgen.pipeline.stages import STAGES, find_project
    from aomgen.ray_cluster import require_cluster

    if choices["images"] is None:
        raise ConfigError("--n", "is missing", "state the number of images")
    given = {name: value for name, value in choices.items() if value is not None}
    request = ImageSetRequest(size=parse_size(size), **given)
    if ray:
        require_cluster(ray)
    results = results_of(find_project(out), STAGES)
    results = replace(results, ray=ray, workers=workers or results.workers)
    objects = export_images(
        results, target, request, lambda share, text: print(f"  {share:4.0%} {text}", flush=True)
    )
    names = {item["asset"] for item in objects}
    print(f"wrote {target}: {request.images} images of {len(names)} objects in {request.shards} shards")


def _refuse_options(given: Mapping[str, object], problem: str, remedy: str) -> None:
    """Refuse the first option that was given."""
    for option, value in given.items():
        if value not in (None, ""):
            raise ConfigError(option, problem, f"{remedy}; leave it out")


def audit(
    dataset: Annotated[Path, typer.Argument(help="Folder of a dataset, in any format of `aomgen export`.")],
    out: RunFolder,
    shard: Annotated[str, typer.Option(help="Compare with this part of the episodes, see `export`.")] = "",
) -> None:
    """Compare a dataset with the episodes of a run.

    Episodes that a person has rejected in `aomgen view` are excluded.
    """
    from aomgen.datasets.audit import audit_dataset
    from aomgen.datasets.selection import choose_shard

    episodes = _episodes(out)
    found = audit_dataset(dataset, choose_shard(episodes, shard) if shard else episodes)
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
    """List the folders of a run's committed episodes, without the rejected ones."""
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
