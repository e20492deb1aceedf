import shutil
from pathlib import Path

import numpy as np
import pytest

from aomgen.errors import CorruptArtifactError, InputError, MissingFileError, UnknownNameError
from aomgen.pipeline.stages import STAGES
from aomgen.viewing.opened import RECORDING, ViewedFolder
from aomgen.viewing.overlays import Moment
from aomgen.viewing.scenes import PosableScene, ScannedScene

FOLDERS = {stage.name: stage.folder for stage in STAGES}


def remove_from(run: Path, stage: str) -> None:
    """Leave the stages before this one."""
    names = list(FOLDERS)
    for name in names[names.index(stage) :]:
        shutil.rmtree(run / FOLDERS[name])


@pytest.mark.parametrize(
    ("stage", "word", "overlays"),
    [
        ("gaussians", "no Gaussians yet", ["cameras"]),
        ("alignment", "no scale", ["cameras"]),
        ("motion", "joint is not estimated", ["cameras", "coverage"]),
        ("twin", "nothing can move", ["cameras", "coverage", "axis"]),
        ("replacement", "no episodes yet", ["colliders", "cameras", "coverage", "contacts", "axis"]),
    ],
)
def test_a_half_finished_run_shows_what_it_has(toy_run_copy, stage, word, overlays):
    remove_from(toy_run_copy, stage)
    opened = ViewedFolder(toy_run_copy).open()
    assert word in " ".join(opened.list_notes())
    assert opened.list_motions() == [{"name": "recording", "title": "recording"}]
    assert opened.list_overlays(RECORDING) == overlays
    motion, problem = opened.motion(RECORDING)
    assert not problem
    assert len(motion.times_s) == 48
    assert motion.videos["front"](1.0).startswith(b"\xff\xd8")
    if stage == "gaussians":
        assert opened.scene(RECORDING) is None
    elif stage != "replacement":
        assert isinstance(opened.scene(RECORDING), ScannedScene)
        assert motion.cameras


def test_a_capture_alone_is_a_run_that_has_made_nothing(small_capture):
    opened = ViewedFolder(small_capture).open()
    assert "not reconstructed" in opened.list_notes()[0]
    assert opened.motion(RECORDING)[0].trajectory is None
    assert len(opened.scan.names) == 13


def test_a_run_whose_capture_is_missing_shows_its_twin(toy_run_copy):
    file = toy_run_copy / "project.toml"
    text = file.read_text("utf-8")
    capture = next(line for line in text.splitlines() if line.startswith("capture"))
    file.write_text(text.replace(capture, 'capture = "/nowhere"'), "utf-8")
    opened = ViewedFolder(toy_run_copy).open()
    motion, problem = opened.motion(RECORDING)
    assert "/nowhere" in problem
    assert not motion.videos
    assert opened.scene(RECORDING) is not None


def test_a_run_is_followed_while_it_continues(toy_run_copy, tmp_path):
    episode, twin = toy_run_copy / FOLDERS["episodes"] / "000007", toy_run_copy / FOLDERS["twin"]
    shutil.move(episode, tmp_path / "000007")
    shutil.move(twin, tmp_path / "twin")
    viewed = ViewedFolder(toy_run_copy)
    first = viewed.open()
    assert "twin" not in first.done
    assert len(first.list_motions()) == 1
    shutil.move(tmp_path / "000007", episode)
    assert [item["name"] for item in first.list_motions()] == ["recording", "7"]
    assert viewed.open() is first
    shutil.move(tmp_path / "twin", twin)
    assert "twin" in viewed.open().done


def test_a_run_that_has_vanished_is_named_and_still_drawn(toy_run_copy):
    viewed = ViewedFolder(toy_run_copy)
    first = viewed.open()
    assert first.scene(RECORDING) is not None
    shutil.rmtree(toy_run_copy)
    with pytest.raises(MissingFileError, match="moved or deleted"):
        viewed.open()
    assert viewed.last is first


def test_a_damaged_episode_is_named(toy_run_copy):
    (toy_run_copy / FOLDERS["episodes"] / "000007" / "front.mp4").write_bytes(b"damaged")
    with pytest.raises(CorruptArtifactError, match=r"front\.mp4"):
        ViewedFolder(toy_run_copy).open().motion("7")


def test_unknown_names_and_folders_are_refused(viewed, tmp_path):
    opened = viewed.open()
    with pytest.raises(UnknownNameError):
        opened.motion("../../etc")
    with pytest.raises(UnknownNameError):
        opened.overlay("7", "coverage")
    with pytest.raises(InputError):
        ViewedFolder(tmp_path)


def test_colliders_of_an_episode_lie_on_its_object(viewed):
    opened = viewed.open()
    scene = opened.scene("7")
    assert isinstance(scene, PosableScene)
    camera = opened.motion("7")[0].cameras["front"].camera
    drawn = opened.overlay("7", "colliders")(Moment(scene.rest, 0.0, camera))["collider"]
    center = scene.find_center()
    assert np.linalg.norm(drawn.reshape(-1, 3) - center, axis=1).min() < 0.4
