"""Stored files that can be computed again: intact ones are read, damaged ones are named in one warning."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest

from aomgen.core.gaussians import gaussians_of
from aomgen.core.values import Array
from aomgen.io.artifact import file_digest, load_artifact, read_json, save_artifact
from aomgen.io.atomic import write_json
from aomgen.io.ply import read_gaussians, write_gaussians
from aomgen.io.reuse import StoredFileWarning, reuse, reuse_object


@dataclass(frozen=True, kw_only=True)
class Table:
    """A value with an array that is stored in an npz file."""

    values: Annotated[Array, "N"]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def change_content(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x40
    path.write_bytes(data)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def save_npz(folder: Path) -> tuple[Path, Callable[[], Any]]:
    save_artifact(folder, "table", Table(values=np.arange(500.0)))
    return folder / "table.npz", partial(load_artifact, folder, "table", Table)


def save_json(folder: Path) -> tuple[Path, Callable[[], Any]]:
    write_json(folder / "a.json", {"a": list(range(50))})
    return folder / "a.json", partial(read_json, folder / "a.json")


def save_ply(folder: Path) -> tuple[Path, Callable[[], Any]]:
    one = np.ones((7, 3))
    quats = np.tile([1.0, 0, 0, 0], (7, 1))
    scene = gaussians_of(means=one, quats=quats, scales=one, opacities=np.full(7, 0.5), sh=np.ones((7, 1, 3)))
    write_gaussians(folder / "a.ply", scene)
    return folder / "a.ply", partial(read_gaussians, folder / "a.ply")


@pytest.mark.parametrize(
    ("save", "damage"),
    [
        (save_npz, truncate),
        (save_npz, change_content),
        (save_npz, empty),
        (save_json, truncate),
        (save_json, empty),
        (save_json, replace_by_folder),
        (save_ply, truncate),
        (save_ply, empty),
    ],
)
def test_a_damaged_file_is_named_once_and_not_used(tmp_path: Path, save: Any, damage: Any) -> None:
    path, read = save(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert reuse(path, read) is not None
    damage(path)
    with pytest.warns(StoredFileWarning, match=r"cannot be reused \(.*\); it is computed again") as warned:
        assert reuse(path, read) is None
    assert len(warned) == 1
    assert str(path) in str(warned[0].message)


def test_a_missing_file_is_no_damage(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert reuse(tmp_path / "no", partial(file_digest, tmp_path / "no")) is None
        assert reuse_object(tmp_path / "no") == {}


def test_an_unreadable_file_is_like_a_damaged_one(tmp_path: Path) -> None:
    def read() -> str:
        raise PermissionError(13, "Permission denied", "a.json")

    (tmp_path / "a.json").write_text("{}")
    with pytest.warns(StoredFileWarning, match="Permission denied"):
        assert reuse(tmp_path / "a.json", read) is None


def test_a_file_of_another_kind_is_no_object(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("[]")
    with pytest.warns(StoredFileWarning, match="no JSON object"):
        assert reuse_object(tmp_path / "a.json") == {}
