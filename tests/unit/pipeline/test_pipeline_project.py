"""Project files come back as they were written and refuse what they should."""

from pathlib import Path

import pytest

from aomgen.errors import ConfigError, MissingFileError
from aomgen.pipeline.project import Project, read_project, write_project
from aomgen.pipeline.stages import STAGES


def test_round_trip(tmp_path):
    project = Project(
        capture=tmp_path / "c",
        out=tmp_path / "o",
        seed=3,
        assets=("microwave:1",),
        poses=9,
        image_size=(256, 192),
        motion_method="paper",
    )
    write_project(tmp_path / "project.toml", project)
    assert read_project(tmp_path / "project.toml") == project
    assert 'motion_method = "paper"' in (tmp_path / "project.toml").read_text()


def test_paths_are_taken_from_the_file(tmp_path):
    (tmp_path / "project.toml").write_text(
        "format = 1\ncapture = 'a'\nout = '../b'\nassets = ['drawer:2', 'usd/door.usda']\n"
    )
    project = read_project(tmp_path / "project.toml")
    assert project.capture == tmp_path.resolve() / "a"
    assert project.out == tmp_path.resolve().parent / "b"
    assert project.assets == ("drawer:2", str(tmp_path.resolve() / "usd" / "door.usda"))


def test_refusals(tmp_path):
    with pytest.raises(MissingFileError, match="aomgen init"):
        read_project(tmp_path / "none.toml")
    (tmp_path / "a.toml").write_text("format = 1\ncapture = 'a'\nout = 'b'\npose = 3\n")
    with pytest.raises(ConfigError, match=r"key 'pose' is unknown; did you mean 'poses'"):
        read_project(tmp_path / "a.toml")


def test_stages_come_after_what_they_need():
    known = {"capture"}
    for stage in STAGES:
        assert set(stage.needs) <= known, stage.name
        assert set(stage.settings) <= set(Project.model_fields)
        known.add(stage.name)
    assert len({stage.folder for stage in STAGES}) == len(STAGES)
    assert Path(STAGES[5].folder).name == "06_twin"
