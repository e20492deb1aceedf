"""`aomgen.splatting` as a library: its names are there, and drawing imports neither torch nor the rest."""

import subprocess
import sys
from pathlib import Path

import pytest

import aomgen
import aomgen.splatting as splatting

DRAW = """
import sys
import aomgen.splatting
light = {name for name in sys.modules if name.split(".")[0] in ("numpy", "scipy", "torch")}
assert not light, light
from aomgen.splatting import Camera, Gaussians, contribution_weights, framing_camera, look_at
from aomgen.splatting import RigidParts, RenderSession, gaussians_from_points, psnr, read_colmap, read_gaussians, render, write_gaussians
heavy = {"torch", "pycolmap", "mujoco", "pxr", "pydantic", "av", "pyarrow"} & set(sys.modules)
assert not heavy, heavy
ours = {name.split(".")[1] for name in sys.modules if name.startswith("aomgen.")}
assert ours <= {"conventions", "core", "errors", "io", "splatting", "version"}, ours
"""


def test_drawing_is_light() -> None:
    source = str(Path(aomgen.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", DRAW], env={"PYTHONPATH": source}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_every_name_is_there() -> None:
    pytest.importorskip("torch")
    for name in splatting.__all__:
        assert getattr(splatting, name).__name__ == name
    assert set(splatting.__all__) <= set(dir(splatting))


def test_unknown_name() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'rendr'; it has .*render"):
        splatting.rendr  # noqa: B018  # pyright: ignore
