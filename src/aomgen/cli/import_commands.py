"""`aomgen import`: turn what a lab has recorded in other formats into parts of a capture."""

from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.scan_import import scan

import_app = typer.Typer(
    no_args_is_help=True, help="Turn scans and recordings of other formats into parts of a capture."
)
import_app.command()(scan)


@import_app.command("demo")
def import_demonstration(
    source: Annotated[
        Path, typer.Argument(help="LeRobot dataset, ROS 1 or ROS 2 bag, MCAP, CSV or RTDE recording.")
    ],
    capture: Annotated[Path, typer.Argument(help="Folder of the capture; created where it is missing.")],
    episode: Annotated[int, typer.Option(min=0, help="Number of the episode in a dataset, from 0.")] = 0,
    robot: Annotated[str, typer.Option(help="Robot of a capture that names none; ur5e_2f85 without.")] = "",
    unit: Annotated[
        str, typer.Option(help="Unit of the joints: rad, deg, or normalized (-100 .. 100).")
    ] = "",
    gripper_open: Annotated[
        float | None, typer.Option(help="Value of the gripper's column when it is open.")
    ] = None,
    gripper_closed: Annotated[float | None, typer.Option(help="The same when it is closed.")] = None,
    gripper_column: Annotated[str, typer.Option(help="Column, joint or topic of the gripper.")] = "",
    joint_map: Annotated[
        list[str] | None,
        typer.Option(help="JOINT=COLUMN, or 'left_*' for all joints with a prefix; repeat for several."),
    ] = None,
    topic: Annotated[str, typer.Option(help="Topic of the joint states of the arm.")] = "",
    camera: Annotated[
        list[str] | None,
        typer.Option(help="NAME, or NAME=SOURCE with a topic, feature or video file; repeat for several."),
    ] = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace the demonstration that the capture has.")
    ] = False,
) -> None:
    """Write one recorded episode as demo/ and the demo tables of capture.toml.

    Units, columns and cameras are recognised; where they are ambiguous, the error names the option that states them.
    """
    from aomgen.importers.import_demo import ImportOptions, import_demo

    options = ImportOptions(
        robot=robot,
        unit=unit,
        gripper_open=gripper_open,
        gripper_closed=gripper_closed,
        gripper_column=gripper_column,
        joint_map=tuple(joint_map or ()),
        topic=topic,
        cameras=tuple(camera or ()),
        replace=replace,
    )
    for sentence in import_demo(source, capture, episode, options):
        print(f"  {sentence}")
    print(f"wrote {capture / 'demo'}; next: complete {capture / 'capture.toml'}, then aomgen check {capture}")
