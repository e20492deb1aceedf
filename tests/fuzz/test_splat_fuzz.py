"""The `.splat` reader on damaged files: one of our errors, or Gaussians that any renderer takes."""

import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aomgen.core.gaussians import SH_C0
from aomgen.errors import InputError, LimitExceededError, MalformedFileError
from aomgen.io.gaussian_files import RECORD, read_splat
from aomgen.io.ply import MAX_GAUSSIANS

FUZZ = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=300,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def records(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    table = np.zeros(count, RECORD)
    table["means"] = rng.normal(size=(count, 3))
    table["scales"] = rng.random((count, 3))
    table["color"] = rng.integers(0, 256, (count, 3))
    table["opacity"] = rng.integers(0, 256, count)
    table["quats"] = rng.integers(129, 256, (count, 4))
    return table


def check(folder: Path, data: bytes) -> bool:
    """Whether the file was read; if so, it was read right."""
    path = folder / "fuzzed.splat"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            g = read_splat(path)
        except InputError as error:
            refusal = str(error)
        else:
            table = np.frombuffer(data, RECORD)
            np.testing.assert_array_equal(g.means, table["means"])
            np.testing.assert_array_equal(g.scales, table["scales"])
            np.testing.assert_allclose(g.opacities, table["opacity"] / 255, atol=1e-6)
            np.testing.assert_allclose(0.5 + SH_C0 * g.sh[:, 0], table["color"] / 255, atol=1e-6)
            assert np.isfinite(g.means).all()
            assert (np.isfinite(g.scales) & (g.scales >= 0)).all()
            np.testing.assert_allclose(np.linalg.norm(g.quats, axis=1), 1, atol=1e-5)
            return True
    assert "fuzzed.splat: " in refusal
    return False


@FUZZ
@given(data=st.one_of(st.binary(max_size=200), st.binary(min_size=64, max_size=64), st.just(b"")))
def test_noise(tmp_path: Path, data: bytes) -> None:
    read = check(tmp_path, data)
    assert not (read and len(data) % RECORD.itemsize)


@FUZZ
@given(count=st.integers(0, 9), seed=st.integers(0, 99), where=st.floats(0, 1), junk=st.binary(max_size=5))
def test_damaged_bytes(tmp_path: Path, count: int, seed: int, where: float, junk: bytes) -> None:
    data = records(count, seed).tobytes()
    assert check(tmp_path, data)
    at = int(where * len(data))
    check(tmp_path, (data[:at] + junk + data[at + len(junk) :])[: len(data)])
    if junk:
        assert not check(tmp_path, data[:at] + junk + data[at:])


def test_a_sparse_file_beyond_the_limit_allocates_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    with path.open("wb") as file:
        file.truncate((MAX_GAUSSIANS + 1) * RECORD.itemsize)
    tracemalloc.start()
    with pytest.raises(LimitExceededError):
        read_splat(path)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 1 << 20


def test_a_file_that_changes_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(records(4, 0).tobytes())
    whole = np.fromfile
    monkeypatch.setattr(np, "fromfile", lambda *a, **k: whole(*a, **k)[:-1])
    with pytest.raises(MalformedFileError, match="shorter"):
        read_splat(path)
