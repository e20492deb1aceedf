"""A degraded copy of a capture, as phones and labs make them, with the same ground truth."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate

from aomgen.capture.read import read_capture
from aomgen.core.lens import Lens, resample_labels, resampler
from aomgen.core.recording import JointLog, Recording
from aomgen.core.values import Array
from aomgen.io.atomic import stage_folder, write_bytes, write_text
from aomgen.io.images import encode_jpeg, encode_png, read_image, read_labels
from aomgen.io.video import encode_video, read_video
from synthetic.world import joints_csv

# Error of the stated focal length, as a share, and a lens distortion that is not stated.
FOCAL_SHARE, K1 = 0.01, -0.03
# Zero offset of each joint, [rad]: the residual of a calibrated arm.
JOINT_ZERO_RAD = np.deg2rad(0.25)
# Exposure and white balance of a phone with automatic exposure, relative spread of each image.
GAIN_SPREAD, COLOR_SPREAD = 0.12, 0.04
# Share of blurred stills, and the camera's motion during the exposure, as a share of the width.
BLURRED_SHARE, BLUR_SHARE = 0.25, 0.008
JPEG_QUALITY, VIDEO_CRF = 70, 30
# Log: jitter of its time stamps, [s], and share of lost rows.
STAMP_JITTER_S, LOST_SHARE = 0.003, 0.01
# Errors of a person's prompts: boxes by a share of their size, clicks by a number of pixels.
BOX_SHARE, CLICK_PX = 0.03, 3.0

Image8 = NDArray[np.uint8]


def degrade_capture(source: Path, target: Path, rng: np.random.Generator) -> None:
    """Write a degraded copy of a capture of stills with stated intrinsics and one fixed camera.

    Stills and video have one size and one lens. All errors occur at once: stated focal lengths, lens, joint
    zeros, exposure, colors, blur, compression, time stamps and lost rows of the log, boxes and clicks.
    `truth/` is kept, with its label images distorted by the lens.

    Args:
        source: A clean capture.
        target: Created or replaced.
        rng: Draws the errors.

    Raises:
        InputError: The source cannot be read.
        StorageError: A file cannot be written.
    """
    capture = read_capture(source)
    source_pixels = _source_pixels(_lens(capture))
    bend = resampler(source_pixels)
    with stage_folder(target) as folder:
        for path in capture.scan_images:
            image = bend(_moved(read_image(path), rng))
            write_bytes(folder / "scan" / path.name, encode_jpeg(_recolored(image, rng), JPEG_QUALITY))
        camera = capture.cameras[0]
        video = read_video(camera.video)
        frames = [bend(frame) for frame in video.frames_srgb]
        place = folder / camera.video.relative_to(source)
        write_bytes(place, encode_video(frames, round(video.fps), crf=VIDEO_CRF))
        write_text(folder / capture.joint_log_file.relative_to(source), joints_csv(_worse_log(capture, rng)))
        text = (source / "capture.toml").read_text("utf-8")
        write_text(folder / "capture.toml", _worse_toml(text, capture.scan_size, rng))
        if (source / "truth").is_dir():
            _copy_truth(source / "truth", folder / "truth", source_pixels)


def _lens(capture: Recording) -> Lens:
    stated, (width, height) = capture.scan_intrinsics, capture.scan_size
    if stated is None:
        raise ValueError("the clean capture states no intrinsics")
    return Lens(fx=stated.fx, fy=stated.fy, cx=stated.cx, cy=stated.cy, width=width, height=height, k1=K1)


def _source_pixels(lens: Lens) -> Array:
    """Compute the point (H, W, 2) of the undistorted image that every pixel of a distorted one shows, [px].

    Beyond the border, its pixels are repeated.
    """
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    straight = replace(lens, k1=0.0)
    rays = lens.rays(np.stack([u.ravel(), v.ravel()], 1))
    return straight.pixels(rays).reshape(lens.height, lens.width, 2)


def _moved(image: Image8, rng: np.random.Generator) -> Image8:
    """Smear some images along a row or a column."""
    if rng.uniform() > BLURRED_SHARE:
        return image
    length = max(2, round(BLUR_SHARE * image.shape[1]))
    kernel = np.full((length, 1, 1), 1 / length)
    along = kernel if rng.uniform() < 0.5 else kernel.transpose(1, 0, 2)
    return np.round(correlate(image.astype(np.float32), along, mode="nearest")).astype(np.uint8)


def _recolored(image: Image8, rng: np.random.Generator) -> Image8:
    gain = rng.uniform(1 - GAIN_SPREAD, 1 + GAIN_SPREAD) * rng.uniform(1 - COLOR_SPREAD, 1 + COLOR_SPREAD, 3)
    return np.clip(np.round(image * gain), 0, 255).astype(np.uint8)


def _worse_log(capture: Recording, rng: np.random.Generator) -> JointLog:
    log = capture.joint_log
    zeros = JOINT_ZERO_RAD * rng.choice([-1.0, 1.0], log.joints.shape[1])
    # Stamps stay in order.
    jitter = np.clip(STAMP_JITTER_S * rng.standard_normal(len(log.times_s)), -1, 1)
    times = np.maximum.accumulate(log.times_s + jitter) + 1e-4 * np.arange(len(jitter)) / len(jitter)
    kept = rng.uniform(size=len(times)) >= LOST_SHARE
    kept[[0, -1]] = True
    kept &= np.concatenate([[True], np.diff(np.round(times, 4)) > 0])
    return JointLog(
        times_s=times[kept],
        joints=log.joints[kept] + zeros,
        gripper=log.gripper[kept],
        joint_names=log.joint_names,
    )


def _worse_toml(text: str, size: tuple[int, int], rng: np.random.Generator) -> str:
    def numbers(match: re.Match[str]) -> Array:
        return np.array([float(value) for value in match[1].split(",")])

    def focal(match: re.Match[str]) -> str:
        fx, fy, cx, cy = numbers(match)
        return f"intrinsics = [{(1 + FOCAL_SHARE) * fx:.3f}, {(1 + FOCAL_SHARE) * fy:.3f}, {cx}, {cy}]"

    def box(match: re.Match[str]) -> str:
        corners = numbers(match)
        extent = np.tile(corners[2:] - corners[:2], 2)
        moved = corners + BOX_SHARE * extent * rng.uniform(-1, 1, 4)
        low_high = np.clip(moved, 0, np.tile(size, 2))
        return f"box = [{', '.join(f'{value:.1f}' for value in low_high)}]"

    def click(match: re.Match[str]) -> str:
        x, y, label = numbers(match)
        x, y = np.clip(np.array([x, y]) + CLICK_PX * rng.uniform(-1, 1, 2), 0, size)
        return f"points = [[{x:.1f}, {y:.1f}, {label:.0f}]]"

    text = re.sub(r"intrinsics = \[([^\]]*)\]", focal, text)
    text = re.sub(r"box = \[([^\]]*)\]", box, text)
    return re.sub(r"points = \[\[([^\]]*)\]\]", click, text)


def _copy_truth(source: Path, target: Path, source_pixels: Array) -> None:
    shutil.copytree(source, target)
    for path in sorted((target / "masks").glob("*/*.png")):
        write_bytes(path, encode_png(resample_labels(read_labels(path), source_pixels)))
