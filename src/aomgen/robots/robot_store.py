"""A robot kept beside results, so that they can be used without the capture they come from."""

import os
from pathlib import Path
from typing import Any

from aomgen.core.robot_choice import RobotChoice
from aomgen.errors import MalformedFileError
from aomgen.io.atomic import write_bytes, write_json, write_text
from aomgen.io.jsonfile import read_json
from aomgen.io.paths import resolve_inside
from aomgen.robots.description import FILE_NAME, description_toml, find_description
from aomgen.robots.loading import load_robot
from aomgen.robots.propose import propose_description
from aomgen.robots.robot import RobotModel

HEADER = "robot.json"
FILES = "robot"


def copy_robot_files(model_file: Path, references: tuple[Path, ...], folder: Path) -> Path:
    """Copy a description and all it refers to, each at the same place relative to the others.

    Args:
        model_file: URDF or MJCF.
        references: All further files that it needs.
        folder: Where the copies go.

    Returns:
        The copied description.
    """
    files = [model_file.resolve(), *(file.resolve() for file in references)]
    top = Path(os.path.commonpath([file.parent for file in files]))
    for file in files:
        write_bytes(folder / file.relative_to(top), file.read_bytes())
    return folder / files[0].relative_to(top)


def save_robot(folder: Path, choice: RobotChoice) -> None:
    """Write which robot it is, its files and what they are for, into an existing folder."""
    file = ""
    if choice.model_file:
        copied = copy_robot_files(choice.model_file, choice.references, folder / FILES)
        file = copied.relative_to(folder).as_posix()
        if find_description(choice.model_file) is None:
            guess = propose_description(choice.model_file, choice.root, choice.joints, choice.hand)
            write_text(copied.parent / FILE_NAME, description_toml(guess))
    write_json(
        folder / HEADER,
        {
            "model": choice.model,
            "file": file,
            "base_frame": choice.base_frame,
            "joints": list(choice.joints),
        },
    )


def load_robot_description(folder: Path) -> RobotModel:
    """Load what `save_robot` wrote.

    Raises:
        MissingFileError, MalformedFileError: As their names say.
    """
    where = folder / HEADER
    data: Any = read_json(where)
    try:
        model = resolve_inside(folder, data["file"], named_by=where) if data["file"] else str(data["model"])
        return load_robot(model, data["base_frame"], joints=data["joints"], root=(folder / FILES).resolve())
    except (KeyError, TypeError) as error:
        raise MalformedFileError(where, f"is not complete ({error!r})", "run the stage again") from error
