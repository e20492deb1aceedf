"""Faults of captures from a lab, and the sentence that the check prints for each."""

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageFilter

from aomgen.assets.choice import make_asset
from aomgen.assets.usd_write import write_usd
from aomgen.errors import (
    AomgenError,
    CalibrationError,
    ConfigError,
    IncompleteCaptureError,
    InputError,
    MalformedFileError,
    MissingFileError,
    UnitsError,
)
from aomgen.io.images import encode_png
from aomgen.io.video import encode_video, read_video

SIZE = (320, 240)
# Images of the bundled capture that suffice for the checks; they include the prompted ones.
IMAGES = (
    "0003",
    "0010",
    "0013",
    "0017",
    "0024",
    "0029",
    "0033",
    "0037",
    "0041",
    "0049",
    "0054",
    "0057",
    "0061",
)

Damage = Callable[[Path], object]


@dataclass(frozen=True)
class Case:
    """A change of a capture and the sentence that the user gets: an error, or a warning if `kind` is None."""

    damage: Damage
    kind: type[AomgenError] | None
    words: tuple[str, ...]


def write_small(source: Path, folder: Path) -> None:
    """Write the bundled capture with fewer, smaller images and frames."""
    (folder / "scan").mkdir(parents=True)
    shutil.copytree(source / "demo", folder / "demo")
    for name in IMAGES:
        Image.open(source / "scan" / f"{name}.jpg").resize(SIZE).save(
            folder / "scan" / f"{name}.jpg", quality=93
        )
    frames = read_video(source / "demo" / "front.mp4").frames_srgb[::2]
    film(folder / "demo" / "front.mp4", [np.asarray(Image.fromarray(frame).resize(SIZE)) for frame in frames])
    text = (source / "capture.toml").read_text("utf-8")
    numbers = re.compile(r"(intrinsics = |box = )\[(.*)\]")
    text = numbers.sub(lambda m: f"{m[1]}[{', '.join(str(float(n) / 2) for n in m[2].split(','))}]", text)
    points = re.compile(r"\[\[(\d+\.\d), (\d+\.\d), 1\]\]")
    text = points.sub(lambda m: f"[[{float(m[1]) / 2}, {float(m[2]) / 2}, 1]]", text)
    (folder / "capture.toml").write_text(text, "utf-8")


def film(path: Path, frames: list[np.ndarray]) -> None:
    path.write_bytes(encode_video(frames, 5))


