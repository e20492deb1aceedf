"""`aomgen prompts`: mark robot and object parts in a browser."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.pages import OpenBrowser, PagePort, serve_pages


def prompts(
    capture: Annotated[
        Path, typer.Argument(help="Folder of a capture; capture.toml is created if it does not exist.")
    ],
    port: PagePort = 8765,
    browser: OpenBrowser = True,
) -> None:
    """Mark the robot and the object's two parts on scan images.

    The command opens a page in a browser. Click on a part to see its mask; shift-click regions that do not belong to
    it, or drag a box. Each part needs a box, preferably on two images. "Save" replaces the [[prompts]] of capture.toml
    and nothing else; "Done" ends the command. If there is no capture.toml, the command first asks for the robot and
    the columns of the log.
    """
    from aomgen.prompting.server import PromptServer
    from aomgen.prompting.session import PromptSession, find_missing

    if capture.is_dir() and not (capture / "capture.toml").exists():
        _ask_about_files(capture)
    session = PromptSession(capture)
    if session.no_masks:
        print(f"warning: masks are not available: {session.no_masks}")
    with PromptServer(session, port) as server:
        serve_pages(server, "mark the parts at", browser=browser)
    missing = find_missing(session.prompts)
    for part, count in missing.items():
        print(f"  missing: {part} on {count} more image{'s' if count > 1 else ''}")
    if not missing:
        print(f"all parts are marked; next: aomgen check {capture}")


def _ask_about_files(capture: Path) -> None:
    """Write a capture.toml from the contents of the folder and the corrections of the user."""
    from aomgen.importers.found_files import describe_capture, find_capture_files

    found, columns = find_capture_files(capture)
    print(f"{capture} has no capture.toml; confirm or correct the detected values")
    question = "robot: a known name, or a URDF or MJCF file in the folder"
    robot = typer.prompt(question, found.robot_model or None)
    print(f"columns of the log: {', '.join(columns)}")
    joints = typer.prompt("joints of the arm, from base to flange", ", ".join(found.joints) or None)
    gripper = typer.prompt("gripper", found.gripper or None)
    listed = [name.strip() for name in joints.split(",")]
    tables = replace(found, robot_model=robot, joints=listed, gripper=gripper)
    print(f"wrote {describe_capture(capture, tables, columns)}")
