"""Project files come back as they were written and refuse what they should."""

from pathlib import Path

import pytest

from aomgen.core.project import Project
from aomgen.errors import ConfigError, MissingFileError
from aomgen.pipeline.project_file import read_project, write_project
from aomgen.pipeline.stages import STAGES, check_params


def test_round_trip(tmp_path):
    project = Project(
        capture=tmp_path / "c",
        out=tmp_path / "o",
        seed=3,
        assets=("microwave:1",),
        poses=9,
        image_size=(256, 192),
        motion_method="paper",
        light=str(tmp_path / "light" / "room.hdr"),
        light_yaw_deg=-30.0,
    )
    write_project(tmp_path / "project.toml", project)
    assert read_project(tmp_path / "project.toml") == project
    text = (tmp_path / "project.toml").read_text()
    assert 'motion_method = "paper"' in text
    assert 'light = "light/room.hdr" ' in text


@pytest.mark.parametrize(
    "name", ['Mikrowelle "groß"', "it's", r"C:\new\table", "two  spaces", "tab\tdelete\x7f", "{seed}", "日本"]
)
def test_any_path_survives(tmp_path, name):
    folder = tmp_path / name
    inside = Project(
        capture=folder / "capture", out=folder / "out", assets=(str(folder / "usd" / f"{name}.usda"),)
    )
    outside = inside.model_copy(update={"capture": tmp_path / "elsewhere" / name})
    for project in (inside, outside):
        write_project(folder / "project.toml", project)
        assert read_project(folder / "project.toml") == project


def test_paths_below_the_file_are_relative(tmp_path):
    write_project(tmp_path / "project.toml", Project(capture=tmp_path / "my_capture", out=tmp_path))
    text = (tmp_path / "project.toml").read_text()
    assert 'capture = "my_capture" ' in text
    assert 'out = "." ' in text


def test_a_name_that_is_no_text(tmp_path):
    with pytest.raises(ConfigError, match="rename the file"):
        write_project(tmp_path / "project.toml", Project(capture=tmp_path / "b\udce4d", out=tmp_path))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("image_size = [321, 240]", "'image_size.0' is 321: Input should be a multiple of 2"),
        ("adapt = 'objects'", "'adapt' is 'objects': Input should be 'trajectory', 'object' or 'auto'"),
        ("colour = 'red'", "key 'colour' is unknown; known: format, capture, out, seed"),
        ("", "key 'out' is missing"),
    ],
)
def test_wrong_choices(tmp_path, line, words):
    out = "out = 'b'\n" if line else ""
    (tmp_path / "a.toml").write_text(f"format = 1\ncapture = 'a'\n{out}{line}\n")
    with pytest.raises(ConfigError) as caught:
        read_project(tmp_path / "a.toml")
    assert words in str(caught.value)


def test_paths_are_taken_from_the_file(tmp_path):
    (tmp_path / "project.toml").write_text(
        "format = 1\ncapture = 'a'\nout = '../b'\nassets = ['drawer:2', 'usd/door.usda']\n"
        "light = 'diffusion:weights'\ninpainter = 'painter'\n"
    )
    project = read_project(tmp_path / "project.toml")
    assert project.capture == tmp_path.resolve() / "a"
    assert project.out == tmp_path.resolve().parent / "b"
    assert project.light == f"diffusion:{tmp_path.resolve() / 'weights'}"
    assert project.networks == (tmp_path.resolve() / "weights", tmp_path.resolve() / "painter")
    assert project.assets == ("drawer:2", str(tmp_path.resolve() / "usd" / "door.usda"))


def test_refusals(tmp_path):
    with pytest.raises(MissingFileError, match="aomgen init"):
        read_project(tmp_path / "none.toml")
    (tmp_path / "a.toml").write_text("format = 1\ncapture = 'a'\nout = 'b'\npose = 3\n")
    with pytest.raises(ConfigError, match=r"key 'pose' is unknown; did you mean 'poses'"):
        read_project(tmp_path / "a.toml")


def test_stages_come_after_what_they_need():
    known = {"capture", "assets", "review"}
    for stage in STAGES:
        assert set(stage.needs) <= known, stage.name
        assert set(stage.settings) <= set(Project.model_fields)
        known.add(stage.name)
    assert len({stage.folder for stage in STAGES}) == len(STAGES)
    assert Path(STAGES[5].folder).name == "06_twin"


def test_parameters_of_stages_come_back_and_unknown_ones_are_refused(tmp_path: Path) -> None:
    params = {"motion": {"joint": {"nodes": 30}, "width": 200}}
    project = Project(capture=tmp_path, out=tmp_path / "out", params=params)
    write_project(tmp_path / "project.toml", project)
    assert "motion.joint.nodes = 30" in (tmp_path / "project.toml").read_text()
    assert read_project(tmp_path / "project.toml").params == params
    check_params(project)
    for wrong, message in (
        ({"motio": {}}, "did you mean 'motion'"),
        ({"motion": {"wide": 1}}, "did you mean 'width'"),
    ):
        with pytest.raises(ConfigError, match=message):
            check_params(project.model_copy(update={"params": wrong}))
