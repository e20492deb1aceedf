"""A good capture is read; each way a capture can be bad is refused in one sentence."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from aomgen.capture.capture_check import check_capture, check_robot
from aomgen.capture.demo_videos import read_demo_videos
from aomgen.capture.joint_log import check_log
from aomgen.capture.read import read_capture
from aomgen.capture.scan_images import check_scan
from aomgen.core.lens import Lens, undistorter
from aomgen.core.recording import JointLog
from aomgen.errors import (
    AomgenError,
    CalibrationError,
    IncompleteCaptureError,
    InputError,
    MalformedFileError,
    MissingFileError,
    NonFiniteError,
    UnitsError,
    UnsafePathError,
)
from aomgen.io.video import encode_video


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new), "utf-8")


def refuse(folder: Path, kind: type[AomgenError], *words: str) -> None:
    with pytest.raises(kind) as caught:
        read_demo_videos(read_capture(folder))
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


def rewrite_log(folder: Path, change) -> None:
    path = folder / "demo" / "joints.csv"
    lines = path.read_text("utf-8").splitlines()
    rows = [line.split(",") for line in lines[1:]]
    path.write_text("\n".join([lines[0], *(",".join(row) for row in change(rows))]) + "\n", "utf-8")


def test_the_sample_is_read(sample):
    capture = read_capture(sample)
    video = read_demo_videos(capture)["front"]
    assert len(capture.scan_images) == 64
    assert capture.scan_size == (640, 480)
    assert video.frames_srgb.shape == (95, 480, 640, 3)
    assert np.allclose(np.diff(video.times_s), 0.1)
    assert capture.robot.scan_joints == pytest.approx([3.55, -2.2033, 2.4093, 0.2507, 1.3503, 0.0], abs=2e-3)
    assert {prompt.part for prompt in capture.prompts} == {"robot", "static", "moving"}


def test_missing_video(capture_copy):
    (capture_copy / "demo" / "front.mp4").unlink()
    refuse(capture_copy, MissingFileError, "front.mp4", "copy it there")


@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_truncated_video(capture_copy, share):
    path = capture_copy / "demo" / "front.mp4"
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    refuse(capture_copy, MalformedFileError, "front.mp4", "again")


def test_missing_joint_rows(capture_copy):
    rewrite_log(capture_copy, lambda rows: rows[:320] + rows[385:])
    with pytest.raises(IncompleteCaptureError, match=r"joints\.csv: .*between 3.19 s and 3.85 s.*re-export"):
        check_capture(read_capture(capture_copy))


def test_two_missing_rows_are_interpolated(capture_copy):
    rewrite_log(capture_copy, lambda rows: rows[:320] + rows[322:])
    assert len(read_capture(capture_copy).joint_log.times_s) == 1059


def test_nan_joint(capture_copy):
    def spoil(rows):
        rows[10][3] = "nan"
        return rows

    rewrite_log(capture_copy, spoil)
    refuse(capture_copy, NonFiniteError, "row 12", "elbow_joint")


def test_joints_in_degrees(capture_copy):
    def degrees(rows):
        return [[row[0], *(f"{np.degrees(float(value)):.4f}" for value in row[1:7]), row[7]] for row in rows]

    rewrite_log(capture_copy, degrees)
    refuse(capture_copy, UnitsError, "degrees", "radians")


def test_gripper_in_millimetres(capture_copy):
    rewrite_log(capture_copy, lambda rows: [[*row[:7], str(85 * float(row[7]))] for row in rows])
    refuse(capture_copy, UnitsError, "gripper", "0 (open) to 1 (closed)")


def test_log_shorter_than_video(capture_copy):
    rewrite_log(capture_copy, lambda rows: rows[:500])
    refuse(capture_copy, IncompleteCaptureError, "front.mp4", "joint log only")


def test_missing_column(capture_copy):
    edit(capture_copy / "capture.toml", 'gripper = "gripper"', 'gripper = "hand"')
    refuse(capture_copy, MalformedFileError, "no column 'hand'", "shoulder_pan_joint")


def test_one_image_of_another_size(capture_copy):
    path = capture_copy / "scan" / "0007.jpg"
    Image.open(path).resize((320, 240)).save(path)
    refuse(capture_copy, CalibrationError, "0007.jpg", "320 x 240", "one size")


def test_intrinsics_of_another_size(capture_copy):
    edit(capture_copy / "capture.toml", "[600.0, 600.0, 320.0, 240.0]", "[1200.0, 1200.0, 640.0, 480.0]")
    refuse(capture_copy, CalibrationError, "principal point", "640 x 480")


def test_no_prompts(capture_copy):
    path = capture_copy / "capture.toml"
    path.write_text(path.read_text("utf-8").split("[[prompts]]")[0], "utf-8")
    refuse(capture_copy, InputError, "moving", "[[prompts]]")


def test_prompt_outside_the_image(capture_copy):
    edit(capture_copy / "capture.toml", "box = [171.6,", "box = [-171.6,")
    refuse(capture_copy, InputError, "0013.jpg", "outside the image of 640 x 480")


def test_unknown_key_names_the_nearest(capture_copy):
    edit(capture_copy / "capture.toml", "instruction =", "instructions =")
    refuse(capture_copy, MalformedFileError, "did you mean 'instruction'")


def test_path_outside_the_capture(capture_copy):
    edit(capture_copy / "capture.toml", '"demo/front.mp4"', '"../front.mp4"')
    refuse(capture_copy, UnsafePathError, "../front.mp4")


def test_too_few_images(capture_copy):
    for path in sorted((capture_copy / "scan").iterdir())[5:]:
        path.unlink()
    refuse(capture_copy, IncompleteCaptureError, "holds 5 images", "more viewpoints")


def test_not_a_capture(tmp_path):
    refuse(tmp_path, MissingFileError, "capture.toml")


def film(folder: Path, frames: int) -> None:
    """Replace the stills by a video of that many frames, prompted on frames of it."""
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (480, 640, 3)).astype(np.uint8)] * frames
    (folder / "scan.mp4").write_bytes(encode_video(pictures, 30))
    path = folder / "capture.toml"
    text = re.sub(r'image = "00(\d\d)\.jpg"', r'image = "scan_0000\1.png"', path.read_text("utf-8"))
    path.write_text(text.replace('images = "scan"', 'images = "scan.mp4"'), "utf-8")


def test_a_scan_video_is_read(capture_copy):
    film(capture_copy, 70)
    capture = read_capture(capture_copy)
    assert capture.scan_images == ()
    assert capture.scan_size == (640, 480)
    assert {prompt.image for prompt in capture.prompts} >= {"scan_000013.png"}
    assert check_scan(capture) == (70, [])


def test_a_short_scan_video(capture_copy):
    film(capture_copy, 40)
    refuse(capture_copy, IncompleteCaptureError, "scan.mp4", "40 frames", "walk around")


def test_a_prompt_beyond_the_end_of_the_scan_video(capture_copy):
    film(capture_copy, 62)
    edit(capture_copy / "capture.toml", "scan_000013.png", "scan_000063.png")
    refuse(capture_copy, MissingFileError, "scan_000063.png", "scan_000061.png")


def test_a_scan_video_that_is_none(capture_copy):
    (capture_copy / "scan.mp4").write_bytes(b"not a video")
    edit(capture_copy / "capture.toml", 'images = "scan"', 'images = "scan.mp4"')
    refuse(capture_copy, MalformedFileError, "scan.mp4", "not a video")


def test_a_truncated_scan_video(capture_copy):
    film(capture_copy, 70)
    path = capture_copy / "scan.mp4"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(MalformedFileError, match=r"scan\.mp4"):
        check_scan(read_capture(capture_copy))


def test_known_distortion_is_read(capture_copy):
    line = "intrinsics = [600.0, 600.0, 320.0, 240.0]\n\n[[demo"
    edit(capture_copy / "capture.toml", line, line.replace("\n\n", "\ndistortion = [-0.1, 0.02, 0, 0]\n\n"))
    capture = read_capture(capture_copy)
    assert capture.scan_intrinsics is not None
    assert capture.scan_intrinsics.distortion == (-0.1, 0.02, 0, 0)
    assert capture.cameras[0].intrinsics is not None
    assert capture.cameras[0].intrinsics.distortion is None


def test_distortion_that_folds_the_image(capture_copy):
    line = "intrinsics = [600.0, 600.0, 320.0, 240.0]\n\n[[demo"
    edit(capture_copy / "capture.toml", line, line.replace("\n\n", "\ndistortion = [-2.5, 0, 0, 0]\n\n"))
    refuse(capture_copy, CalibrationError, "scan.intrinsics", "folds")


def test_distortion_without_intrinsics(capture_copy):
    line = "intrinsics = [600.0, 600.0, 320.0, 240.0]\n\n[[demo"
    edit(capture_copy / "capture.toml", line, "distortion = [-0.1, 0.02, 0, 0]\n\n[[demo")
    refuse(capture_copy, CalibrationError, "distortion without intrinsics")


def test_a_bent_cameras_frames_are_straightened(capture_copy):
    capture = read_capture(capture_copy)
    lens = Lens(fx=600, fy=600, cx=320, cy=240, width=640, height=480, k1=-0.2)
    bent = replace(capture, cameras=(replace(capture.cameras[0], lens=lens),))
    plain = read_demo_videos(capture)["front"].frames_srgb[0].astype(float)
    straight = read_demo_videos(bent)["front"].frames_srgb[0].astype(float)
    wanted = undistorter(lens)(plain.astype(np.uint8))
    assert np.array_equal(straight, wanted)
    assert np.abs(straight - plain).mean() > 2


def test_exactly_one_robot(capture_copy):
    edit(capture_copy / "capture.toml", 'model = "ur5e_2f85"', 'model = "ur5e_2f85"\nurdf = "robot.urdf"')
    refuse(capture_copy, MalformedFileError, "exactly one of model, urdf, mjcf")


def test_a_robot_file_outside_the_capture(capture_copy):
    edit(capture_copy / "capture.toml", 'model = "ur5e_2f85"', 'urdf = "../robot.urdf"')
    refuse(capture_copy, UnsafePathError, "../robot.urdf")


def test_a_log_in_degrees_is_another_robot_s(capture_copy):
    rewrite_log(
        capture_copy,
        lambda rows: [[row[0], *(str(60 * float(v)) for v in row[1:-1]), row[-1]] for row in rows],
    )
    with pytest.raises(UnitsError):
        check_robot(read_capture(capture_copy))


def test_a_click_may_miss_its_box_by_a_few_pixels(capture_copy):
    path = capture_copy / "capture.toml"
    text = path.read_text()
    box = re.search(r"points = \[\[[^\]]*\]\]\nbox = \[([^\]]*)\]", text)
    assert box is not None
    x0, y0, x1, y1 = (float(value) for value in box[1].split(","))
    near = text.replace(box[0], f"points = [[{x0 - 3}, {y0 + 5}, 1]]\nbox = [{box[1]}]")
    path.write_text(near)
    read_capture(capture_copy)
    far = text.replace(box[0], f"points = [[{x0 - 0.5 * (x1 - x0)}, {(y0 + y1) / 2}, 1]]\nbox = [{box[1]}]")
    path.write_text(far)
    with pytest.raises(InputError, match="outside its box"):
        read_capture(capture_copy)


def test_a_stated_clock_offset_is_compared_with_the_first_video() -> None:
    times = np.arange(500) / 50
    log = JointLog(
        times_s=times, joints=np.sin(times)[:, None], gripper=0 * times, joint_names=("shoulder_pan_joint",)
    )
    check_log(log, Path("joints.csv"), {"front": 6.0, "side": 9.0}, 3.0)
    with pytest.raises(IncompleteCaptureError, match="'front' lasts"):
        check_log(log, Path("joints.csv"), {"front": 9.0, "side": 6.0}, 3.0)
