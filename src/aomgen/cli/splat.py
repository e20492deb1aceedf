"""`aomgen splat`: reconstruct Gaussians from photos, without a robot and without a GPU."""

from pathlib import Path
from typing import Annotated

import typer

from aomgen.errors import ConfigError


def splat(
    source: Annotated[
        Path, typer.Argument(help="A folder of photos, a video, or a scan as for `aomgen import scan`.")
    ],
    scene: Annotated[Path, typer.Argument(help="Gaussian splatting file to write, for example scene.ply.")],
    long_side: Annotated[
        int, typer.Option(min=160, max=16_384, help="Reduce larger images to this long side [px].")
    ] = 960,
    video: Annotated[Path | None, typer.Option(help="Also render a turntable to this MP4.")] = None,
) -> None:
    """Reconstruct a scene as 3D Gaussians from photos alone, on a CPU.

    The command can be stopped at any time; the same command continues where it stopped. Finished steps are stored
    in the folder scene.run next to the scene, which can be deleted afterwards.
    """
    from aomgen.io.gaussian_files import WRITTEN_SUFFIXES

    if scene.suffix.lower() not in WRITTEN_SUFFIXES:
        raise ConfigError(
            scene,
            "does not have the suffix of a Gaussian splatting file",
            f"use one of {', '.join(WRITTEN_SUFFIXES)}",
        )
    from aomgen.api.display import display
    from aomgen.pipeline.splat import SPLAT_STAGES, make_splat

    with display(SPLAT_STAGES) as shown:
        described = make_splat(source, scene, shown, long_side=long_side, video=video)
    print(described)
    print(f"scene    {scene}")
    if video is not None:
        print(f"video    {video}")
