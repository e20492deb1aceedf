"""Frames of a scan video: sharp, different from each other, overlapping, and found again after a kill."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from aomgen.core.progress import silent
from aomgen.core.recording import frame_name
from aomgen.errors import IncompleteCaptureError, MalformedFileError
from aomgen.io.images import read_image
from aomgen.io.reuse import StoredFileWarning
from aomgen.io.video import encode_video
from aomgen.structure import video_frames as frames_module
from aomgen.structure.tracking import follow, new_tracks, pyramid
from aomgen.structure.video_frames import (
    choose_frames,
    extract_frames,
    sharpness_of,
)

WIDTH, HEIGHT = 160, 120
# A walk at 30 frames a second: 3 px a frame, two seconds of trembling on the spot, on again.
PATH = np.concatenate([np.arange(0, 180, 3.0), np.full(60, 180.0), np.arange(180, 360, 3.0)])
STANDING = range(62, 118)
BLURRED = range(150, 156)


@pytest.fixture(scope="module")
def walk() -> list[np.ndarray]:
    """Pictures (H, W, 3) of a long wall, some of them blurred, all a little noisy."""
    rng = np.random.default_rng(0)
    wall = gaussian_filter(rng.random((HEIGHT + 20, 560)), 1.5)
    wall = 255 * (wall - wall.min()) / np.ptp(wall)
    pictures = []
    for index, x in enumerate(PATH):
        dx, dy = (rng.normal(0, 0.5, 2) if index in STANDING else (0.0, 0.0)) + np.array([0.4, 10.0])
        whole = int(x)
        view = shift(wall[:, whole : whole + WIDTH + 10], (-dy, -dx), order=1, mode="nearest")
        view = view[:HEIGHT, :WIDTH]
        if index in BLURRED:
            view = gaussian_filter(view, (0, 5))
        noisy = view + rng.normal(0, 2, view.shape)
        pictures.append(np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, 2))
    return pictures


@pytest.fixture(scope="module")
def video(walk, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("walk") / "scan.mp4"
    path.write_bytes(encode_video(walk, 30))
    return path


def test_points_are_followed_to_a_tenth_of_a_pixel(walk):
    first, second = pyramid(walk[3][..., 0]), pyramid(walk[5][..., 0])
    tracks = follow(new_tracks(first), first, first, second)
    moved = (tracks.now - tracks.start)[tracks.alive]
    assert tracks.kept > 0.7
    assert np.abs(np.median(moved, axis=0) - [-6, 0]).max() < 0.1


def test_points_on_something_else_are_lost(walk):
    first, other = pyramid(walk[3][..., 0]), pyramid(walk[100][..., 0])
    assert follow(new_tracks(first), first, first, other).kept < 0.2


def test_chosen_frames_are_sharp_and_none_is_there_twice(video, tmp_path):
    names = extract_frames(video, set(), tmp_path, silent)
    chosen = [int(Path(name).stem.split("_")[1]) for name in names]
    assert chosen == sorted(set(chosen))
    assert len([index for index in chosen if index in STANDING]) <= 1
    assert not any(index in BLURRED for index in chosen)
    steps = np.diff(PATH[chosen]) / WIDTH
    # Candidates lie three frames (6 % of the width) apart; the blurred stretch is stepped over.
    assert np.median(steps) == pytest.approx(0.07, abs=0.03)
    assert steps.max() < 0.3


def test_a_long_walk_is_thinned_but_never_beyond_the_largest_step(video, tmp_path, monkeypatch):
    monkeypatch.setattr(frames_module, "TARGET", 4)
    monkeypatch.setattr(frames_module, "MIN_FRAMES", 4)
    few = extract_frames(video, set(), tmp_path / "few", silent)
    chosen = [int(Path(name).stem.split("_")[1]) for name in few]
    steps = np.diff(PATH[chosen]) / WIDTH
    assert len(few) < 20
    assert steps.max() < 0.45


def test_prompted_frames_are_always_there(video, tmp_path):
    names = extract_frames(video, {frame_name(80), frame_name(152)}, tmp_path, silent)
    assert {frame_name(80), frame_name(152)} <= set(names)
    assert list(names) == sorted(names)
    image = read_image(names[frame_name(80)])
    assert image.shape == (HEIGHT, WIDTH, 3)


def test_a_prompted_frame_takes_the_place_of_the_chosen_one_beside_it(video, tmp_path):
    plain = list(extract_frames(video, set(), tmp_path / "plain", silent))
    beside = {frame_name(int(Path(name).stem.split("_")[1]) + 1) for name in plain[3:6]}
    names = set(extract_frames(video, beside, tmp_path / "prompted", silent))
    assert beside <= names
    assert len(names) == len(plain)


def test_a_second_call_reads_what_the_first_one_wrote(video, tmp_path, monkeypatch):
    first = extract_frames(video, set(), tmp_path, silent)
    monkeypatch.setattr(frames_module, "decode_frames", lambda path: pytest.fail("decoded again"))
    assert extract_frames(video, set(), tmp_path, silent) == first


def test_a_kill_before_the_listing_starts_over(video, tmp_path):
    first = extract_frames(video, set(), tmp_path, silent)
    (tmp_path / "frames.json").unlink()
    next(iter(first.values())).write_bytes(b"half")
    again = extract_frames(video, set(), tmp_path, silent)
    assert again == first
    assert read_image(next(iter(again.values()))).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("file", ["frames.json", "a frame"])
def test_damage_starts_over_with_one_warning(video, tmp_path, file):
    first = extract_frames(video, set(), tmp_path, silent)
    path = tmp_path / file if file == "frames.json" else max(first.values())
    intact = path.read_bytes()
    path.write_bytes(intact[: len(intact) // 2])
    with pytest.warns(StoredFileWarning, match=r"frames\.json: cannot be reused") as warned:
        assert extract_frames(video, set(), tmp_path, silent) == first
    assert len(warned) == 1
    assert path.read_bytes() == intact


def test_a_video_from_one_spot_is_refused(walk, tmp_path):
    path = tmp_path / "still.mp4"
    path.write_bytes(encode_video([walk[index] for index in STANDING] * 2, 30))
    with pytest.raises(IncompleteCaptureError, match="different views"):
        extract_frames(path, set(), tmp_path, silent)
    assert not (tmp_path / "frames.json").exists()


def test_a_truncated_video_is_refused(video, tmp_path):
    path = tmp_path / "cut.mp4"
    path.write_bytes(video.read_bytes()[: video.stat().st_size * 2 // 3])
    with pytest.raises(MalformedFileError, match=r"cut\.mp4"):
        extract_frames(path, set(), tmp_path, silent)


def test_sharpness_falls_with_blur_and_not_with_exposure(walk):
    sharp = walk[10][..., 0]
    assert sharpness_of((0.7 * sharp).astype(np.uint8)) == pytest.approx(sharpness_of(sharp), rel=0.05)
    assert sharpness_of(gaussian_filter(sharp, 2)) < 0.3 * sharpness_of(sharp)


def test_nothing_to_choose_from():
    assert choose_frames([]) == []
