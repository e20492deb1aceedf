"""What is half-written: replaced in one step, owned by its writer, removed when the writer is dead."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from aomgen.errors import StorageError
from aomgen.io import atomic
from aomgen.io.atomic import STAGING_PREFIX, remove_staging, stage_folder, write_bytes

WRITER = """
import sys, time
from pathlib import Path
from aomgen.io.atomic import stage_folder
with stage_folder(Path(sys.argv[1])) as folder:
    (folder / "a").write_text("half")
    print("ready", flush=True)
    time.sleep(60)
"""


def staged(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"{STAGING_PREFIX}*"))


def fill(path: Path, text: str) -> None:
    with stage_folder(path) as folder:
        (folder / text).write_text(text)


def test_staging_stays_as_long_as_its_writer_lives(tmp_path):
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path / "x")], stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    assert writer.stdout.readline() == "ready\n"
    (tmp_path / f"{STAGING_PREFIX}of-the-dead").write_text("")
    remove_staging(tmp_path)
    (left,) = staged(tmp_path)
    assert (left / "a").read_text() == "half"
    os.kill(writer.pid, signal.SIGKILL)
    writer.wait()
    remove_staging(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_staging_of_another_thread_stays(tmp_path):
    with stage_folder(tmp_path / "x") as folder:
        remove_staging(tmp_path)
        (folder / "a").write_text("")
    assert (tmp_path / "x" / "a").is_file()


def test_programs_that_are_started_do_not_keep_the_lock(tmp_path):
    with atomic.scratch_folder(tmp_path) as folder:
        child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, close_fds=False)
    folder.mkdir()
    remove_staging(tmp_path)
    assert child.stdin is not None
    child.stdin.close()
    child.wait()
    assert staged(tmp_path) == []


def test_removers_and_writers_at_the_same_time_lose_nothing(tmp_path):
    stop = threading.Event()

    def remove() -> None:
        while not stop.is_set():
            remove_staging(tmp_path)

    removers = [threading.Thread(target=remove) for _ in range(2)]
    for thread in removers:
        thread.start()
    try:
        for k in range(60):
            fill(tmp_path / "x", str(k))
            write_bytes(tmp_path / "y", b"%d" % k)
            assert [p.name for p in (tmp_path / "x").iterdir()] == [str(k)]
    finally:
        stop.set()
        for thread in removers:
            thread.join()
    assert staged(tmp_path) == []


@pytest.mark.parametrize("code", [errno.EBADF, errno.ENOLCK])
def test_without_locks_staging_is_left_alone(tmp_path, monkeypatch, code):
    def refuse(handle: int, operation: int) -> None:
        raise OSError(code, "no locks here")

    monkeypatch.setattr(fcntl, "flock", refuse)
    (tmp_path / f"{STAGING_PREFIX}1").mkdir()
    fill(tmp_path / "x", "new")
    remove_staging(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{STAGING_PREFIX}1", "x"]


def test_where_nothing_can_be_exchanged_two_renames_replace_a_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "RENAME_EXCHANGE", 1 << 20)  # a flag that no file system knows: EINVAL
    fill(tmp_path / "x", "old")
    fill(tmp_path / "x", "new")
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")] == ["x", "x/new"]


def test_the_old_folder_comes_back_when_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    fill(tmp_path / "x", "old")
    monkeypatch.setattr(atomic, "RENAME_EXCHANGE", 1 << 20)
    rename = Path.replace

    def refuse(self: Path, target: Path) -> Path:
        if target == tmp_path / "x" and not (self / "old").exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(StorageError, match="No space left"):
        fill(tmp_path / "x", "new")
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")] == ["x", "x/old"]


def test_what_appears_has_been_synced(tmp_path, monkeypatch):
    """After a power loss there is what was synced: files and lists of folders before the rename, their place after it."""
    synced: list[Path] = []
    sync, move = os.fsync, os.replace

    def note(handle: int) -> None:
        synced.append(Path(os.readlink(f"/proc/self/fd/{handle}")))
        sync(handle)

    def check(source: Path, target: Path) -> None:
        assert {source, *source.rglob("*")} <= set(synced)
        synced.clear()
        move(source, target)

    monkeypatch.setattr(os, "fsync", note)
    monkeypatch.setattr(os, "replace", check)
    with stage_folder(tmp_path / "x") as folder:
        (folder / "deep" / "deeper").mkdir(parents=True)
        (folder / "deep" / "deeper" / "a").write_text("")
        (folder / "b").write_text("")
    assert synced == [tmp_path]
    write_bytes(tmp_path / "y", b"")
    assert synced == [tmp_path]


def test_a_folder_replaces_a_file_in_one_step(tmp_path):
    write_bytes(tmp_path / "x", b"old")
    fill(tmp_path / "x", "new")
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")] == ["x", "x/new"]


@pytest.mark.parametrize("exists", [True, False])
def test_a_linked_folder_is_replaced_where_it_is(tmp_path, exists):
    (tmp_path / "disk").mkdir()
    target = tmp_path / "disk" / "data"
    if exists:
        fill(target, "old")
    (tmp_path / "x").symlink_to(target)
    fill(tmp_path / "x", "new")
    assert (tmp_path / "x").readlink() == target
    assert [p.name for p in target.iterdir()] == ["new"]
    assert staged(tmp_path) == staged(tmp_path / "disk") == []


def test_a_link_that_replaces_staging_is_deleted_without_its_target(tmp_path):
    (tmp_path / "data").mkdir()
    with atomic.scratch_folder(tmp_path) as folder:
        folder.rmdir()
        folder.symlink_to(tmp_path / "data")
    assert [p.name for p in tmp_path.iterdir()] == ["data"]


def test_an_error_without_a_number_is_stated(tmp_path):
    with (
        pytest.raises(StorageError, match="cannot be written \\(the disk is gone\\)"),
        stage_folder(tmp_path / "x"),
    ):
        raise OSError("the disk is gone")
