"""`aomgen robot`: what the parts of an arm's model are for."""

from pathlib import Path
from typing import Annotated

import typer

from aomgen.errors import ConfigError

robot_app = typer.Typer(no_args_is_help=True, help="Describe an arm of your own (robot.toml).")
Values = list[str] | None


@robot_app.command()
def propose(
    file: Annotated[Path, typer.Argument(help="URDF (xacro expanded) or MJCF of the arm with its gripper.")],
    joint: Annotated[
        Values,
        typer.Option(help="An arm joint, in the joint log's order; repeat. Without: up to the fingers."),
    ] = None,
    opened: Annotated[
        Values,
        typer.Option(
            "--open", help="NAME=VALUE [rad or m] of a finger joint at gripper 0; repeat for several."
        ),
    ] = None,
    closed: Annotated[Values, typer.Option(help="The same at gripper 1.")] = None,
    finger: Annotated[Values, typer.Option(help="Body that holds; give the left and the right one.")] = None,
    root: Annotated[
        Path | None, typer.Option(help="Folder that all meshes lie in; the file's own without.")
    ] = None,
) -> None:
    """Draft the robot.toml that stands beside an arm's model and says what its parts are for.

    The draft is a guess from joints and shapes: the arm ends where the fingers branch, the gripper
    closes where two of its bodies come nearest, the pads are the faces that meet there, and the end
    effector lies between them. Read every line of it, correct what is wrong, and look at the sizes
    printed below it. `aomgen check CAPTURE` then loads the robot as robot.toml says.

    Where the file does not tell enough, the error says what is missing: usually the values of the
    finger joints, `--open left_joint=0 --closed left_joint=0.8`.
    """
    from aomgen.io.atomic import write_text
    from aomgen.robots.description import FILE_NAME, description_toml
    from aomgen.robots.loading import load_robot
    from aomgen.robots.propose import describe_sizes, propose_description

    path = file.parent / FILE_NAME
    if path.exists():
        raise ConfigError(path, "exists already", "move it away, or correct it by hand")
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
    """The values in NAME=VALUE words."""
    result = {}
    for word in words or []:
        name, _, value = word.rpartition("=")
        try:
            result[name] = float(value)
        except ValueError as error:
            raise ConfigError("--open, --closed", f"'{word}' is not NAME=VALUE", "as in joint=0.8") from error
    return result
