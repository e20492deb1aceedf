"""A training that was stopped ends in the same bytes as one that was not; nothing else is continued."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import silent
from aomgen.errors import CorruptArtifactError, LimitExceededError, MissingFileError
from aomgen.splatting import checkpoint as module
from aomgen.splatting.checkpoint import (
    Checkpoint,
    load_checkpoint,
    save_checkpoint,
    state_arrays,
    training_digest,
)
from aomgen.splatting.rasterizer import render
from aomgen.splatting.training import TrainingParams, start_training, train

# Growth, a change of resolution, exposure and random backgrounds all happen within these iterations.
PARAMS = TrainingParams(
    iterations=48,
    sh_degree=1,
    max_gaussians=420,
    grow_every=8,
    downsampling=((0.0, 2), (0.4, 1)),
    refine_poses=True,
)


class StoppedError(Exception):
    pass


def scene(count: int = 300) -> Gaussians:
    rng = np.random.default_rng(0)
    return Gaussians(
        means=rng.uniform(-0.5, 0.5, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=np.full((count, 3), 0.05),
        opacities=np.full(count, 0.8),
        sh=rng.normal(size=(count, 1, 3)),
    )


def cameras(count: int = 5) -> list[Camera]:
    angles = 2 * np.pi * np.arange(count) / count
    return [
        Camera(fx=60, fy=60, cx=24, cy=18, width=48, height=36, T_world_cam=look_at(eye, [0, 0, 0]))
        for eye in np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(count, 0.6)], 1)
    ]


def images() -> list[np.ndarray]:
    other = replace(scene(), sh=scene().sh[::-1])
    return [(render(other, camera).rgb * 255).round().astype(np.uint8) for camera in cameras()]


def run(checkpoint: Checkpoint | None, *, stop_at: int | None = None) -> Gaussians:
    def progress(share: float, text: str) -> None:
        if stop_at is not None and round(share * PARAMS.iterations) >= stop_at:
            raise StoppedError

    return train(
        scene(), cameras(), images(), PARAMS, progress, np.random.default_rng(4), checkpoint=checkpoint
    )


@pytest.mark.parametrize("every", [3, 7, 16])
def test_a_stopped_training_ends_in_the_same_bytes(tmp_path: Path, every: int) -> None:
    whole, broken = (Checkpoint(path=tmp_path / name, every=every) for name in ("whole", "broken"))
    want = run(whole)
    for stop_at in (10, 20, 40):  # each continues where the one before was stopped
        with pytest.raises(StoppedError):
            run(broken, stop_at=stop_at)
    have = run(broken)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert getattr(have, name).tobytes() == getattr(want, name).tobytes(), name
    # Parameters, both moments, exposure, order, generator and counters of the last state.
    assert broken.path.read_bytes() == whole.path.read_bytes()


def test_checkpoints_change_nothing(tmp_path: Path) -> None:
    want, have = run(None), run(Checkpoint(path=tmp_path / "c", every=5))
    assert np.array_equal(have.means, want.means)
    assert np.array_equal(have.sh, want.sh)


def test_a_finished_training_is_not_done_again(tmp_path: Path) -> None:
    checkpoint = Checkpoint(path=tmp_path / "c", every=1000)
    want = run(checkpoint)
    calls: list[float] = []
    have = train(
        scene(),
        cameras(),
        images(),
        PARAMS,
        lambda share, text: calls.append(share),
        np.random.default_rng(4),
        checkpoint=checkpoint,
    )
    assert not calls
    assert np.array_equal(have.means, want.means)


def saved(tmp_path: Path) -> tuple[Path, str]:
    path, rng = tmp_path / "c", np.random.default_rng(4)
    digest = training_digest(scene(), cameras(), images(), PARAMS, rng)
    save_checkpoint(path, start_training(scene(), cameras(), PARAMS, rng), digest)
    return path, digest


def test_the_generator_continues(tmp_path: Path) -> None:
    path, digest = saved(tmp_path)
    fresh = np.random.default_rng(99)
    state = load_checkpoint(path, digest, fresh)
    assert state.rng is fresh
    assert fresh.random() == np.random.default_rng(4).random()


def test_damage_anywhere_is_noticed(tmp_path: Path) -> None:
    path, digest = saved(tmp_path)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    places = [0, 20, 100, content.index(b"\n"), len(content) - 1, *rng.integers(0, len(content), 20)]
    for place in places:
        broken = bytearray(content)
        broken[place] ^= 0x40
        path.write_bytes(broken)
        with pytest.raises(CorruptArtifactError):
            load_checkpoint(path, digest, np.random.default_rng(0))
    for length in (0, 10, 200, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(CorruptArtifactError):
            load_checkpoint(path, digest, np.random.default_rng(0))


def test_an_intact_file_without_a_state_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for arrays in ({}, {"counters": np.zeros(3, np.uint8)}):
        monkeypatch.setattr(module, "state_arrays", lambda state, arrays=arrays: arrays)
        path, digest = saved(tmp_path)
        with pytest.raises(CorruptArtifactError, match="no training state"):
            load_checkpoint(path, digest, np.random.default_rng(0))


def test_missing_and_huge_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, digest = saved(tmp_path)
    with pytest.raises(MissingFileError):
        load_checkpoint(tmp_path / "other", digest, np.random.default_rng(0))
    monkeypatch.setattr(module, "MAX_BYTES", 100)
    with pytest.raises(LimitExceededError, match="limit 100"):
        load_checkpoint(path, digest, np.random.default_rng(0))


@pytest.mark.parametrize("what", ["image", "camera", "initial", "params", "seed", "size"])
def test_a_checkpoint_of_other_inputs_is_refused_and_kept(tmp_path: Path, what: str) -> None:
    path, _ = saved(tmp_path)
    before = path.read_bytes()
    initial, views, pictures, params, seed = scene(), cameras(), images(), PARAMS, 4
    if what == "image":
        pictures[3] = pictures[3].copy()
        pictures[3][0, 0, 0] ^= 1
    elif what == "camera":
        views[2] = replace(views[2], cx=views[2].cx + 1e-6)
    elif what == "initial":
        initial = initial.select(np.arange(len(initial) - 1))
    elif what == "params":
        params = replace(params, rates={**params.rates, "means": 8.001e-4})
    elif what == "size":
        views, pictures = views[:-1], pictures[:-1]
    else:
        seed = 5
    with pytest.raises(CorruptArtifactError, match="other inputs or parameters; delete it"):
        train(
            initial,
            views,
            pictures,
            params,
            silent,
            np.random.default_rng(seed),
            checkpoint=Checkpoint(path=path),
        )
    assert path.read_bytes() == before


def test_every_part_of_the_state_is_stored() -> None:
    """Whoever adds a field to the state must store it: the bytes differ when a field does."""
    state = start_training(scene(), cameras(), PARAMS, np.random.default_rng(0))
    stored = state_arrays(state)
    named = {"values", "averages", "squares", "reach", "Exposure", "PoseIncrements", "order", "counters"}
    assert {name.split(".")[0] for name in stored} == named
    assert set(type(state).__slots__) == {"parameters", "exposure", "poses", "order", "iteration", "rng"}
    assert set(type(state.parameters).__slots__) == {"values", "averages", "squares", "reach", "steps"}