def edit(name: str, old: str, new: str, count: int = -1) -> Damage:
    def damage(folder: Path) -> None:
        text = (folder / name).read_text("utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new, count), "utf-8")

    return damage


def log(change: Callable[[list[list[str]]], list[list[str]]]) -> Damage:
    """Change the rows of the joint log."""

    def damage(folder: Path) -> None:
        path = folder / "demo" / "joints.csv"
        header, *rows = (line.split(",") for line in path.read_text("utf-8").splitlines())
        path.write_text("\n".join(",".join(row) for row in [header, *change(rows)]) + "\n", "utf-8")

    return damage


def times(factor: float) -> Damage:
    return log(lambda rows: [[f"{factor * float(row[0]):.3f}", *row[1:]] for row in rows])


def each_image(change: Callable[[Image.Image], Image.Image], *, first: int = 99) -> Damage:
    def damage(folder: Path) -> None:
        for path in sorted((folder / "scan").iterdir())[:first]:
            change(Image.open(path).convert("RGB")).save(path, quality=93)

    return damage


def truncate(name: str, share: float) -> Damage:
    def damage(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return damage


def scan_film(blur_px: float) -> Damage:
    """Replace the stills by a video of them, prompts included."""

    def damage(folder: Path) -> None:
        stills = [Image.open(folder / "scan" / f"{name}.jpg") for name in IMAGES]
        frames = [np.asarray(still.filter(ImageFilter.GaussianBlur(blur_px))) for still in stills]
        film(folder / "scan.mp4", [frame for frame in frames for _ in range(5)])
        text = (folder / "capture.toml").read_text("utf-8").replace('images = "scan"', 'images = "scan.mp4"')
        number = re.compile(r'image = "(\d{4})\.jpg"')
        text = number.sub(lambda m: f'image = "scan_{5 * IMAGES.index(m[1]):06d}.png"', text)
        (folder / "capture.toml").write_text(text, "utf-8")

    return damage


def turn(name: str) -> Damage:
    """Mark an MP4 as rotated by 90 degrees, as a phone held upright does."""

    def damage(folder: Path) -> None:
        def matrix(*values: float) -> bytes:
            return b"".join(int(value * (1 << 16)).to_bytes(4, "big", signed=True) for value in values)

        path = folder / name
        head, track, rest = path.read_bytes().partition(b"tkhd")
        straight, turned = (matrix(*m, 0, 0, 0) for m in ((1, 0, 0, 0, 1), (0, 1, 0, -1, 0)))
        assert straight in rest
        path.write_bytes(head + track + rest.replace(straight, turned, 1))

    return damage


def masks(label: int, *, size: tuple[int, int] = SIZE, prefix: str = "") -> Damage:
    def damage(folder: Path) -> None:
        (folder / "masks" / "ours").mkdir(parents=True)
        for name in IMAGES:
            labels = np.zeros(size[::-1], np.uint8)
            labels[20:60, 20:60] = label
            (folder / "masks" / "ours" / f"{prefix}{name}.png").write_bytes(encode_png(labels))

    return damage


def both(*damages: Damage) -> Damage:
    return lambda folder: [damage(folder) for damage in damages]


def still_film(folder: Path) -> None:
    film(folder / "demo" / "front.mp4", [read_video(folder / "demo" / "front.mp4").frames_srgb[0]] * 40)


def blurred(image: Image.Image) -> Image.Image:
    return image.filter(ImageFilter.GaussianBlur(2))


def soft(image: Image.Image) -> Image.Image:
    return image.filter(ImageFilter.GaussianBlur(1))


def calibrated(rows: str) -> Damage:
    return edit("capture.toml", "\n\n[demo]", f"\nT_world_cam = [{rows}]\n\n[demo]")


TOML, FRONT = "capture.toml", "demo/front.mp4"
CAMERA = '[[demo.cameras]]\nname = "front"\nvideo = "demo/front.mp4"\n'
CAPTURES = {
    "truncated image": Case(truncate("scan/0017.jpg", 0.7), MalformedFileError, ("0017.jpg", "truncated", "again")),
    "all images blurred": Case(each_image(blurred), IncompleteCaptureError, ("13 of 13", "blurred", "focus")),
    "images without light": Case(
        each_image(lambda image: image.point(lambda v: v // 40)), IncompleteCaptureError, ("13 of 13", "light")
    ),
    "all images soft": Case(each_image(soft), None, ("13 of 13", "blurred")),
    "some images blurred": Case(each_image(blurred, first=2), None, ("2 of 13", "0003.jpg, 0010.jpg")),
    "phone pictures": Case(
        lambda folder: (folder / "scan" / "IMG_1.HEIC").write_bytes(b"ftypheic"),
        MalformedFileError,
        ("IMG_1.HEIC", "export it as JPEG"),
    ),
    "blurred scan video": Case(scan_film(2), IncompleteCaptureError, ("scan.mp4", "blurred")),
    "truncated scan video": Case(
        both(scan_film(0), truncate("scan.mp4", 0.6)), MalformedFileError, ("scan.mp4", "again")
    ),
    "scan video held upright": Case(
        both(scan_film(0), turn("scan.mp4")), CalibrationError, ("scan.intrinsics", "but 320 x 240 ones", "upright")
    ),
    "box with exchanged corners": Case(
        edit(TOML, "box = [85.8, 29.3, 255.6, 205.7]", "box = [255.6, 29.3, 85.8, 205.7]"),
        InputError,
        ("robot prompt on '0013.jpg'", "x0, y0, x1, y1"),
    ),
    "box in shares of the image": Case(
        edit(TOML, "points = [[168.25, 113.25, 1]]\nbox = [111.7, 82.05, 198.95, 143.3]", "box = [0.3, 0.3, 0.6, 0.6]"),
        UnitsError,
        ("moving prompt", "pixels"),
    ),
    "point beside its box": Case(
        edit(TOML, "[[168.25, 113.25, 1]]", "[[113.25, 168.25, 1]]"), InputError, ("(113.25, 168.25)", "outside its box")
    ),
    "label of a point": Case(edit(TOML, "113.25, 1]]", "113.25, 3]]"), InputError, ("neither 1 nor 0",)),
    "points without boxes": Case(
        lambda folder: (folder / TOML).write_text(re.sub(r"box = .*\n", "", (folder / TOML).read_text())),
        InputError,
        ("no prompt with a box for robot and static and moving",),
    ),
    "one prompted image": Case(
        edit(TOML, 'part = "moving"\nimage = "0010.jpg"', 'part = "static"\nimage = "0010.jpg"'),
        None,
        ("0054.jpg", "moving", "second image"),
    ),
    "log in milliseconds": Case(times(1e3), UnitsError, ("joints.csv", "milliseconds?", "divide time_s by 1000")),
    "log in microseconds": Case(times(1e6), UnitsError, ("microseconds?",)),
    "log with 2 Hz": Case(log(lambda rows: rows[::50]), IncompleteCaptureError, ("0.50 s apart", "30 Hz")),
    "log with 15 Hz": Case(log(lambda rows: rows[::7]), None, ("14 rows per second", "less accurate")),
    "log of a resting arm": Case(
        log(lambda rows: [[row[0], *rows[0][1:]] for row in rows]), IncompleteCaptureError, ("no joint that moves",)
    ),
    "log that begins in motion": Case(
        log(lambda rows: [[row[0], *late[1:]] for row, late in zip(rows, rows[700:] + rows[-1:] * 700, strict=True)]),
        None,
        ("moves by", "scan_state"),
    ),
    "gripper reversed": Case(
        log(lambda rows: [[*row[:-1], str(1 - 1.25 * float(row[-1]))] for row in rows]), None, ("reversed",)
    ),
    "known offset of the wrong sign": Case(
        edit(TOML, 'joints = "demo/joints.csv"', 'joints = "demo/joints.csv"\nclock_offset_s = -4.0'),
        IncompleteCaptureError,
        ("clock_offset_s = -4", "leave it out"),
    ),
    "frozen camera": Case(still_film, IncompleteCaptureError, ("front.mp4", "shows no motion")),
    "demonstration of another camera": Case(
        edit(TOML, "160.0, 120.0]\n\n[demo]", "640.0, 360.0]\n\n[demo]"), CalibrationError, ("front", "320 x 240")
    ),
    "two cameras of one name": Case(edit(TOML, CAMERA, CAMERA * 2), MalformedFileError, ("front, front",)),
    "hand-eye calibration in millimetres": Case(
        calibrated("[1, 0, 0, 850.0], [0, 1, 0, -420.0], [0, 0, 1, 900.0], [0, 0, 0, 1]"),
        UnitsError,
        ("T_world_cam", "millimeters?"),
    ),
    "masks of 255": Case(masks(255), MalformedFileError, ("labels 0, 255 only", "2 static")),
    "masks of another size": Case(masks(2, size=(640, 480)), MalformedFileError, ("(640, 480)", "(320, 240)")),
    "masks named otherwise": Case(masks(2, prefix="mask_"), MissingFileError, ("none has the name of", "0003.png")),
    "damaged mask": Case(
        both(masks(2), truncate("masks/ours/0010.png", 0.5)), MalformedFileError, ("0010.png", "cannot be decoded")
    ),
    "a prompted image without mask": Case(
        both(masks(2), lambda folder: (folder / "masks/ours/0010.png").unlink()), None, ("0010.jpg", "empty")
    ),
    "robot file without the log's joints": Case(
        both(
            edit(TOML, 'model = "ur5e_2f85"', 'urdf = "robot.urdf"'),
            lambda folder: (folder / "robot.urdf").write_text("<robot name='r'><link name='base'/></robot>"),
        ),
        InputError,
        ("robot.urdf",),
    ),
    "unknown category": Case(edit(TOML, '"microwave"', '"tool box"'), ConfigError, ("did you mean 'toolbox'?", "--asset")),
    "camera named as the new viewpoint": Case(edit(TOML, 'name = "front"', 'name = "side"'), ConfigError, ("'side'",)),
}  # fmt: skip


def write_tight_usd(path: Path) -> None:
    """Write an asset that opens by 0.1 rad only."""
    asset = make_asset("microwave", 1)
    write_usd(replace(asset, joint=replace(asset.joint, upper=0.1)), path)
