"""Bad input on the command line: one sentence, an exit code by family, nothing half-written."""

from pathlib import Path
from unittest.mock import patch

import pytest

from aomgen.assets.choice import make_asset
from aomgen.assets.usd_write import write_usd
from aomgen.core.project import Project
from aomgen.pipeline.project_file import write_project
from aomgen.pipeline.stages import PROJECT_FILE, find_project
from aomgen.version import __version__
from command_line import aomgen, one_sentence, started


def test_a_damaged_capture_starts_nothing(capture_copy, tmp_path):
    video = capture_copy / "demo" / "front.mp4"
    assert aomgen("init", capture_copy, folder=tmp_path).returncode == 0
    video.write_bytes(video.read_bytes()[:100_000])
    result = started("run", "project.toml", folder=tmp_path)
    one_sentence(result, 3, "front.mp4", "copy or export the video again")
    assert not (tmp_path / "out").exists()


def test_init_does_not_overwrite(small_capture, tmp_path):
    (tmp_path / "project.toml").write_text("")
    one_sentence(aomgen("init", small_capture, folder=tmp_path), 2, "exists already")


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


def test_an_unknown_stage_lists_the_known(small_capture, tmp_path):
    aomgen("init", small_capture, folder=tmp_path)
    result = aomgen("run", "project.toml", "--until", "dreaming", folder=tmp_path)
    one_sentence(result, 2, "dreaming", "structure, gaussians")


def test_a_store_needs_a_cluster(small_capture, tmp_path):
    aomgen("init", small_capture, folder=tmp_path)
    result = aomgen("run", "project.toml", "--store", "memory://run", folder=tmp_path)
    one_sentence(result, 2, "--store", "has no meaning without --ray")


@pytest.fixture
def unfinished(sample, tmp_path) -> Path:
    """Folder of a run in which no stage has finished."""
    out = tmp_path / "out"
    write_project(out / PROJECT_FILE, Project(capture=sample, out=out))
    return out


def test_an_unfinished_run_cannot_be_drawn(unfinished):
    one_sentence(
        aomgen("render", unfinished, "x.png", "--camera", "side", folder=unfinished),
        3,
        "06_twin",
        "finish the run first",
    )
    assert not (unfinished / "x.png").exists()


@pytest.mark.parametrize("command", ["status", "report", "render"])
def test_a_run_is_named_by_its_folder_or_its_project_file(unfinished, tmp_path, command):
    more = ("x.png", "--camera", "side") if command == "render" else ()
    by_folder, by_file = (
        aomgen(command, path, *more, folder=tmp_path) for path in (unfinished, unfinished / PROJECT_FILE)
    )
    assert (by_folder.returncode, by_folder.stdout, by_folder.stderr) == (
        by_file.returncode,
        by_file.stdout,
        by_file.stderr,
    )
    for path, words in ((tmp_path / "nothing", "is missing"), (tmp_path, "holds no project.toml")):
        one_sentence(aomgen(command, path, *more, folder=tmp_path), 3, path.name, words)


def test_a_moved_run_is_found_where_it_is(unfinished, tmp_path):
    (unfinished / "01_structure").mkdir()
    moved = unfinished.rename(tmp_path / "moved")
    assert find_project(moved).out == moved
    assert "partial  01_structure" in aomgen("status", moved, folder=tmp_path).stdout


def test_a_project_beside_its_run_names_the_run(small_capture, tmp_path):
    aomgen("init", small_capture, folder=tmp_path)
    assert find_project(tmp_path).out == tmp_path / "out"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("demo", "out", "--poses", 0), "--poses"),
        (("demo", "out", "--seed", -1), "--seed"),
        (("assets", "make", "drawer", "a.usda", "--seed", -1), "--seed"),
    ],
)
def test_numbers_out_of_range_are_told_as_such(tmp_path, words, told):
    result = aomgen(*words, folder=tmp_path)
    assert result.returncode == 2
    assert f"Invalid value for '{told}'" in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (("s.json", "--policy", "oracle_replay"), 3, "s.json: is missing"),
        (("s.toml", "--policy", "oracle_replay"), 2, "ends in .json"),
        (("s.json", "--policy", "oracle_replay", "--actions", "joints"), 2, "did you mean 'joint'?"),
        (("s.json", "--policy", "oracle_replay", "--visuals", "splats"), 2, "did you mean 'splat'?"),
        (("suite", "out", "s.json"), 3, "project.toml: is missing"),
        (("suite", "out", "s.json", "--size", "128"), 2, "expected WxH"),
        (("suite", "out", "s.json", "--actions", "delta"), 2, "'delta' is unknown"),
    ],
)
def test_evaluations_are_refused_before_they_begin(tmp_path, words, code, told):
    one_sentence(aomgen("evaluate", *words, folder=tmp_path), code, told)
    assert list(tmp_path.iterdir()) == []


def test_results_do_not_go_where_a_file_is(tmp_path):
    (tmp_path / "out").write_text("mine")
    one_sentence(aomgen("demo", "out", folder=tmp_path), 2, "is a file")


def test_what_may_not_be_read_is_named(tmp_path):
    refusal = PermissionError(13, "Permission denied", "scan/0001.jpg")
    with patch("aomgen.pipeline.stages.find_project", side_effect=refusal):
        one_sentence(aomgen("status", "out", folder=tmp_path), 3, "scan/0001.jpg: Permission denied")


def test_every_command_has_help_and_the_program_its_version(tmp_path):
    assert aomgen("--version", folder=tmp_path).stdout == f"{__version__}\n"
    for words in ((), ("render",), ("assets",), ("assets", "make")):
        result = aomgen(*words, "-h", folder=tmp_path)
        assert result.returncode == 0
        assert result.stdout.startswith("Usage: ")


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


def test_a_robot_is_drafted_once_and_for_a_person_to_read(write_urdf, tmp_path):
    model = write_urdf()
    result = aomgen("robot", "propose", model, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "pads 90 mm apart when open, 10 mm when closed" in result.stdout
    assert 'joints = ["shoulder", "elbow", "wrist"]' in (tmp_path / "robot.toml").read_text()
    one_sentence(aomgen("robot", "propose", model, folder=tmp_path), 2, "exists already")
    one_sentence(aomgen("robot", "propose", model, "--finger", "palm", folder=tmp_path), 2, "exists")


def test_values_of_fingers_are_given_by_name(write_urdf, tmp_path):
    model = write_urdf(mimic="")
    values = (
        "--open",
        "slide_a=0.03",
        "--open",
        "slide_b=0.03",
        "--closed",
        "slide_a=0.01",
        "--closed",
        "slide_b",
    )
    one_sentence(aomgen("robot", "propose", model, *values, folder=tmp_path), 2, "NAME=VALUE")
    assert aomgen("robot", "propose", model, *values[:-1], "slide_b=0.01", folder=tmp_path).returncode == 0
    assert 'closed = { "slide_a" = 0.01, "slide_b" = 0.01 }' in (tmp_path / "robot.toml").read_text()
