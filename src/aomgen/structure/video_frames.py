"""Selection of frames from a scan video: sharp ones, each with new content.

A frame is selected when the view has moved by `STEP` since the last selected one. The motion is measured on points that are
tracked from frame to frame, so a camera at rest, or with small shakes, adds no frame. The sharpest frame around each selected
one is used.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from av import VideoFrame
from numpy.typing import NDArray

from aomgen.core.progress import Progress, part
from aomgen.core.recording import frame_name
from aomgen.core.values import Array
from aomgen.errors import IncompleteCaptureError, MalformedFileError
from aomgen.io.artifact import read_json
from aomgen.io.atomic import write_json
from aomgen.io.images import read_image, write_image
from aomgen.io.reuse import reuse
from aomgen.io.video import decode_frames, probe_video
from aomgen.structure.tracking import follow, new_tracks, pyramid

FRAMES_FOLDER = "frames"
LISTING = "frames.json"
# Time span of which the sharpest frame is a candidate, [s]: a hand-held camera moves little in this time.
CANDIDATE_S = 0.1
# Width at which sharpness is measured, [px]; motion is measured at half of it.
SHARPNESS_WIDTH = 640
# Share of tracked points below which the view counts as new: half of the previous view is no longer visible.
MIN_KEPT = 0.5
# Motion between selected frames, as a share of the image's width: a fifth of the motion at which half of the view is no longer
# visible.
STEP = 0.05
# Number of frames of a long walk; more are chosen only if the motion between them would exceed `MAX_STEP`.
TARGET = 80
# Least number of different views of a scan.
MIN_FRAMES = 12
# Largest motion between chosen frames, as a share of the width: four fifths of the view remain for matching.
MAX_STEP = 0.2
# A frame less sharp than this share of the median around it is blurred; texture alone varies less.
MIN_SHARPNESS = 0.6
# Time before and after a frame over which that median is taken, [s]: the view is nearly the same.
AROUND_S = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameCandidate:
    """A frame that may be chosen: the sharpest of its time span.

    Attributes:
        index: Number of the frame in the video.
        sharpness: See `sharpness_of`; compared only within one video.
        gray: (h, w) uint8, small.
    """

    index: int
    time_s: float
    sharpness: float
    gray: NDArray[np.uint8]


def extract_frames(video: Path, forced: set[str], folder: Path, progress: Progress) -> dict[str, Path]:
    """Choose frames of a scan video and write them as PNG below `folder`, unless an earlier call has written them.

    Args:
        forced: Names of frames that must be chosen, because they have prompts.
        folder: The stage's folder; the frames are written to `frames/`, their list to `frames.json`.

    Returns:
        Path by name, in the order of time.

    Raises:
        IncompleteCaptureError: Fewer different views than `MIN_FRAMES`.
        InputError: The video cannot be read.
        StorageError: Writing to the disk failed.
    """
    kept = reuse(folder / LISTING, partial(_read_kept, folder))
    if kept is not None:
        return kept
    candidates = list(_candidates(video, part(progress, 0.0, 0.5)))
    chosen = choose_frames(candidates)
    if not len(chosen) >= MIN_FRAMES:
        raise IncompleteCaptureError(
            video,
            f"shows {len(chosen)} different views, at least {MIN_FRAMES} are needed",
            "walk around robot and object while filming",
        )
    written = set(chosen) - _as_forced(chosen, forced)
    later = part(progress, 0.5, 1.0)
    total = probe_video(video).frames
    for index, (_, frame) in enumerate(decode_frames(video)):
        if index in written or frame_name(index) in forced:
            written.add(index)
            later(index / total, "writing frames")
            image_srgb = np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
            write_image(folder / FRAMES_FOLDER / frame_name(index), image_srgb)
    write_json(folder / LISTING, {"frames": sorted(written), "of": total, "looked_at": len(candidates)})
    return _paths(folder, sorted(written))


def _read_kept(folder: Path) -> dict[str, Path]:
    """Return the frames that an earlier call has written.

    Raises:
        InputError: The listing or a frame is damaged.
    """
    listing = read_json(folder / LISTING)
    try:
        paths = _paths(folder, [int(index) for index in listing["frames"]])
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedFileError(folder / LISTING, f"lists no frames ({error!r})") from error
    for path in paths.values():
        read_image(path)
    return paths


def choose_frames(candidates: list[FrameCandidate]) -> list[int]:
    """Choose the frames to keep; return their numbers in ascending order. The docstring of this module describes the criteria."""
    if not candidates:
        return []
    moved, lengths = _select_moved(candidates)
    keep = max(min(TARGET, len(moved)), int(np.ceil(lengths[-1] / MAX_STEP)) + 1)
    picks = np.abs(lengths - np.linspace(0.0, lengths[-1], keep)[:, None]).argmin(1)
    selected = [moved[i] for i in np.unique(picks)]
    sharpness = np.array([item.sharpness for item in candidates])
    times = np.array([item.time_s for item in candidates])
    usual = np.array([np.median(sharpness[np.abs(times - t) <= AROUND_S]) for t in times])
    kept: list[int] = []
    for number, at in enumerate(selected):
        # The range ends halfway to the neighbors on both sides, so that no frame is chosen twice.
        low = 0 if number == 0 else (selected[number - 1] + at) // 2 + 1
        high = len(candidates) - 1 if number == len(selected) - 1 else (at + selected[number + 1]) // 2
        best = low + int(np.argmax(_near(sharpness[low : high + 1], at - low)))
        if sharpness[best] >= MIN_SHARPNESS * usual[best]:
            kept.append(candidates[best].index)
    return kept


def _as_forced(chosen: list[int], forced: set[str]) -> set[int]:
    """Find the chosen frames that have a forced frame nearby: within a third of the distance to a neighbor."""
    found = set()
    for place, number in enumerate(chosen):
        others = [chosen[k] for k in (place - 1, place + 1) if 0 <= k < len(chosen)]
        reach = min(abs(number - other) for other in others) // 3
        if any(frame_name(index) in forced for index in range(number - reach, number + reach + 1)):
            found.add(number)
    return found


def _near(sharpness: Array, middle: int) -> Array:
    """Weight the sharpness slightly towards the middle, which decides between equal values."""
    distance = np.abs(np.arange(len(sharpness)) - middle) / max(1, len(sharpness))
    return sharpness * (1 - 0.1 * distance)


def _select_moved(candidates: list[FrameCandidate]) -> tuple[list[int], Array]:
    """Find the candidates before which the view has moved by one step, and the path length at each.

    The path length is the sum of the motions, as shares of the width; if tracking fails, the motion counts as the largest step.
    """
    width = candidates[0].gray.shape[1]
    key = before = pyramid(candidates[0].gray)
    tracks, moved, lengths = new_tracks(key), [0], [0.0]
    for index, candidate in enumerate(candidates[1:], 1):
        now = pyramid(candidate.gray)
        tracks = follow(tracks, key, before, now)
        before = now
        if tracks.shift_px >= STEP * width or tracks.kept < MIN_KEPT:
            lost = tracks.kept < MIN_KEPT
            lengths.append(lengths[-1] + (MAX_STEP if lost else tracks.shift_px / width))
            key, tracks = now, new_tracks(now)
            moved.append(index)
    return moved, np.array(lengths)


def _candidates(video: Path, progress: Progress) -> Iterator[FrameCandidate]:
    total = probe_video(video).frames
    best: FrameCandidate | None = None
    for index, (time_s, frame) in enumerate(decode_frames(video)):
        progress(index / total, "searching for sharp frames")
        gray = _gray(frame, SHARPNESS_WIDTH)
        found = FrameCandidate(
            index=index,
            time_s=time_s,
            sharpness=sharpness_of(gray),
            gray=pyramid(gray)[1].round().astype(np.uint8),
        )
        if best is not None and int(time_s / CANDIDATE_S) != int(best.time_s / CANDIDATE_S):
            yield best
            best = found
        elif best is None or found.sharpness > best.sharpness:
            best = found
    if best is not None:
        yield best


def sharpness_of(gray: NDArray[np.uint8]) -> float:
    """Compute the energy of the second differences of an image (H, W), normalized to mean brightness 1."""
    image = gray.astype(np.float32)
    second = np.square(np.diff(image, 2, axis=0)).mean() + np.square(np.diff(image, 2, axis=1)).mean()
    return float(second / max(float(image.mean()) ** 2, 1.0))


def _gray(frame: VideoFrame, width: int) -> NDArray[np.uint8]:
    width = min(width, frame.width)
    height = round(frame.height * width / frame.width / 2) * 2
    small = frame.reformat(width=width, height=height, format="gray8", interpolation="AREA", threads=1)
    return np.asarray(small.to_ndarray(), np.uint8)


def _paths(folder: Path, indices: list[int]) -> dict[str, Path]:
    return {frame_name(index): folder / FRAMES_FOLDER / frame_name(index) for index in indices}
