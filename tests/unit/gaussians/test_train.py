"""The Gaussians stage: continues a killed training, and starts over from a checkpoint it cannot use."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress, silent
from aomgen.core.project import Project
from aomgen.core.structure import Structure
from aomgen.gaussians import train as module
from aomgen.gaussians.depth_fusion import Samples
from aomgen.gaussians.stage import CHECKPOINT_FILE, train_in
from aomgen.gaussians.train import GaussiansParams, coarse
from aomgen.io.images import write_image
from aomgen.io.reuse import StoredFileWarning
from aomgen.pipeline.runner import Stage, run_stages
from aomgen.pipeline.stages import STAGES
from aomgen.results import Results
from aomgen.splatting.rasterizer import render

VIEWS = 6


class StoppedError(Exception):
    pass


def cameras() -> dict[str, Camera]:
    angles = np.pi * np.arange(VIEWS) / VIEWS
    eyes = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(VIEWS, 0.8)], 1)
    return {
        f"{i:04d}.png": Camera(
            fx=60, fy=60, cx=24, cy=18, width=48, height=36, T_world_cam=look_at(eye, [0, 0, 0])
        )
        for i, eye in enumerate(eyes)
    }


def dense_points(count: int = 400) -> tuple[Samples, Samples]:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = Samples(
        points_recon=np.concatenate([0.5 * directions, 100 * directions[:50]]),
        normals_recon=np.concatenate([directions, -directions[:50]]),
        colors_srgb=rng.integers(0, 255, (count + 50, 3)).astype(np.uint8),
        footprints=np.concatenate([np.full(count, 0.05), np.full(50, 20.0)]),
        detail=np.ones(count + 50),
        weights=np.ones(count + 50),
    )
    of_shell = np.arange(count + 50) >= count
    return points.select(~of_shell), points.select(of_shell)


@pytest.fixture
def scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Structure, dict[str, Path]]:
    """A scan of a colored ball, with the dense points already found."""
    rng = np.random.default_rng(1)
    points = dense_points()
    ball = Gaussians(
        means=points[0].points_recon,
        quats=np.tile([1.0, 0, 0, 0], (400, 1)),
        scales=np.full((400, 3), 0.06),
        opacities=np.full(400, 0.95),
        sh=rng.normal(size=(400, 1, 3)),
    )
    images = {}
    for name, camera in cameras().items():
        images[name] = tmp_path / "scan" / name
        write_image(images[name], (render(ball, camera).rgb * 255).round().astype(np.uint8))
    monkeypatch.setattr(module, "densify", lambda *arguments: points)
    structure = Structure(
        cameras_recon=cameras(),
        demo_cameras_recon={},
        dropped={},
        points_recon=np.zeros((0, 3)),
        colors_srgb=np.zeros((0, 3), np.uint8),
        observations=np.zeros((0, 2), np.int32),
        reprojection_error_px=0.0,
    )
    return structure, images


PARAMS = replace(
    coarse(GaussiansParams()),
    training=replace(coarse(GaussiansParams()).training, iterations=230, max_gaussians=500),
    min_psnr_db=5.0,
)


def test_a_killed_stage_continues_within_training(
    tmp_path: Path, scan: tuple[Structure, dict[str, Path]]
) -> None:
    seen: list[str] = []

    def stop_late(share: float, text: str) -> None:
        if "loss" in text and share > 0.25 + 0.7 * 205 / 230:
            raise StoppedError

    folder = tmp_path / "02_gaussians"
    with pytest.raises(StoppedError):
        train_in(folder, *scan, stop_late, PARAMS)
    assert [path.name for path in folder.iterdir()] == [CHECKPOINT_FILE]
    train_in(folder, *scan, lambda share, text: seen.append(text), PARAMS)
    assert sum("loss" in text for text in seen) == 3  # iterations 210, 220 and 230
    assert CHECKPOINT_FILE not in {path.name for path in folder.iterdir()}

    train_in(tmp_path / "whole", *scan, silent, PARAMS)
    for file in folder.iterdir():
        assert file.read_bytes() == (tmp_path / "whole" / file.name).read_bytes(), file.name


@pytest.mark.parametrize("content", [b"", b"x" * 500])
def test_a_checkpoint_that_cannot_be_used_is_left_out_and_told(
    tmp_path: Path, scan: tuple[Structure, dict[str, Path]], content: bytes
) -> None:
    folder = tmp_path / "02_gaussians"
    folder.mkdir()
    (folder / CHECKPOINT_FILE).write_bytes(content)
    with pytest.warns(StoredFileWarning, match=f"{CHECKPOINT_FILE}: .*; the training starts over") as warned:
        train_in(folder, *scan, silent, PARAMS)
    assert len(warned) == 1
    train_in(tmp_path / "whole", *scan, silent, PARAMS)
    assert (folder / "gaussians.ply").read_bytes() == (tmp_path / "whole" / "gaussians.ply").read_bytes()


def test_the_runner_keeps_what_a_killed_stage_left(
    tmp_path: Path, scan: tuple[Structure, dict[str, Path]]
) -> None:
    """The stage of the pipeline's own list, with the runner's rules for continuing."""
    listed = next(stage for stage in STAGES if stage.name == "gaussians")

    def work(results: Results, folder: Path, progress: Progress) -> dict[str, object]:
        return {"gaussians": train_in(folder, *scan, progress, PARAMS)["gaussians"]}

    def go(out: str, *, seed: int, stop: bool) -> list[str]:
        stage = replace(listed, needs=("capture",), settings=("seed",), function=work)
        display = Display(stop)
        project = Project(capture=tmp_path, out=tmp_path / out, seed=seed)
        run_stages(project, (stage,), display, inputs={"capture": "c"})
        return display.losses

    with pytest.raises(StoppedError):
        go("out", seed=0, stop=True)
    assert len(go("out", seed=0, stop=False)) == 3  # iterations 210, 220, 230
    assert len(go("whole", seed=0, stop=False)) == 23
    folders = [tmp_path / out / listed.folder for out in ("out", "whole")]
    files = [{file.name: file.read_bytes() for file in folder.iterdir()} for folder in folders]
    assert files[0] == files[1]

    with pytest.raises(StoppedError):
        go("other", seed=0, stop=True)
    assert len(go("other", seed=1, stop=False)) == 23  # other settings, so nothing is continued


class Display:
    """Stops the run late in training, or keeps the lines that tell of a loss."""

    def __init__(self, stop: bool) -> None:
        self.stop, self.losses = stop, []

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        pass

    def progress(self, share: float, text: str) -> None:
        if "loss" in text:
            self.losses.append(text)
            if self.stop and share > 0.25 + 0.7 * 205 / 230:
                raise StoppedError

    def end(self, stage: Stage, seconds: float, figures: dict[str, object]) -> None:
        pass

    def warn(self, stage: Stage, sentence: str) -> None:
        pass


def recorder(seen: list[str]) -> Progress:
    return lambda share, text: seen.append(text)
