"""`aomgen import`: convert scans and recordings of other formats to parts of a capture."""

from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.scan_import import scan

import_app = typer.Typer(
    no_args_is_help=True, help="Convert scans and recordings of other formats for a capture."
)
import_app.command()(scan)


@import_app.command("demo")
def import_demonstration(
    source: Annotated[
        Path,
        typer.Argument(help="LeRobot dataset, ROS 1 or ROS 2 bag, MCAP file, CSV file or RTDE recording."),
    ],
    capture: Annotated[
        Path, typer.Argument(help="Folder of the capture; it is created if it does not exist.")
    ],
    episode: Annotated[int, typer.Option(min=0, help="Number of the episode in a dataset, from 0.")] = 0,
    robot: Annotated[
        str, typer.Option(help="Robot model, for a capture that does not state one. Default: ur5e_2f85.")
    ] = "",
    unit: Annotated[
        str, typer.Option(help="Unit of the joints: rad, deg, or normalized (-100 .. 100).")
    ] = "",
    gripper_open: Annotated[
        float | None, typer.Option(help="Value of the gripper column when the gripper is open.")
    ] = None,
    gripper_closed: Annotated[
        float | None, typer.Option(help="Value of the gripper column when the gripper is closed.")
    ] = None,
    gripper_column: Annotated[
        str, typer.Option(help="Name of the column, joint or topic that measures the gripper.")
    ] = "",
    joint_map: Annotated[
        list[str] | None,
        typer.Option(
            help="Column of a joint: JOINT=COLUMN, or 'left_*' for all columns with a prefix; repeatable."
        ),
    ] = None,
    topic: Annotated[str, typer.Option(help="Topic with the joint states of the arm.")] = "",
    camera: Annotated[
        list[str] | None,
        typer.Option(
            help="Camera to import: NAME, or NAME=SOURCE with a topic, feature or video file; repeatable."
        ),
    ] = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace an existing demonstration of the capture.")
    ] = False,
) -> None:
    """Convert one recorded episode to the demonstration of a capture.

    The command writes the folder demo and the demo tables of capture.toml. Units, columns and cameras are detected.
    If one is ambiguous, the error names the option that states it.
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
