"""`aomgen assets`: articulated objects made, brought from other formats, and examined."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from aomgen.errors import AssetError

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
) -> None:
    """Turn a model of another format into a USD asset: closed, upright, with colliders and a handle, named as its file.

    What it then lacks to be opened is said, as by `aomgen assets check`.
    """
    from aomgen.assets.doctor import examine
    from aomgen.assets.import_model import import_model
    from aomgen.assets.usd_write import write_usd

    imported = import_model(model, joint=joint, joints_file=joints, scale=scale, category=category)
    # Two of one model, or of one name, can be in one project.
    asset = replace(imported, name=path.stem)
    write_usd(asset, path)
    print(path)
    for finding in examine(asset):
        if finding.problem or finding.warning:
            print(f"  {finding.name}: {finding.problem or finding.warning}")


@assets_app.command("check")
def assets_check(
    asset: Annotated[str, typer.Argument(help="A USD file, FILE#JOINT, or category:seed.")],
    run: Annotated[
        Path | None, typer.Option("--for", help="Run whose recorded object it shall replace.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all findings as JSON.")] = False,
) -> None:
    """Examine an asset: joint, size, handle, room for a finger, colliders, mass, textures; whether it fits a run.

    Ends with exit code 3 where it cannot be used.
    """
    from aomgen.assets.choice import load_asset
    from aomgen.assets.doctor import examine

    loaded = load_asset(asset)
    findings = examine(loaded)
    if run is not None:
        from aomgen.cli.run import find_project
        from aomgen.pipeline.runner import results_of
        from aomgen.pipeline.stages import STAGES
        from aomgen.replacement.stage import examine_fit

        findings.append(examine_fit(results_of(find_project(run), STAGES), loaded))
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
