"""`aomgen assets` and `aomgen robot`: make, import and check articulated objects; describe a user's arm."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aomgen.errors import AssetError, ConfigError, SeveralJointsError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from aomgen.assets.doctor import Finding
    from aomgen.core.asset import ArticulatedAsset

assets_app = typer.Typer(no_args_is_help=True, help="Make, import and check articulated assets (USD).")
JointName = Annotated[
    str,
    typer.Option(help="Joint that opens, if the file has several; the others keep their pose in the file."),
]
robot_app = typer.Typer(no_args_is_help=True, help="Describe another robot arm (robot.toml).")
Values = list[str] | None


@assets_app.command("make")
def assets_make(
    category: Annotated[
        str,
        typer.Argument(
            help="Category: cabinet, drawer, laptop, microwave or toolbox; or dresser, for a drawer with several fronts."
        ),
    ],
    path: Annotated[Path, typer.Argument(help="USD file to write, for example microwave.usda.")],
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            help="Random seed; the same seed gives the same asset, consecutive seeds have different styles.",
        ),
    ] = 0,
    style: Annotated[
        str,
        typer.Option(
            help="Style, for example classic (docs/assets.md lists them). Default: that of the seed."
        ),
    ] = "",
) -> None:
    """Make a parametric articulated asset and write it as USD.

    The asset is hollow and has textures, colliders and a joint. Styles differ in proportions, feet, handle and
    outline. Consecutive seeds select them cyclically.
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
        typer.Option(
            help="JSON file with the joints of an OBJ. Default: articulation.json in its folder or a folder above."
        ),
    ] = None,
    scale: Annotated[
        float, typer.Option(min=1e-4, help="Scale factor, for example 2 for a model of half the real size.")
    ] = 1.0,
    category: Annotated[
        str, typer.Option(help="Category, for example microwave. Default: the one in the file.")
    ] = "",
    limits: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Lower and upper joint limit, from the pose in the file, [rad] or [m]. Default: as in the file."
        ),
    ] = None,
    handle: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            help="Corners X0 Y0 Z0 X1 Y1 Z1 of a box around the handle, in the pose of the file [m], Z up."
        ),
    ] = None,
) -> None:
    """Convert a model of another format to a USD asset.

    The asset is closed and upright and has colliders and a handle. The command prints its assumptions and the
    problems of the asset, as `aomgen assets check` does. A file with several joints needs --joint; `aomgen assets
    check FILE` lists the joints. The asset is named like its USD file.
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
    # The file name distinguishes assets of one model within a project.
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
    """Return a function that checks whether an asset fits a run; None without a run."""
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
        Path | None, typer.Option("--for", help="Run whose recorded object the asset is to replace.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all findings as JSON.")] = False,
) -> None:
    """Check whether an asset can be simulated and grasped.

    The command reports joint, size, handle, finger clearance, colliders, mass and textures. If a file has several
    joints and none is named, each joint is checked and listed. With --for, the command also reports whether the asset
    fits the recorded motion of a run, and names the first joint that does. An asset that cannot be used gives exit
    code 3.
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


@robot_app.command()
def propose(
    file: Annotated[Path, typer.Argument(help="URDF (xacro expanded) or MJCF of the arm with its gripper.")],
    joint: Annotated[
        Values,
        typer.Option(help="Arm joint; repeat in the order of the joint log. Default: all up to the fingers."),
    ] = None,
    opened: Annotated[
        Values,
        typer.Option(
            "--open",
            help="Value of a finger joint with the gripper open: NAME=VALUE [rad] or [m]; repeatable.",
        ),
    ] = None,
    closed: Annotated[Values, typer.Option(help="The same with the gripper closed.")] = None,
    finger: Annotated[
        Values, typer.Option(help="Body of a fingertip; give the left one, then the right one.")
    ] = None,
    root: Annotated[
        Path | None, typer.Option(help="Folder that contains all meshes. Default: the folder of FILE.")
    ] = None,
) -> None:
    """Draft the robot.toml of a robot model.

    This file describes the arm joints, the gripper and the end effector. The draft is a guess from joints and shapes:
    the arm ends where the fingers branch, the gripper is closed where two of its bodies are nearest, the pads are the
    faces that meet there, and the end effector is between them. Read every line, correct errors, and compare the
    printed sizes with the real ones. `aomgen check CAPTURE` then loads the robot as robot.toml describes it.

    If the model is not sufficient, the error states the missing values. These are usually the values
    of the finger joints: `--open left_joint=0 --closed left_joint=0.8`.
    """
    from aomgen.io.atomic import write_text
    from aomgen.robots.description import FILE_NAME, description_toml
    from aomgen.robots.loading import load_robot
    from aomgen.robots.propose import describe_sizes, propose_description

    path = file.parent / FILE_NAME
    if path.exists():
        raise ConfigError(path, "exists already", "move it to another folder, or edit it")
    if len(finger or []) not in (0, 2):
        raise ConfigError(
            "--finger", f"is given {len(finger or [])} times", "name the left and the right body"
        )
    draft = propose_description(
        file,
        root or file.parent,
        joint or (),
        opened=_values(opened),
        closed=_values(closed),
        fingers=finger or (),
    )
    write_text(path, description_toml(draft))
    print(f"wrote {path}; read it and correct it\n{describe_sizes(load_robot(file, root=root))}")


def _values(words: list[str] | None) -> dict[str, float]:
    """Parse NAME=VALUE arguments."""
    result = {}
    for word in words or []:
        name, _, value = word.rpartition("=")
        try:
            result[name] = float(value)
        except ValueError as error:
            raise ConfigError("--open, --closed", f"'{word}' is not NAME=VALUE", "as in joint=0.8") from error
    return result
