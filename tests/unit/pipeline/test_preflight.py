"""Broken captures, projects and assets are named in one sentence before work starts; good ones give no warning."""

import json
import re
from contextlib import chdir
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import pytest

from aomgen.assets.choice import make_asset
from aomgen.assets.usd_write import write_usd
from aomgen.capture import capture_check, demo_videos
from aomgen.capture.read import read_capture
from aomgen.core.project import Project
from aomgen.errors import (
    AssetError,
    ConfigError,
    LimitExceededError,
    MissingFileError,
    StorageError,
)
from aomgen.io.shown_frame import FrameDisplay
from aomgen.io.video import VideoInfo
from aomgen.pipeline import preflight, requirements
from aomgen.pipeline.stages import assets_digest
from aomgen.robots.loading import load_robot
from broken_captures import CAPTURES, TOML, edit, write_tight_usd

AS_STORED = FrameDisplay(transposed=False, mirrored=(False, False), aspect=Fraction(1), transfer=None)
SHARED = Path(__file__).parents[4] / "shared" / "captures"


def checked(folder: Path) -> tuple[str, ...]:
    """What `aomgen init` does with a capture, before it writes anything."""
    recorded = read_capture(folder)
    return preflight.check_project(preflight.new_project(recorded, folder.parent / "out", []), recorded)


# Every sentence that a broken capture gets, to be read at a glance; numbers stand as #.
MESSAGES = json.loads((Path(__file__).parent / "messages.json").read_text("utf-8"))


@pytest.mark.parametrize("name", CAPTURES)
def test_a_broken_capture(small_copy, name):
    """To accept a new wording, edit messages.json; the failing test shows the sentence."""
    case = CAPTURES[name]
    case.damage(small_copy)
    if case.kind is None:
        (sentence,) = (said for said in checked(small_copy) if all(word in said for word in case.words))
    else:
        with pytest.raises(case.kind) as caught:
            checked(small_copy)
        sentence = str(caught.value)
        for word in case.words:
            assert word in sentence
    assert re.sub(r"(?<!\w)\d+(\.\d+)?", "#", sentence.replace(f"{small_copy}/", "")) == MESSAGES[name]


def test_every_message_belongs_to_a_broken_capture():
    assert sorted(MESSAGES) == sorted(CAPTURES)


def test_a_video_that_does_not_fit_into_memory(small_copy, monkeypatch):
    huge = VideoInfo(width=3840, height=2160, frames=19_000, fps=60, display=AS_STORED)
    monkeypatch.setattr(demo_videos, "probe_video", lambda path: huge)
    monkeypatch.setattr(
        demo_videos.os, "sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 1 << 22}.__getitem__
    )
    with pytest.raises(
        LimitExceededError, match=r"front\.mp4: needs 946 GB of memory when decoded .* has 17 GB"
    ):
        checked(small_copy)


PROJECTS = {
    "unknown maker": (("toaster:1",), ConfigError, ("'toaster:1'", "known: cabinet")),
    "misspelled maker": (("tool box:1",), ConfigError, ("did you mean 'toolbox'?",)),
    "no seed": (("microwave",), ConfigError, ("neither category:seed nor a USD file", "microwave:1")),
    "missing USD": (("gone.usda",), MissingFileError, ("gone.usda", "is missing")),
    "USD that cannot be opened far enough": (("tight.usda",), AssetError, ("opens by 0.1 only",)),
    "two equal assets": (("microwave:1", "microwave:1"), AssetError, ("'microwave-1'", "once")),
    "asset that opens another way": (("drawer:1",), None, ("drawer-1 slides, a microwave turns",)),
}


@pytest.mark.parametrize("name", PROJECTS)
def test_assets_that_cannot_be_used(small_capture, tmp_path, name):
    assets, kind, words = PROJECTS[name]
    if "tight.usda" in assets:
        write_tight_usd(tmp_path / "tight.usda")
    recorded = read_capture(small_capture)
    with chdir(tmp_path):
        project = preflight.new_project(recorded, tmp_path / "out", assets)
    if kind is None:
        text = "\n".join(preflight.check_project(project, recorded))
    else:
        with pytest.raises(kind) as caught:
            preflight.check_project(project, recorded)
        text = str(caught.value)
    assert all(word in text for word in words), text


