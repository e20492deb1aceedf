"""Overlap of a scan's images, on the bundled scan and copies of it that are changed on purpose."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from aomgen.capture.read import read_capture
from aomgen.capture.scan_images import read_grey
from aomgen.cli.app import app
from aomgen.structure.overlap import measure_overlap


@pytest.fixture(scope="module")
def changed_scan(sample: Path, tmp_path_factory) -> list[Path]:
    """Every second image of the scan, one of them darker, one twice, and one of another scene."""
    folder = tmp_path_factory.mktemp("scan")
    images = [Path(shutil.copy(path, folder)) for path in sorted((sample / "scan").iterdir())[::2]]
    dark = np.asarray(Image.open(images[4])).astype(float) / 255
    Image.fromarray((255 * (dark**2.2 / 2.5) ** (1 / 2.2)).astype(np.uint8)).save(images[4], quality=95)
    images.append(Path(shutil.copy(images[7], folder / "again.jpg")))
    noise = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
    Image.fromarray(noise).resize((640, 480), Image.Resampling.BICUBIC).save(
        folder / "strange.jpg", quality=95
    )
    return [*images, folder / "strange.jpg"]


def test_changed_images_are_told_apart(changed_scan):
    found = measure_overlap({path.name: read_grey(path) for path in changed_scan})
    assert np.array_equal(found.matches, found.matches.T)
    assert [name for name, alone in zip(found.names, found.isolated, strict=True) if alone] == ["strange.jpg"]
    assert found.repeated == {"again.jpg": changed_scan[7].name}
    assert found.exposures_ev[4] == pytest.approx(-np.log2(2.5), abs=0.3)
    others = np.delete(found.exposures_ev, 4)
    assert np.abs(others).max() < 0.3
    # The stranger is in no reconstruction, and a wall leaves a gap on one side of the bundled scene.
    assert len(found.Ts_recon_cam) >= 25
    assert "strange.jpg" not in found.Ts_recon_cam
    gap_deg = float(re.findall(r"is (\d+) degrees", found.describe_walk())[0])
    assert 90 < gap_deg < 200
    isolated, *_, exposed, repeated = found.list_warnings()
    assert "(strange.jpg)" in isolated
    assert f"({changed_scan[4].name})" in exposed
    assert "(again.jpg)" in repeated


@pytest.mark.slow
def test_check_writes_a_page_with_the_worst_image_first(capture_copy, tmp_path):
    prompted = {prompt.image for prompt in read_capture(capture_copy).prompts}
    for index, path in enumerate(sorted((capture_copy / "scan").iterdir())):
        if index % 2 and path.name not in prompted:
            path.unlink()
    count = len(list((capture_copy / "scan").iterdir()))
    image = capture_copy / "scan" / "0020.jpg"
    Image.fromarray(np.asarray(Image.open(image)) // 3).save(image, quality=95)
    result = CliRunner().invoke(app, ["check", str(capture_copy), "--html", str(tmp_path / "page.html")])
    assert result.exit_code == 0, result.output
    assert f"{count} images, 640 x 480" in result.output
    assert "95 frames" in result.output
    assert (
        f"1 of {count} scan images are brighter or darker than the images that overlap with them (0020.jpg)"
        in result.output
    )
    mapped = int(re.findall(rf"(\d+) of {count} images in a quick reconstruction", result.output)[0])
    assert mapped >= count // 2
    page = (tmp_path / "page.html").read_text("utf-8")
    assert page.count("<circle") == mapped
    cards = page[page.index('class="cards"') :]
    assert cards.index("0020.jpg") < cards.index("0000.jpg")
    assert cards.index("0020.jpg") < 60_000
    assert page.count('class="card"') == count
