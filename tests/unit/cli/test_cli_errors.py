"""Bad input on the command line: one sentence, an exit code by family, nothing half-written."""

import subprocess
import sys
from collections.abc import Callable
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from subprocess import CompletedProcess
from unittest.mock import patch

import pytest

from aomgen.assets.make import make_asset
from aomgen.assets.usd_write import write_usd
from aomgen.cli import main


def started(*arguments: object, folder: Path) -> CompletedProcess:
    """Run the command line as a user does; shows also what native libraries write."""
    command = [sys.executable, "-c", "from aomgen.cli import main; main()", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


def aomgen(*arguments: object, folder: Path) -> CompletedProcess:
    """Run the command line in this process, which has imported everything already."""
    words = ["aomgen", *map(str, arguments)]
    out, err, code = StringIO(), StringIO(), 0
    with chdir(folder), redirect_stdout(out), redirect_stderr(err), patch.object(sys, "argv", words):
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return CompletedProcess(words, code, out.getvalue(), err.getvalue())


def one_sentence(result: CompletedProcess, code: int, *words: str) -> None:
    assert result.returncode == code, result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0]


def test_a_good_capture_is_described(sample, tmp_path):
    result = aomgen("check", sample, folder=tmp_path)
    assert result.returncode == 0
    assert "64 images, 640 x 480" in result.stdout
    assert "95 frames" in result.stdout


def test_a_damaged_capture_starts_nothing(capture_copy, tmp_path):
    video = capture_copy / "demo" / "front.mp4"
    assert aomgen("init", capture_copy, folder=tmp_path).returncode == 0
    video.write_bytes(video.read_bytes()[:100_000])
    result = started("run", "project.toml", folder=tmp_path)
    one_sentence(result, 3, "front.mp4", "copy or export the video again")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("call", [aomgen, started])
def test_init_does_not_overwrite(sample, tmp_path, call: Callable[..., CompletedProcess]):
    (tmp_path / "project.toml").write_text("")
    one_sentence(call("init", sample, folder=tmp_path), 2, "exists already")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("format = 1\ncaptures = 'x'", ("key 'captures' is unknown", "did you mean 'capture'")),
        ("format = ", ("not valid TOML",)),
        ("format = 1\ncapture = 'x'\nout = 'y'\nposes = 0", ("poses", "greater than or equal to 1")),
    ],
)
def test_a_wrong_project(tmp_path, text, words):
    (tmp_path / "project.toml").write_text(text)
    one_sentence(aomgen("run", "project.toml", folder=tmp_path), 2, *words)


def test_an_unknown_stage_lists_the_known(sample, tmp_path):
    aomgen("init", sample, folder=tmp_path)
    result = aomgen("run", "project.toml", "--until", "dreaming", folder=tmp_path)
    one_sentence(result, 2, "dreaming", "structure, gaussians")


def test_an_unfinished_run_cannot_be_drawn(tmp_path):
    (tmp_path / "camera.json").write_text("{}")
    result = aomgen("render", tmp_path, "x.png", "--camera", "camera.json", folder=tmp_path)
    one_sentence(result, 3, "06_twin", "finish the run first")
    assert not (tmp_path / "x.png").exists()


def test_assets_are_made_and_checked(tmp_path):
    assert aomgen("assets", "make", "drawer", "drawer.usda", "--seed", 3, folder=tmp_path).returncode == 0
    result = aomgen("check", "drawer.usda", folder=tmp_path)
    assert result.returncode == 0
    assert "prismatic joint" in result.stdout
    one_sentence(aomgen("assets", "make", "spaceship", "a.usda", folder=tmp_path), 2, "spaceship", "drawer")


def test_an_asset_without_a_joint(tmp_path):
    path = tmp_path / "box.usda"
    write_usd(make_asset("microwave", 1), path)
    from pxr import Usd, UsdPhysics

    stage = Usd.Stage.Open(str(path))
    for prim in list(stage.Traverse()):
        if prim.IsA(UsdPhysics.Joint):
            stage.RemovePrim(prim.GetPath())
    stage.Save()
    one_sentence(started("check", "box.usda", folder=tmp_path), 3, "box.usda", "joint")


def test_no_ground_truth_no_score(sample, tmp_path):
    one_sentence(aomgen("bench", "accuracy", sample, folder=tmp_path), 3, "cannot be scored")
