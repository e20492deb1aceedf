"""A store keeps archives: in a folder, or in an object store, for which fsspec's memory stands here."""

import importlib.util
import io
import shutil
import zipfile
from pathlib import Path

import pytest

from aomgen.errors import (
    AomgenError,
    BackendError,
    ConfigError,
    MalformedFileError,
    StorageError,
    UnsafePathError,
)
from aomgen.store import Store, require_store

FILES = {"a.json": b"{}", "000005/front.mp4": bytes(range(256)), "empty": b""}


@pytest.fixture(params=["folder", "memory"], autouse=True)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if importlib.util.find_spec("fsspec") is None:
        pytest.skip("fsspec is not installed")
    return str(tmp_path / "store" / "run") if request.param == "folder" else f"memory://{tmp_path.name}/run"


def replace_archive(url: str, name: str, data: bytes) -> None:
    import fsspec

    files, root = fsspec.url_to_fs(url)
    files.pipe_file(f"{root}/{name}.zip", data)


def test_archives_are_what_was_put(url: str) -> None:
    store = Store(url)
    store.begin()
    store.put("b", {})
    store.put("a", {"old": b""})
    store.put("a", FILES)
    other = Store(f"{url}/")
    assert other.get("a") == FILES
    assert other.get("b") == {}
    assert other.names() == {"a", "b"}
    require_store(url)


def test_a_store_that_is_absent_is_named_in_one_sentence(url: str) -> None:
    store = Store(url)
    store.begin()
    store.put("a", FILES)
    for use in (lambda: store.get("b"), lambda: Store(f"{url}/other").names()):
        with pytest.raises(
            StorageError, match=r"the store cannot be used .*FileNotFoundError.*to continue"
        ) as raised:
            use()
        assert "\n" not in str(raised.value)


def test_a_folder_that_vanishes_is_not_created_again(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "mounted"))
    store.begin()
    shutil.rmtree(tmp_path / "mounted")
    with pytest.raises(StorageError, match="No such file or directory"):
        store.put("a", FILES)
    assert not (tmp_path / "mounted").exists()


def test_errors_of_a_storage_library_are_typed(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class ClientError(Exception):
        """An error with no other base class, as botocore raises it."""

    def fail(*_: object, **__: object) -> None:
        raise ClientError("An error occurred (SlowDown)\nwhen calling the operation")

    store = Store(url)
    for name in ("cat_file", "ls"):
        monkeypatch.setattr(type(store._files), name, fail)
    for use in (lambda: store.get("a"), store.names):
        with pytest.raises(StorageError, match=r"ClientError: An error occurred \(SlowDown\) when") as raised:
            use()
        assert raised.value.exit_code == StorageError.exit_code


@pytest.mark.parametrize("size", [0, 10, -20])
def test_an_incomplete_archive_is_refused(url: str, size: int) -> None:
    store = Store(url)
    store.begin()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a", b"x" * 100)
    replace_archive(url, "a", buffer.getvalue()[:size])
    with pytest.raises(MalformedFileError, match=r"a\.zip: is not an archive"):
        store.get("a")


@pytest.mark.parametrize("name", ["../a", "/etc/a", "b/../../a"])
def test_an_archive_stays_in_its_folder(url: str, name: str) -> None:
    store = Store(url)
    store.begin()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(name, b"x")
    replace_archive(url, "a", buffer.getvalue())
    with pytest.raises(UnsafePathError):
        store.get("a")


@pytest.mark.parametrize(
    ("other", "error", "problem"),
    [
        ("what://bucket/run", ConfigError, "--store what://bucket/run: is not a known kind of store"),
        ("dropbox://bucket/run", BackendError, "needs a package .*; install it on every machine"),
    ],
)
def test_an_unknown_store_is_named(other: str, error: type[AomgenError], problem: str) -> None:
    with pytest.raises(error, match=problem):
        require_store(other)
