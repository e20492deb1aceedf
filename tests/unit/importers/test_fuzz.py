"""Damaged recordings are refused with a typed error, or read; nothing else escapes, and no file is left."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from aomgen.errors import AomgenError
from aomgen.importers.import_demo import ImportOptions, import_demo
from aomgen.io.images import resize
from aomgen.io.video import encode_video, read_video
from foreign_recordings import (
    Demonstration,
    write_bag,
    write_lerobot_v3,
    write_lerobot_v21,
    write_rtde,
)

ROUNDS = 30


@pytest.fixture(scope="module")
def tiny(short: Demonstration, tmp_path_factory: pytest.TempPathFactory) -> Demonstration:
    """Twelve frames of 32 x 24 pixels."""
    path = tmp_path_factory.mktemp("tiny") / "front.mp4"
    path.write_bytes(encode_video((resize(frame, 32, 24) for frame in short.frames[:12]), 10))
    cut = short.first(12)
    return Demonstration(cut.times_s, cut.joints, cut.gripper, read_video(path).frames_srgb, path)


def write_source(kind: str, path: Path, tiny: Demonstration) -> tuple[Path, list[Path]]:
    """A recording, and the files of it that are damaged."""
    writers = {"v3": write_lerobot_v3, "v21": write_lerobot_v21, "rtde": write_rtde}
    if kind in writers:
        writers[kind](path, tiny)
    else:
        format_name, video = kind.split("-")
        write_bag(path, tiny, format_name, video)
    return path, [path] if path.is_file() else sorted(item for item in path.rglob("*") if item.is_file())


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut the end off, flip bits, or overwrite a piece."""
    changed = bytearray(data)
    what, at = rng.integers(3), int(rng.integers(len(data)))
    if what == 0:
        return bytes(changed[:at])
    if what == 1:
        for place in rng.integers(0, len(data), int(rng.integers(1, 9))):
            changed[place] ^= 1 << int(rng.integers(8))
        return bytes(changed)
    changed[at : at + 8] = rng.choice([0, 1, 127, 255]).astype(np.uint8).tobytes() * len(changed[at : at + 8])
    return bytes(changed)


@pytest.mark.parametrize(
    "kind",
    ["v3", "v21", "rtde", "ros1-jpeg", "ros1-h264", "sqlite-image", "sqlite-h264", "mcap-h264", "mcap-jpeg"],
)
def test_damaged_recordings(kind: str, tiny: Demonstration, tmp_path: Path):
    rng = np.random.default_rng(7)
    source, files = write_source(kind, tmp_path / "source", tiny)
    contents = {file: file.read_bytes() for file in files}
    cameras = (f"front={tiny.video}",) if kind == "rtde" else ()
    options = ImportOptions(
        cameras=cameras, gripper_column="output_int_register_24" if kind == "rtde" else ""
    )
    target = tmp_path / "target"
    target.mkdir()
    refused: list[str] = []
    for _ in range(ROUNDS):
        file = files[rng.integers(len(files))]
        file.write_bytes(damage(contents[file], rng))
        try:
            import_demo(source, target / "capture", 0, options)
            shutil.rmtree(target / "capture")
        except AomgenError as error:
            refused.append(str(error))
        assert list(target.iterdir()) == []
        file.write_bytes(contents[file])
    assert len(refused) > ROUNDS / 10
    assert not any("\n" in message for message in refused)
