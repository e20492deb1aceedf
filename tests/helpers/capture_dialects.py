"""Valid captures as other programs write them, and the output of `aomgen check` for each.

A dialect changes files of a capture without changing what was recorded. `words` are in one of the warnings; a
dialect without words is accepted in silence. `refused` names what has to be asked for.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.stream import Disposition
from av.video.stream import VideoStream
from PIL import Image

from aomgen.io.video import read_video
from broken_captures import IMAGES, Damage, both, edit

LOG, TOML, FRONT = "demo/joints.csv", "capture.toml", "demo/front.mp4"
Rows = list[list[str]]


@dataclass(frozen=True)
class Dialect:
    """A change of the files and the expected output.

    Attributes:
        change: Rewrites files of a capture's folder.
        words: Words of the expected warning; empty if there is none.
        refused: Whether the words are those of an error.
        log, video, scan: Whether the log, the video, or the images that are read equal the original ones.
    """

    change: Damage
    words: tuple[str, ...] = ()
    refused: bool = False
    log: bool = True
    video: bool = True
    scan: bool = True


def table(change: Callable[[list[str], Rows], tuple[list[str], Rows]]) -> Damage:
    """Change the header and the rows of the log; the file remains comma separated."""
    return text(lambda header, rows: write(*change(header, rows)))


def write(header: list[str], rows: Rows, separator: str = ",", end: str = "\n") -> str:
    return end.join(separator.join(row) for row in [header, *rows]) + end


def text(change: Callable[[list[str], Rows], str], encoding: str = "utf-8") -> Damage:
    """Write the log again from its header and rows."""

    def damage(folder: Path) -> None:
        lines = (folder / LOG).read_text("utf-8").splitlines()
        header, *rows = (line.split(",") for line in lines)
        (folder / LOG).write_bytes(change(header, rows).encode(encoding))

    return damage


def times(name: str, write_time: Callable[[float], str]) -> Damage:
    """Rename the time column and write each time in another format."""
    return table(
        lambda header, rows: ([name, *header[1:]], [[write_time(float(r[0])), *r[1:]] for r in rows])
    )


def gripper(convert: Callable[[float], float], stated: str = "") -> Damage:
    """Write the gripper in another unit, and state its range if one is given."""

    def write_gripper(header: list[str], rows: Rows) -> tuple[list[str], Rows]:
        return header, [[*row[:-1], f"{convert(float(row[-1])):.6f}"] for row in rows]

    state = edit(TOML, 'gripper = "gripper"', f'gripper = "gripper"\ngripper_range = {stated}')
    return both(table(write_gripper), state) if stated else table(write_gripper)


def wrapped(column: int, low: float) -> Damage:
    """Keep a joint within one turn from `low` on, as encoders do."""

    def wrap(header: list[str], rows: Rows) -> tuple[list[str], Rows]:
        values = [low + (float(row[column]) - low) % (2 * np.pi) for row in rows]
        return header, [
            [*row[:column], f"{value:.6f}", *row[column + 1 :]]
            for row, value in zip(rows, values, strict=True)
        ]

    return table(wrap)


def crossing(column: int, at: float) -> Damage:
    """Move a joint by whole turns and wrap it where its motion passes a value."""
    return wrapped(column, at)


def resent(every: int) -> Callable[[list[str], Rows], tuple[list[str], Rows]]:
    def repeat(header: list[str], rows: Rows) -> tuple[list[str], Rows]:
        return header, [row for k, row in enumerate(rows) for _ in range(1 + (k % every == 0))]

    return repeat


def swapped(header: list[str], rows: Rows) -> tuple[list[str], Rows]:
    rows = list(rows)
    rows[200], rows[201] = rows[201], rows[200]
    return header, rows


def dense(period_s: float) -> Callable[[list[str], Rows], tuple[list[str], Rows]]:
    """Interpolate the log at another rate."""

    def resample(header: list[str], rows: Rows) -> tuple[list[str], Rows]:
        values = np.array(rows, float)
        moments = np.arange(values[0, 0], values[-1, 0], period_s)
        columns = [np.interp(moments, values[:, 0], column) for column in values.T]
        return header, [[f"{value:.6f}" for value in row] for row in np.stack(columns, 1)]

    return resample


def jittered(header: list[str], rows: Rows) -> tuple[list[str], Rows]:
    """Sample rows at the times at which a loaded driver sends them: up to 40 ms apart."""
    rng = np.random.default_rng(5)
    values = np.array(rows, float)
    moments = values[0, 0] + np.cumsum(rng.choice([0.004, 0.01, 0.04], 2000, p=[0.5, 0.4, 0.1]))
    moments = moments[moments < values[-1, 0]]
    columns = [np.interp(moments, values[:, 0], column) for column in values.T]
    return header, [[f"{value:.6f}" for value in row] for row in np.stack(columns, 1)]


def without(first: int, last: int) -> Damage:
    return table(lambda header, rows: (header, rows[:first] + rows[last:]))


def video(
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    options: dict[str, str] | None = None,
    keep: Callable[[int], bool] = lambda k: True,
    lead: int = 0,
    turn: int = 0,
    aspect: Fraction | None = None,
    setup: Callable[[VideoStream], None] = lambda stream: None,
    cover: bool = False,
    container: str = "mp4",
) -> Damage:
    """Encode the demonstration's video again.

    Args:
        keep: Frames that are written, at their original times.
        lead: Frames before the first that an edit list hides.
        turn: Store the frames turned anticlockwise by so many degrees, and a display matrix that turns them back.
        aspect: Width of a stored pixel over its height; the frames are stored that much narrower.
        setup: Changes the stream's colors.
        cover: Put a cover image before the video.
    """

    def damage(folder: Path) -> None:
        source = read_video(folder / FRONT)
        frames = np.concatenate([np.repeat(source.frames_srgb[:1], lead, 0), source.frames_srgb])
        step_ms = round(1000 / source.fps)
        buffer = io.BytesIO()
        with av.open(buffer, "w", format=container, options=options or {}) as target:
            image = _cover(target) if cover else None
            stream = target.add_stream(codec, rate=round(source.fps), options={"crf": "4", "bf": "0"})
            frames = [np.rot90(frame, turn // 90) for frame in frames]
            height, width = frames[0].shape[:2]
            stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
            stream.codec_context.time_base = Fraction(1, 1000)
            if turn:
                stream.set_display_rotation(-turn)
            if aspect:
                stream.width = round(width / aspect / 2) * 2
                stream.sample_aspect_ratio = stream.codec_context.sample_aspect_ratio = aspect
            setup(stream)
            if image is not None:
                target.mux(image)
            for k, frame in enumerate(frames):
                if k >= lead and not keep(k - lead):
                    continue
                shot = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
                context = stream.codec_context
                shot = shot.reformat(
                    format=pix_fmt, width=stream.width, interpolation="BICUBIC",
                    dst_colorspace=context.colorspace, dst_color_range=context.color_range,
                )  # fmt: skip
                shot.pts, shot.time_base = step_ms * (k - lead), Fraction(1, 1000)
                target.mux(stream.encode(shot))
            target.mux(stream.encode(None))
        (folder / FRONT).write_bytes(buffer.getvalue())

    return damage


def _cover(target: av.container.OutputContainer) -> av.Packet:
    """Add a JPEG as first stream, as phones and players do; return the packet to write first."""
    stream = target.add_stream("mjpeg", rate=1)
    stream.width = stream.height = 64
    stream.pix_fmt = "yuvj420p"
    stream.disposition = Disposition.attached_pic
    frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 90, np.uint8), format="rgb24")
    (packet,) = stream.encode(frame.reformat(format="yuvj420p"))
    return packet


def full_range(stream: VideoStream) -> None:
    stream.codec_context.color_range = 2


def colors_709(stream: VideoStream) -> None:
    stream.codec_context.colorspace = 1


def hlg(stream: VideoStream) -> None:
    context = stream.codec_context
    context.color_trc, context.color_primaries, context.colorspace = 18, 9, 9


def images(change: Callable[[Image.Image, int], tuple[Image.Image, str, dict]]) -> Damage:
    """Write each scan image again: the image, its suffix and the options of its format."""

    def damage(folder: Path) -> None:
        manifest = (folder / TOML).read_text("utf-8")
        for number, name in enumerate(IMAGES):
            path = folder / "scan" / f"{name}.jpg"
            image, suffix, options = change(Image.open(path).convert("RGB"), number)
            path.unlink()
            image.save(path.with_suffix(suffix), **options)
            manifest = manifest.replace(f'"{name}.jpg"', f'"{name}{suffix}"')
        (folder / TOML).write_text(manifest, "utf-8")

    return damage


def sixteen_bits(image: Image.Image, number: int) -> tuple[Image.Image, str, dict]:
    return Image.fromarray(np.asarray(image.convert("L"), np.uint16) * 257), ".png", {}


def twelve_bits(image: Image.Image, number: int) -> tuple[Image.Image, str, dict]:
    return Image.fromarray(np.asarray(image.convert("L"), np.uint16) * 16), ".png", {}


def palette(image: Image.Image, number: int) -> tuple[Image.Image, str, dict]:
    return image.quantize(256), ".png", {}


def grey_alpha(image: Image.Image, number: int) -> tuple[Image.Image, str, dict]:
    return image.convert("L").convert("LA"), ".png", {}


def exif(orientation: int, *, rotate: int) -> Callable[[Image.Image, int], tuple[Image.Image, str, dict]]:
    """Store images rotated, with the EXIF orientation that undoes the rotation."""

    def turn(image: Image.Image, number: int) -> tuple[Image.Image, str, dict]:
        tags = image.getexif()
        tags[0x0112] = orientation
        return image.rotate(rotate, expand=True), ".jpg", {"exif": tags, "quality": 95}

    return turn


def some_turned(image: Image.Image, number: int) -> tuple[Image.Image, str, dict]:
    """Store half of the images upright, and half rotated by EXIF to another shape."""
    tags = image.getexif()
    tags[0x0112] = 6
    return image, ".jpg", {"exif": tags} if number % 2 else {}


def into_subfolder(folder: Path) -> None:
    (folder / "scan" / "100CANON").mkdir()
    for path in list((folder / "scan").glob("*.jpg")):
        path.rename(folder / "scan" / "100CANON" / path.name)


def iso(time_s: float) -> str:
    return datetime.fromtimestamp(1_790_000_000 + time_s, UTC).isoformat()


DIALECTS = {
    # Text of the log.
    "comma": Dialect(text(write)),
    "semicolon": Dialect(text(lambda h, r: write(h, r, ";"))),
    "tab": Dialect(text(lambda h, r: write(h, r, "\t"))),
    "vertical bar": Dialect(text(lambda h, r: write(h, r, " | "))),
    "spaces": Dialect(text(lambda h, r: write(h, r, "  "))),
    "comma and space": Dialect(text(lambda h, r: write(h, r, ", "))),
    "decimal comma and semicolon": Dialect(text(lambda h, r: write(h, [[v.replace(".", ",") for v in x] for x in r], ";"))),
    "decimal comma and tab": Dialect(text(lambda h, r: write(h, [[v.replace(".", ",") for v in x] for x in r], "\t"))),
    "quoted fields": Dialect(text(lambda h, r: write([f'"{n}"' for n in h], [[f'"{v}"' for v in x] for x in r]))),
    "quoted decimal commas": Dialect(text(lambda h, r: write(h, [['"' + v.replace(".", ",") + '"' for v in x] for x in r]))),
    "exponents": Dialect(table(lambda h, r: (h, [[f"{float(v):.8e}" for v in x] for x in r]))),
    "Windows line ends": Dialect(text(lambda h, r: write(h, r, end="\r\n"))),
    "old Macintosh line ends": Dialect(text(lambda h, r: write(h, r, end="\r"))),
    "byte order mark": Dialect(text(write, "utf-8-sig")),
    "UTF-16": Dialect(text(write, "utf-16")),
    "Latin-1": Dialect(text(lambda h, r: write([*h, "Kraft [µN]"], [[*x, "0"] for x in r]), "latin-1")),
    "separator declared": Dialect(text(lambda h, r: "sep=;\n" + write(h, r, ";"))),
    "no last line end": Dialect(text(lambda h, r: write(h, r).rstrip())),
    "blank last line": Dialect(text(lambda h, r: write(h, r) + "\n")),
    "blank lines": Dialect(text(lambda h, r: write(h, r).replace("\n", "\n\n"))),
    "a line of separators": Dialect(table(lambda h, r: (h, [*r, [""] * len(h)]))),
    "trailing separators": Dialect(text(lambda h, r: write(h, [[*x, ""] for x in r]))),
    "comment before the header": Dialect(text(lambda h, r: "# UR5e, lab 2\n" + write(h, r)), log=True),
    "comments between rows": Dialect(table(lambda h, r: (h, [*r[:50], ["# start"], *r[50:]])), ("1 comment line",)),
    "header as a comment": Dialect(text(lambda h, r: "# " + write(h, r))),
    "header repeated": Dialect(table(lambda h, r: (h, [*r[:50], h, *r[50:]])), ("1 repeated header",)),
    "last row cut": Dialect(text(lambda h, r: write(h, [*r, r[-1][:3]])), ("last row", "3 of 8 fields")),
    # Columns of the log.
    "columns in another order": Dialect(table(lambda h, r: (h[::-1], [x[::-1] for x in r]))),
    "more columns": Dialect(table(lambda h, r: (["force", *h, "effort"], [["1.5", *x, "nan"] for x in r]))),
    "column names with spaces": Dialect(table(lambda h, r: ([f" {n} " for n in h], r))),
    # Time of the log.
    "timestamp": Dialect(times("timestamp", str), ("'timestamp'", "seconds")),
    "Time (s)": Dialect(times("Time (s)", str), ("seconds",)),
    "time_ms": Dialect(times("time_ms", lambda t: f"{1e3 * t:.3f}"), ("milliseconds",)),
    "timestamp in milliseconds": Dialect(times("timestamp", lambda t: f"{1e3 * t:.2f}"), ("milliseconds",)),
    "timestamp in microseconds": Dialect(times("timestamp", lambda t: f"{1e6 * t:.0f}"), ("microseconds",)),
    "nanoseconds of ROS": Dialect(times("%time", lambda t: f"{1_790_000_000_000_000_000 + round(1e9 * t)}"), ("nanoseconds",)),
    "seconds and nanoseconds": Dialect(
        table(lambda h, r: (["stamp.sec", "stamp.nanosec", *h[1:]],
                            [[str(int(100 + float(x[0]))), f"{round(1e9 * (float(x[0]) % 1)):.0f}", *x[1:]] for x in r])),
        ("'stamp.sec' with 'stamp.nanosec'",),
    ),
    "seconds since 1970": Dialect(times("time_s", lambda t: f"{1_790_000_000 + t:.4f}")),
    "dates of ISO 8601": Dialect(times("timestamp", iso), ("seconds",)),
    "time that starts below zero": Dialect(times("time_s", lambda t: f"{t - 3:.4f}")),
    "time_s in milliseconds": Dialect(times("time_s", lambda t: f"{1e3 * t:.2f}"), ("milliseconds?",), refused=True),
    "500 Hz": Dialect(table(dense(0.002))),
    "500 Hz with a gap of 8 ms": Dialect(both(table(dense(0.002)), without(2000, 2003))),
    "1 kHz": Dialect(table(dense(0.001))),
    "40 Hz": Dialect(table(dense(0.025))),
    "driver's jitter": Dialect(table(jittered)),
    "gap of 0.2 s": Dialect(without(400, 419), ("1 gaps of more than 0.1 s",)),
    "gap of 0.4 s": Dialect(without(400, 439), ("0.40 s apart",), refused=True),
    "packets sent twice": Dialect(table(resent(50)), ("repeated a time stamp",)),
    "packets out of order": Dialect(table(swapped), ("not in the order of time",)),
    "stamps rounded to 20 ms": Dialect(times("time_s", lambda t: f"{int(50 * t) / 50:.2f}"), ("repeated a time stamp",)),
    "two recordings in one file": Dialect(table(lambda h, r: (h, [*r, *r])), ("time decreases",), refused=True),
    # Angles of the log.
    "wrapped to half turns": Dialect(wrapped(1, -np.pi), ("shoulder_pan_joint", "unwrapped")),
    "wrapped to whole turns": Dialect(wrapped(6, 0.0), ("wrist_3_joint", "unwrapped")),
    "degrees": Dialect(
        table(lambda h, r: (h, [[x[0], *(f"{np.degrees(float(v)):.4f}" for v in x[1:-1]), x[-1]] for x in r])),
        ("degrees?",), refused=True,
    ),
    # Gripper of the log.
    "gripper of 0..255": Dialect(gripper(lambda g: 255 * g), ("0..255",), refused=True),
    "gripper of 0..255, stated": Dialect(gripper(lambda g: 255 * g, "[0, 255]")),
    "gripper in per cent": Dialect(gripper(lambda g: 100 * g), ("percent",), refused=True),
    "gripper in per cent, stated": Dialect(gripper(lambda g: 100 * g, "[0, 100]")),
    "opening in metres": Dialect(gripper(lambda g: 0.085 * (1 - g)), ("meters?", "gripper_range"), refused=True),
    "opening in metres, stated": Dialect(gripper(lambda g: 0.085 * (1 - g), "[0.085, 0.0]")),
    "closing in metres": Dialect(gripper(lambda g: 0.085 * g), ("meters?",), refused=True),
    "angle in radians, stated": Dialect(gripper(lambda g: 0.8 * g, "[0, 0.8]")),
    "gripper reversed": Dialect(gripper(lambda g: 1 - g), ("reversed", "gripper_range = [1, 0]"), log=False),
    "gripper reversed, stated": Dialect(gripper(lambda g: 1 - g, "[1, 0]")),
    "gripper that stays open": Dialect(gripper(lambda g: 0.003), log=False),
    # Video.
    "trimmed by an edit list": Dialect(video(lead=20)),
    "variable rate": Dialect(video(keep=lambda k: k % 6 != 4)),
    "cover image first": Dialect(video(cover=True)),
    "Matroska": Dialect(video(container="matroska")),
    "turned by 90 degrees": Dialect(video(turn=90), ("turned upright", "320 x 240")),
    "turned by 180 degrees": Dialect(video(turn=180), ("turned upright",)),
    "turned by 270 degrees": Dialect(video(turn=270), ("turned upright",)),
    "wide pixels": Dialect(video(aspect=Fraction(4, 3)), ("square pixels",)),
    "full range": Dialect(video(setup=full_range)),
    "BT.709": Dialect(video(setup=colors_709)),
    "10 bits": Dialect(video(pix_fmt="yuv420p10le")),
    "HLG of a phone": Dialect(video(pix_fmt="yuv420p10le", setup=hlg), ("tone-mapped from HLG",), video=False),
    "no subsampling": Dialect(video(pix_fmt="yuv444p")),
    "AV1": Dialect(video(codec="libsvtav1")),
    # Scan.
    "PNG": Dialect(images(lambda image, number: (image, ".png", {}))),
    "suffix in capitals": Dialect(images(lambda image, number: (image, ".JPG", {"quality": 97}))),
    "palette": Dialect(images(palette)),
    "grey": Dialect(images(lambda image, number: (image.convert("L"), ".png", {})), scan=False),
    "grey with alpha": Dialect(images(grey_alpha), scan=False),
    "CMYK": Dialect(images(lambda image, number: (image.convert("CMYK"), ".jpg", {"quality": 97}))),
    "16 bits": Dialect(images(sixteen_bits), scan=False),
    "12 bits in 16": Dialect(images(twelve_bits), ("of 16 bits",), refused=True),
    "turned by EXIF": Dialect(images(exif(6, rotate=90)), ("EXIF data rotates 13 of 13", "320 x 240")),
    "upside down by EXIF": Dialect(images(exif(3, rotate=180)), ("EXIF data rotates 13 of 13",)),
    "some turned by EXIF": Dialect(images(some_turned), ("EXIF data rotates 6 of 13", "0010.jpg"), refused=True),
    "images in a subfolder": Dialect(into_subfolder, ("100CANON",), refused=True),
    "images in a named subfolder": Dialect(
        both(into_subfolder, edit(TOML, 'images = "scan"', 'images = "scan/100CANON"')), scan=False
    ),
}  # fmt: skip
