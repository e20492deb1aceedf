"""Values come back from disk as they were; files that hold something else are refused by name."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from aomgen.core.values import Matrix4, freeze_arrays
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.io.artifact import load_artifact, save_artifact


@dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    name: str
    weight: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Outer:
    pose: Matrix4
    points: NDArray[np.float32]
    labels: NDArray[np.uint8]
    kind: Literal["a", "b"]
    pair: tuple[int, str]
    inner: Inner | None
    items: tuple[Inner, ...]
    by_name: Mapping[str, Inner]
    figures: dict[str, object] = field(default_factory=dict)

    __post_init__ = freeze_arrays


VALUE = Outer(
    pose=np.diag([0.1, 1 / 3, 1e-17, 1.0]),
    points=np.linspace(0, 1, 600, dtype=np.float32).reshape(200, 3),
    labels=np.array([0, 255], np.uint8),
    kind="b",
    pair=(3, "three"),
    inner=None,
    items=(Inner(name="Küche"), Inner(name="y", weight=2.5)),
    by_name={"z": Inner(name="z", weight=1)},
    figures={"seen": [1, 2.5, None], "nested": {"yes": True}},
)


def assert_same(first: Outer, second: Outer) -> None:
    for item in fields(Outer):
        old, new = getattr(first, item.name), getattr(second, item.name)
        if isinstance(old, np.ndarray):
            assert old.dtype == new.dtype
            assert np.array_equal(old, new)
        else:
            assert old == new


def test_a_value_comes_back_bit_by_bit(tmp_path):
    save_artifact(tmp_path, "outer", VALUE)
    assert_same(VALUE, load_artifact(tmp_path, "outer", Outer))


def test_equal_values_give_equal_bytes(tmp_path):
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        save_artifact(tmp_path / folder, "outer", replace(VALUE))
    for name in ("outer.json", "outer.npz"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3), np.float32), np.array([[np.inf, -np.inf, 0]], np.float32)]
)
def test_arrays_that_json_cannot_tell_keep_shape_and_values(tmp_path, points):
    save_artifact(tmp_path, "outer", replace(VALUE, points=points))
    back = load_artifact(tmp_path, "outer", Outer).points
    assert back.shape == points.shape
    assert np.array_equal(back, points)


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(MissingFileError, match=r"outer\.json"):
        load_artifact(tmp_path, "outer", Outer)


@pytest.mark.parametrize(
    "change",
    [
        {"type": "Other"},
        {"pose": [[1.0]]},
        {"pose": "north"},
        {"points": {"array": "nowhere"}},
        {"points": {"array": []}},
        {"kind": "c"},
        {"pair": [3]},
        {"pair": 3},
        {"inner": {"name": "x"}},
        {"inner": {"name": 1, "weight": None}},
        {"items": {}},
        {"by_name": []},
        {"unknown": 1},
        {"labels": None},
    ],
)
def test_a_file_of_something_else_is_refused(tmp_path, change):
    save_artifact(tmp_path, "outer", VALUE)
    path = tmp_path / "outer.json"
    stored = json.loads(path.read_text())
    stored.update({key: value for key, value in change.items() if key == "type"})
    stored["value"].update({key: value for key, value in change.items() if key != "type"})
    path.write_text(json.dumps(stored))
    with pytest.raises(MalformedFileError, match=r"outer\.json"):
        load_artifact(tmp_path, "outer", Outer)


def test_damaged_arrays_are_refused(tmp_path):
    save_artifact(tmp_path, "outer", VALUE)
    path = tmp_path / "outer.npz"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(MalformedFileError, match=r"outer\.npz"):
        load_artifact(tmp_path, "outer", Outer)
