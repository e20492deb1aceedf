"""Files appear whole or not at all; readers refuse what they should."""

import json

import numpy as np
import pytest
from PIL import Image

from aomgen.errors import (
    LimitExceededError,
    MalformedFileError,
    MissingFileError,
    StorageError,
    UnsafePathError,
)
from aomgen.io.artifact import read_json
from aomgen.io.atomic import remove_staging, stage_folder, write_bytes, write_json
from aomgen.io.images import image_size, read_image, read_labels, write_image
from aomgen.io.paths import resolve_inside
from aomgen.io.video import encode_video, read_video


def test_a_failed_folder_leaves_the_old_one(tmp_path):
    with stage_folder(tmp_path / "x") as folder:
        (folder / "a").write_text("1")
    with pytest.raises(KeyError), stage_folder(tmp_path / "x") as folder:
        (folder / "a").write_text("2")
        raise KeyError
    assert (tmp_path / "x" / "a").read_text() == "1"
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def test_staging_of_a_killed_run_is_removed(tmp_path):
    (tmp_path / ".staging-1").mkdir()
    (tmp_path / ".staging-2").write_text("")
    remove_staging(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_an_unwritable_place_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot be written"):
        write_bytes(tmp_path / "file" / "below", b"")


def test_json_round_trip_and_refusals(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"x": np.arange(3), "y": np.float32(0.5)})
    assert read_json(path) == {"x": [0, 1, 2], "y": 0.5}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"x": float("nan")})
    path.write_text('{"x": NaN}')
    with pytest.raises(MalformedFileError, match="NaN"):
        read_json(path)
    path.write_text("[" * 100_000)
    with pytest.raises(MalformedFileError):
        read_json(path)
    with pytest.raises(MissingFileError):
        read_json(tmp_path / "b.json")
    with pytest.raises(LimitExceededError):
        read_json(path, max_bytes=10)
    assert json.loads("1") == 1


def test_images_round_trip_and_turn_by_exif(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    write_image(tmp_path / "a.png", image)
    assert np.array_equal(read_image(tmp_path / "a.png"), image)
    turned = Image.fromarray(image)
    exif = turned.getexif()
    exif[0x0112] = 6
    turned.save(tmp_path / "b.png", exif=exif)
    assert image_size(tmp_path / "b.png") == (20, 30)
    assert np.array_equal(read_image(tmp_path / "b.png"), np.rot90(image, -1))
    (tmp_path / "c.png").write_bytes(b"no image")
    with pytest.raises(MalformedFileError, match=r"c\.png"):
        read_image(tmp_path / "c.png")
    with pytest.raises(MalformedFileError, match="one 8-bit channel"):
        read_labels(tmp_path / "a.png")


def test_paths_stay_inside(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a").write_text("")
    (tmp_path / "b").write_text("")
    (tmp_path / "in" / "link").symlink_to(tmp_path / "b")
    toml = tmp_path / "in" / "x.toml"
    assert resolve_inside(tmp_path / "in", "a", named_by=toml).name == "a"
    for bad in ("../b", str(tmp_path / "b"), "http://a/b", "link"):
        with pytest.raises(UnsafePathError):
            resolve_inside(tmp_path / "in", bad, named_by=toml)
    with pytest.raises(MissingFileError):
        resolve_inside(tmp_path / "in", "c", named_by=toml)


def test_video_round_trip_keeps_count_times_and_colors(tmp_path):
    ramp = np.linspace(30, 200, 32).astype(np.uint8)
    frames = [np.stack([np.tile(ramp, (24, 1)) + shift] * 3, -1).astype(np.uint8) for shift in range(12)]
    data = encode_video(frames, 10, crf=10)
    assert data == encode_video(frames, 10, crf=10), "same frames, same bytes"
    (tmp_path / "a.mp4").write_bytes(data)
    video = read_video(tmp_path / "a.mp4")
    assert np.allclose(video.times_s, np.arange(12) / 10)
    assert np.abs(video.frames_srgb.astype(int) - np.stack(frames)).mean() < 3
    (tmp_path / "b.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(MalformedFileError):
        read_video(tmp_path / "b.mp4")


@pytest.mark.parametrize("seed", range(3, 8))
def test_videos_do_not_depend_on_what_memory_held_before(seed):
    rng = np.random.default_rng(seed)
    ramp = 3 * np.add.outer(np.arange(48), np.arange(48))[..., None] + 40 * np.arange(3)
    noise = [rng.integers(0, 10, (48, 48, 3), np.uint8) for _ in range(8)]
    frames = [((ramp + 9 * t) % 256 // 2 + noise[t]).astype(np.uint8) for t in range(8)]
    made = set()
    for _ in range(30):
        garbage = [np.full(size, rng.integers(256), np.uint8) for size in rng.integers(64, 100_000, 100)]
        while garbage:
            garbage.pop(int(rng.integers(len(garbage))))
        made.add(encode_video(frames, 10))
    assert len(made) == 1
