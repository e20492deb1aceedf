"""Photos become Gaussians, and a second call keeps what is there."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from aomgen.api.display import CallbackDisplay
from aomgen.cli.app import app
from aomgen.core.progress import Progress, silent
from aomgen.errors import ConfigError, MissingFileError, ReconstructionError
from aomgen.gaussians.train import GaussiansParams, coarse
from aomgen.importers.scan_writing import WrittenScan
from aomgen.io.ply import read_gaussians
from aomgen.io.video import probe_video
from aomgen.pipeline import splat
from aomgen.structure.reconstruct import Photographs, StructureParams
from foreign_scans import known_scan, write_photos


@pytest.mark.slow
def test_photos_become_gaussians(sample: Path, tmp_path: Path, monkeypatch) -> None:
    photos = sorted((sample / "scan").glob("*.jpg"))[:20]
    source = write_photos(tmp_path / "photos", known_scan(photos, width=640, height=480))
    monkeypatch.setattr(splat, "GaussiansParams", lambda: coarse(GaussiansParams()))
    monkeypatch.setattr(splat, "MAX_FEATURES", 2000)
    scene, video = tmp_path / "scene.ply", tmp_path / "turntable.mp4"
    command = ["splat", str(source), str(scene), "--long-side", "320", "--video", str(video)]
    done = CliRunner().invoke(app, command, catch_exceptions=False)
    assert done.exit_code == 0
    assert "20 of 20 images" in done.output
    assert "held-out images: PSNR" in done.output
    assert len(read_gaussians(scene)) > 1000
    info = probe_video(video)
    assert (info.width, info.height, info.frames) == (320, 240, 120)
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "scene.run").rglob("manifest.json")}
    again = CliRunner().invoke(app, command[:-2], catch_exceptions=False)
    assert again.output.count("kept") == 3
    assert kept == {path: path.stat().st_mtime_ns for path in (tmp_path / "scene.run").rglob("manifest.json")}


@pytest.mark.parametrize(("long_side", "octaves"), [(960, [0, -1]), (640, [-1])])
def test_plain_large_images_are_doubled_after_a_first_attempt(
    monkeypatch, long_side: int, octaves: list[int]
):
    tried = []

    def refuse(photographs: Photographs, params: StructureParams, progress: Progress) -> None:
        tried.append(params.first_octave)
        raise ReconstructionError("scan", "no two images could be related", "record more texture")

    monkeypatch.setattr(splat, "reconstruct_structure", refuse)
    scan = WrittenScan(
        names=(), width=540, height=long_side, intrinsics=None, resampled=0, poses=None, warnings=()
    )
    with pytest.raises(ReconstructionError):
        splat.reconstruct_scan(Photographs(images={}), scan, silent)
    assert tried == octaves


def test_missing_source_and_other_suffix_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="give a folder of photos"):
        splat.make_splat(tmp_path / "none", tmp_path / "scene.ply", CallbackDisplay())
    with pytest.raises(ConfigError, match="does not have the suffix"):
        CliRunner().invoke(app, ["splat", str(tmp_path), str(tmp_path / "scene.obj")], catch_exceptions=False)
    assert not list(tmp_path.iterdir())
