"""`aomgen assets`: articulated objects made, brought from other formats, and examined."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aomgen.errors import AssetError, SeveralJointsError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from aomgen.assets.doctor import Finding
    from aomgen.core.asset import ArticulatedAsset

assets_app = typer.Typer(no_args_is_help=True, help="Make, import and check articulated assets (USD).")
JointName = Annotated[str, typer.Option(help="Which of several joints opens; the others stay as drawn.")]


@assets_app.command("make")
def assets_make(
    category: Annotated[str, typer.Argument(help="cabinet, drawer, laptop, microwave or toolbox.")],
    path: Annotated[Path, typer.Argument(help="USD file to write, for example microwave.usda.")],
    seed: Annotated[
        int, typer.Option(min=0, help="Same seed, same asset; each next seed, the next style.")
    ] = 0,
    style: Annotated[
        str, typer.Option(help="For example classic; the seed's without, see docs/assets.md.")
    ] = "",
) -> None:
    """Make a textured, hollow, articulated asset with colliders and a joint, as USD.

    Styles differ in proportions, feet, handle and outline; they follow from the seed in turn.
    """
    from aomgen.assets.choice import make_asset
    from aomgen.assets.usd_write import write_usd

    write_usd(make_asset(category, seed, style), path)
    print(path)


@assets_app.command("import")
def assets_import(
    model: Annotated[Path, typer.Argument(help="URDF, MJCF, OBJ, or USD with several joints.")],
    path: Annotated[Path, typer.Argument(help="USD file to write, for example fridge.usda.")],
    joint: JointName = "",
    joints: Annotated[
        Path | None,
        typer.Option(help="JSON that says which groups of an OBJ move; articulation.json above it without."),
    ] = None,
    scale: Annotated[float, typer.Option(min=1e-4, help="2 makes a half-size model life-size.")] = 1.0,
    category: Annotated[str, typer.Option(help="For example microwave; as the file says without.")] = "",
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Limits of the joint in place of the file's, in rad or m from the drawn pose."),
    ] = None,
    handle: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(help="Corners X0 Y0 Z0 X1 Y1 Z1 of a box around the handle as drawn, in m, Z up."),
    ] = None,
) -> None:
    """Turn a model of another format into a USD asset: closed, upright, with colliders and a handle, named as its file.

    What was assumed, and what it lacks to be opened, is printed as by `aomgen assets check`. A file with several
    joints needs --joint; `aomgen assets check FILE` lists them.
    """
    from aomgen.assets.doctor import examine
    from aomgen.assets.import_model import import_model
    from aomgen.assets.usd_write import write_usd

    imported = import_model(
        model,
        joint=joint,
        joints_file=joints,
        scale=scale,
        category=category,
        limits=limits or (),
        handle=handle or (),
    )
    # Two of one model, or of one name, can be in one project.
    asset = replace(imported, name=path.stem)
    write_usd(asset, path)
    print(path)
    for finding in examine(asset):
        if finding.problem or finding.warning:
            print(f"  {finding.name}: {finding.problem or finding.warning}")


def _load(spec: str) -> "ArticulatedAsset":
    from aomgen.assets.choice import load_asset
    from aomgen.assets.import_model import SUFFIXES, import_model

    file, _, joint = spec.partition("#")
    if Path(file).suffix.lower() in SUFFIXES:
        return import_model(Path(file), joint=joint)
    return load_asset(spec)


def _fit_to(run: Path | None) -> "Callable[[ArticulatedAsset], Finding] | None":
    """Function that reports whether an asset fits a run; None without a run."""
    if run is None:
        return None
    from aomgen.pipeline.runner import results_of
    from aomgen.pipeline.stages import STAGES, find_project
    from aomgen.replacement.stage import examine_fit

    results = results_of(find_project(run), STAGES)
    return lambda asset: examine_fit(results, asset)


def _list_joints(
    file: str, joints: "Sequence[str]", fit: "Callable[[ArticulatedAsset], Finding] | None"
) -> None:
    """Print a line for each joint of a file, and which of them fits a run."""
    from aomgen.assets.doctor import examine

    fitting = []
    for joint in joints:
        try:
            asset = _load(f"{file}#{joint}")
        except AssetError as error:
            print(f"{joint:28} {error.problem}")
            continue
        findings = {item.name: item for item in examine(asset)}
        problem = findings["use"].problem
        words = [findings["joint"].state, findings["size"].state, problem or findings["handle"].state]
        if fit is not None and not problem:
            found = fit(asset)
            words.append(found.problem or found.state)
            fitting += [] if found.problem else [joint]
        print(f"{joint:28} {'; '.join(words)}")
    if fitting:
        print(f"fits the recording: {file}#{fitting[0]}")


@assets_app.command("check")
def assets_check(
    asset: Annotated[
        str, typer.Argument(help="A USD, URDF, MJCF or OBJ file, FILE#JOINT, or category:seed.")
    ],
    run: Annotated[
        Path | None, typer.Option("--for", help="Run whose recorded object it shall replace.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all findings as JSON.")] = False,
) -> None:
    """Examine an asset: joint, size, handle, room for a finger, colliders, mass, textures; whether it fits a run.

    A file with several joints, of which none is named, is examined for each, and the joints are listed; with
    --for, the one that fits the recording best is suggested. Ends with exit code 3 where it cannot be used.
    """
    from aomgen.assets.doctor import examine

    fit = _fit_to(run)
    try:
        loaded = _load(asset)
    except SeveralJointsError as error:
        _list_joints(asset, error.joints, fit)
        raise
    findings = examine(loaded)
    if fit is not None:
        findings.append(fit(loaded))
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=1))
    else:
        for item in findings:
            words = filter(None, [item.state, item.problem, item.warning and f"warning: {item.warning}"])
            print(f"{item.name:22} {'; '.join(words)}")
    problems = [finding.problem for finding in findings if finding.problem]
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise AssetError(loaded.name, problems[0] + more, "correct the asset or choose another one")
