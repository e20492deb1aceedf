"""A run takes over stages of another one only where it would compute the same."""

from pathlib import Path

import numpy as np
import pytest

from aomgen.io.images import encode_png, read_image
from aomgen.pipeline.manifest import read_manifest, write_manifest
from aomgen.pipeline.stages import STAGES
from benchmarks.imports import digest_scene, take_scene


@pytest.mark.slow
def test_the_digest_is_that_of_decoded_images_and_of_intrinsics(capture_copy: Path):
    before = digest_scene(capture_copy)
    toml = capture_copy / "capture.toml"
    text = toml.read_text("utf-8")
    toml.write_text(f"# the same capture\n{text}", "utf-8")
    assert digest_scene(capture_copy) == before
    toml.write_text(text.replace("600.0", "601.0"), "utf-8")
    assert digest_scene(capture_copy) != before
    toml.write_text(text, "utf-8")
    first = min((capture_copy / "scan").iterdir())
    image = np.array(read_image(first))
    image[0, 0, 0] ^= 1
    first.write_bytes(encode_png(image))
    assert digest_scene(capture_copy) != before


def test_stages_are_taken_over_under_the_digest_of_the_capture(tmp_path: Path):
    for stage in STAGES[:2]:
        folder = tmp_path / "one" / stage.folder
        folder.mkdir(parents=True)
        (folder / "result").write_text(stage.name)
        write_manifest(folder, stage.name, (stage.version, {"capture": "old"}, {}), {})
    take_scene(tmp_path / "one", tmp_path / "two", "new")
    for stage in STAGES[:2]:
        manifest = read_manifest(tmp_path / "two" / stage.folder)
        assert manifest is not None
        assert manifest.inputs == {"capture": "new"}
        assert (tmp_path / "two" / stage.folder / "result").read_text() == stage.name
        kept = read_manifest(tmp_path / "one" / stage.folder)
        assert kept is not None
        assert kept.inputs == {"capture": "old"}
