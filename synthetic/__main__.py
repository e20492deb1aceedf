"""`python -m synthetic FOLDER`: make a capture with ground truth."""

from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.run import COMMAND_LINE, run_command
from aomgen.errors import ConfigError

app = typer.Typer(**COMMAND_LINE, add_completion=False)


@app.command()
def make(
    folder: Annotated[Path, typer.Argument(help="Capture folder to write; must not exist.")],
    category: Annotated[
        str, typer.Option(help="cabinet, drawer, laptop, microwave or toolbox.")
    ] = "microwave",
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same capture.")] = 0,
    robot: Annotated[Path | None, typer.Option(help="URDF or MJCF of another arm with a gripper.")] = None,
    closing: Annotated[bool, typer.Option("--closing", help="The part is scanned open and closed.")] = False,
    touch: Annotated[str, typer.Option(help="How the part is moved: pinch, hook or push.")] = "pinch",
) -> None:
    """Make a capture with ground truth in a virtual world: simulated physics, rendered images."""
    # Imported late: threads of NumPy would start before the signals are blocked.
    from synthetic.world import draw_capture_style, make_capture

    if folder.exists():
        raise ConfigError(folder, "exists already", "choose another folder")
    style = draw_capture_style(category, seed, "closing" if closing else "opening", touch)
    make_capture(folder, category=category, seed=seed, robot_file=robot, style=style)
    print(folder)


if __name__ == "__main__":
    run_command(app)
