"""The demo tables of a capture.toml are written, and nothing else of it changes."""

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from aomgen.capture.capture_schema import read_manifest
from aomgen.errors import MalformedFileError
from aomgen.importers.capture_tables import (
    DemoTables,
    read_robot_table,
    replace_demo_tables,
    write_new_capture,
)

TABLES = DemoTables(
    cameras=["front", "side"], clock_offset_s=1.5, robot_model="ur5e_2f85", joints=["a", "b"], instruction=""
)


def test_a_new_file_is_valid_and_names_what_is_missing(tmp_path: Path):
    text = write_new_capture('a "new" one', TABLES)
    (tmp_path / "capture.toml").write_text(text)
    manifest = read_manifest(tmp_path / "capture.toml")
    assert manifest.name == 'a "new" one'
    assert [camera.video for camera in manifest.demo.cameras] == ["demo/front.mp4", "demo/side.mp4"]
    assert manifest.demo.clock_offset_s is None
    assert text.count("TODO:") == 5


def test_only_the_demo_tables_change(sample: Path):
    before = (sample / "capture.toml").read_text()
    after = replace_demo_tables(sample / "capture.toml", TABLES)
    at = before.index("[[demo.cameras]]")
    assert after.startswith(before[:at])
    assert after.endswith(before[before.index("[[prompts]]") :])
    front, side = tomllib.loads(after)["demo"]["cameras"]
    assert front["intrinsics"] == [600.0, 600.0, 320.0, 240.0]
    assert side == {"name": "side", "video": "demo/side.mp4"}


def test_replacing_twice_is_replacing_once(sample: Path, tmp_path: Path):
    once = replace_demo_tables(sample / "capture.toml", TABLES)
    (tmp_path / "capture.toml").write_text(once)
    assert replace_demo_tables(tmp_path / "capture.toml", TABLES) == once


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_comments_line_ends_and_order_stay(tmp_path: Path, end: str):
    text = (
        "format = 1\n\n# about the log\n[demo]\njoints = 'old.csv'\n# clock_offset_s = 3\n\n# about the robot\n[robot]\n"
        'model = "x"  # [demo]\njoints = ["a",\n["b"][0],\n]\n\n[[demo.cameras]]\n# a lens\n'
        "name = 'front'\nvideo = 'old.mp4' # measured\nT_world_cam = [\n[1, 0, 0, 0],\n[0, 1, 0, 0],\n"
        "[0, 0, 1, 0],\n[0, 0, 0, 1],\n]"
    ).replace('["b"][0]', '"b"')
    path = tmp_path / "capture.toml"
    path.write_bytes(text.replace("\n", end).encode())
    after = replace_demo_tables(path, TABLES)
    assert "old." not in after
    assert "clock_offset_s = 3" not in after
    assert f'# about the robot{end}[robot]{end}model = "x"  # [demo]{end}' in after
    front = tomllib.loads(after)["demo"]["cameras"][0]
    assert front["video"] == "demo/front.mp4"
    assert front["T_world_cam"][3] == [0, 0, 0, 1]
    assert "# a lens" in after
    assert "# measured" in after


def test_a_file_of_a_scan_alone_gets_everything_else(tmp_path: Path):
    path = tmp_path / "kitchen" / "capture.toml"
    path.parent.mkdir()
    path.write_text('format = 1\n\n# my photos\n[scan]\nimages = "scan"')
    assert read_robot_table(path) is None
    tables = replace(TABLES, instruction="open it")
    text = replace_demo_tables(path, tables)
    path.write_text(text)
    manifest = read_manifest(path)
    assert (manifest.name, manifest.instruction, manifest.scan.images) == ("kitchen", "open it", "scan")
    assert "# my photos\n[scan]" in text
    new = tomllib.loads(write_new_capture("kitchen", tables))
    assert tomllib.loads(text) == new
    assert replace_demo_tables(path, tables) == text


@pytest.mark.parametrize(
    "text",
    [
        'demo = {joints = "x", cameras = []}',
        '[demo]\njoints = "x"\ncameras = [{name = "front", video = "y"}]\n[robot]\nx = """\n[demo]\n"""',
        '[demo]\njoints = "x"\ncameras = [{name = "front", video = "y"}]',
        "[[demo.cameras]]\nvideo = 'x'",
    ],
)
def test_other_forms_are_refused(tmp_path: Path, text: str):
    path = tmp_path / "capture.toml"
    path.write_text(text)
    with pytest.raises(MalformedFileError, match="in a form that cannot be replaced"):
        replace_demo_tables(path, TABLES)