def project_of(capture: Path, out: Path, **choices) -> Project:
    return Project(capture=capture, out=out, assets=("microwave:1",), **choices)


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ({"light": "room.hdr"}, r"room\.hdr: is missing; set `light` to"),
        ({"light": "diffusion:weights"}, r"weights/model_index\.json: is missing; save a diffusion pipeline"),
        ({"inpainter": "painter"}, r"painter/model_index\.json: is missing; save a diffusion pipeline"),
    ],
)
def test_files_of_a_project_that_cannot_be_read(small_capture, tmp_path, choice, words):
    with pytest.raises(MissingFileError, match=words):
        preflight.check_project(project_of(small_capture, tmp_path, **choice), read_capture(small_capture))


def test_images_of_another_shape(small_capture, tmp_path):
    stretched = project_of(small_capture, tmp_path, image_size=(256, 256))
    (sentence,) = preflight.check_project(stretched, read_capture(small_capture))
    assert "256 x 256 stretches" in sentence
    assert "256 x 192 keeps" in sentence


def test_the_paper_s_alignment_needs_two_boxes(small_copy, tmp_path):
    edit(TOML, 'part = "robot"\nimage = "0057.jpg"', 'part = "static"\nimage = "0057.jpg"')(small_copy)
    with pytest.raises(ConfigError, match="has 1 box around the robot"):
        preflight.check_project(
            project_of(small_copy, tmp_path, alignment_method="paper"), read_capture(small_copy)
        )


EPISODES = {
    "unknown camera": ({"cameras": ["font"]}, "'font' is not a camera; did you mean 'front'"),
    "nothing like a camera": ({"cameras": ["x"]}, "'x' is not a camera; known: front, side"),
    "robot without cameras": ({"images": {"robot_cameras": True}}, "has no camera; add"),
}


@pytest.mark.parametrize("name", EPISODES)
def test_cameras_that_nobody_has(small_capture, tmp_path, name, monkeypatch):
    params, words = EPISODES[name]
    bare = replace(load_robot("ur5e_2f85"), cameras={})
    monkeypatch.setattr(capture_check, "choose_robot", lambda section: bare)
    with pytest.raises(ConfigError, match=words):
        preflight.check_project(
            project_of(small_capture, tmp_path, params={"episodes": params}), read_capture(small_capture)
        )


def test_cameras_that_exist(small_capture, tmp_path):
    named = {"cameras": ["side", "front"], "images": {"robot_cameras": True}}
    project = project_of(small_capture, tmp_path / "out", params={"episodes": named})
    assert preflight.check_project(project, read_capture(small_capture)) == ()


def test_out_is_a_file(small_capture, tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(StorageError, match="is a file"):
        preflight.check_project(
            project_of(small_capture, tmp_path / "out" / "a"), read_capture(small_capture)
        )


def test_a_full_disk(small_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(requirements.shutil, "disk_usage", lambda path: SimpleNamespace(free=90 << 20))
    with pytest.raises(StorageError, match="90 MB left on its disk, expected at least 250"):
        preflight.check_project(project_of(small_capture, tmp_path / "out"), read_capture(small_capture))


def test_a_folder_that_is_not_ours(small_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(requirements.os, "access", lambda path, mode: False)
    with pytest.raises(StorageError, match="not writable"):
        preflight.check_project(project_of(small_capture, tmp_path / "out"), read_capture(small_capture))


@pytest.mark.parametrize("name", ["sample", "drawer-b"])
def test_good_captures_pass_without_warnings(sample, tmp_path, name):
    folder = sample if name == "sample" else SHARED / name
    if not folder.is_dir():
        pytest.skip("the captures with ground truth lie beside the project, not in it")
    recorded = read_capture(folder)
    assert preflight.check_project(preflight.new_project(recorded, tmp_path / "out", []), recorded) == ()


def test_the_small_capture_is_good_as_well(small_capture):
    assert checked(small_capture) == ()


def test_raw_pictures_beside_their_copies_and_hidden_files(small_copy):
    (small_copy / "scan" / "0003.DNG").write_bytes(b"raw")
    (small_copy / "scan" / "._0003.jpg").write_bytes(b"what an archiver of another system leaves")
    assert checked(small_copy) == ()


def test_an_edited_asset_file_is_another_input(tmp_path: Path) -> None:
    path = tmp_path / "drawer.usda"
    write_usd(make_asset("drawer", 1), path)
    before = assets_digest(["drawer:1", str(path)], "scan")
    path.write_text(path.read_text().replace("handle_axis = (1", "handle_axis = (0.999"))
    assert assets_digest(["drawer:1", str(path)], "scan") != before
    with_light = assets_digest(["drawer:1"], str(path))
    assert with_light != assets_digest(["drawer:1"], "scan")
    assert assets_digest(["drawer:2"], "scan") == assets_digest([], "scan")
