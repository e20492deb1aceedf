"""Stages are kept, made anew and continued exactly when they should be."""

import errno
import fcntl
import os
import warnings
from dataclasses import replace
from pathlib import Path

import pytest

from aomgen.core.project import Project
from aomgen.errors import AomgenError, InputError, LockedError, StorageError
from aomgen.io.artifact import read_json
from aomgen.io.atomic import write_bytes, write_text
from aomgen.io.reuse import StoredFileWarning
from aomgen.pipeline import runner
from aomgen.pipeline.manifest import MANIFEST, read_manifest
from aomgen.pipeline.runner import LOCK_FILE, WARNINGS, Stage, lock, run_stages, share_stages, stage_states
from aomgen.results import Results


class Heard:
    """A display that remembers which stages really ran."""

    def __init__(self):
        self.ran, self.kept, self.warned = [], [], []

    def begin(self, stage, *, fresh):
        (self.kept if fresh else self.ran).append(stage.name)

    def progress(self, share, text):
        pass

    def end(self, stage, seconds, figures):
        pass

    def warn(self, stage, sentence):
        self.warned.append((stage.name, sentence))


def write_seed(results: Results, folder: Path, progress) -> dict:
    write_text(folder / "a.txt", f"seed {results.project.seed}")
    return {"size": 1}


def copy_a(results: Results, folder: Path, progress) -> dict:
    write_bytes(folder / "b.txt", (results.folders["a"] / "a.txt").read_bytes() * 2)
    return {}


def stages(b=copy_a, version=1, incremental=False):
    common = {"title": "", "weight": 1.0}
    return (
        Stage(
            name="a",
            folder="01_a",
            needs=("capture",),
            settings=("seed",),
            version=1,
            function=write_seed,
            **common,
        ),
        Stage(
            name="b",
            folder="02_b",
            needs=("a",),
            settings=(),
            version=version,
            function=b,
            incremental=incremental,
            **common,
        ),
    )


def go(tmp_path, *, seed=0, digest="x", **changes):
    heard = Heard()
    project = Project(capture=tmp_path, out=tmp_path / "out", seed=seed)
    run_stages(project, stages(**changes), heard, inputs={"capture": digest})
    return heard


def test_a_second_run_does_nothing(tmp_path):
    assert go(tmp_path).ran == ["a", "b"]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert go(tmp_path).kept == ["a", "b"]
    assert before == {
        path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*") if path.is_file()
    }


def test_what_changed_is_made_anew_and_nothing_else(tmp_path):
    go(tmp_path)
    assert go(tmp_path, version=2).ran == ["b"]
    assert go(tmp_path, seed=1, version=2).ran == ["a", "b"]
    assert go(tmp_path, seed=1, version=2, digest="y").ran == ["a"], "same bytes from a: b stays"


def test_a_deleted_file_is_noticed(tmp_path):
    go(tmp_path)
    (tmp_path / "out" / "02_b" / "b.txt").unlink()
    with pytest.warns(StoredFileWarning, match=r"b\.txt are damaged"):
        assert go(tmp_path).ran == ["b"]


@pytest.mark.parametrize(
    ("file", "content", "again"),
    [
        ("01_a/a.txt", b"seed 1", ["a"]),
        ("01_a/a.txt", b"seed", ["a"]),
        ("01_a/manifest.json", b"{", ["a"]),
        ("01_a/manifest.json", b"[]", ["a"]),
        ("02_b/b.txt", b"", ["b"]),
        ("02_b/manifest.json", b'{"stage": 1', ["b"]),
    ],
)
def test_a_damaged_result_is_computed_again_with_one_warning(tmp_path, file, content, again):
    go(tmp_path)
    path = tmp_path / "out" / file
    intact = path.read_bytes()
    path.write_bytes(content)
    states = dict(stage_states(Project(capture=tmp_path, out=tmp_path / "out"), stages()))
    assert len(states) == 2
    with pytest.warns(StoredFileWarning, match=f"{path.parent.name}.*it is computed again") as warned:
        assert go(tmp_path).ran == again
    assert len(warned) == 1
    assert path.read_bytes() == intact
    assert go(tmp_path).kept == ["a", "b"]


@pytest.mark.parametrize("content", ["", "[1]", '{"a":'])
def test_damaged_notes_of_the_runner_cost_no_result(tmp_path, content):
    go(tmp_path, incremental=True)
    timings, started = tmp_path / "out" / "timings.json", tmp_path / "out" / "02_b" / "started.json"
    timings.write_text(content)
    with pytest.warns(StoredFileWarning, match=r"timings\.json") as warned:
        assert go(tmp_path, version=2, incremental=True).ran == ["b"]
    assert len(warned) == 1
    assert set(read_json(timings)) == {"b"}
    started.write_text(content)
    with pytest.warns(StoredFileWarning, match=r"started\.json") as warned:
        assert go(tmp_path, version=3, incremental=True).ran == ["b"]
    assert len(warned) == 1


def test_items_of_a_damaged_stage_are_forgotten_and_others_kept(tmp_path):
    def items(results, folder, progress):
        for name in ("0", "1"):
            if not (folder / name).exists():
                write_text(folder / name, f"{name} {results.project.seed}")
                made.append(name)
        return {}

    def forget(folder, names):
        for name in names:
            (folder / name).unlink()

    made: list[str] = []
    first, second = stages(b=items, incremental=True)
    listed = (first, replace(second, forget=forget))
    project = Project(capture=tmp_path, out=tmp_path / "out")
    run_stages(project, listed, Heard(), inputs={"capture": "x"})
    (tmp_path / "out" / "02_b" / "1").write_text("")
    with pytest.warns(
        StoredFileWarning, match="02_b: the stage 'b' has finished, but its files 1 are damaged"
    ):
        run_stages(project, listed, Heard(), inputs={"capture": "x"})
    assert made == ["0", "1", "1"]


def test_a_refusal_leaves_nothing_half_written(tmp_path):
    def refuse(results, folder, progress):
        write_text(folder / "half.txt", "half")
        raise InputError("b", "no")

    with pytest.raises(InputError):
        go(tmp_path, b=refuse)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"01_a", ".lock", "timings.json"}


def test_an_incremental_stage_continues(tmp_path):
    class Killed(Exception):
        pass

    def first(results, folder, progress):
        write_text(folder / "item-0", "0")
        raise Killed

    def second(results, folder, progress):
        assert (folder / "item-0").read_text() == "0"
        write_text(folder / "item-1", "1")
        return {}

    with pytest.raises(Killed):
        go(tmp_path, b=first, incremental=True)
    states = stage_states(Project(capture=tmp_path, out=tmp_path / "out"), stages())
    assert [state for _, state in states] == ["done", "partial"]
    assert go(tmp_path, b=second, incremental=True).ran == ["b"]


def test_an_incremental_stage_starts_over_for_other_inputs(tmp_path):
    def item(results, folder, progress):
        assert not (folder / f"seed-{1 - results.project.seed}").exists()
        write_text(folder / f"seed-{results.project.seed}", "")
        return {}

    go(tmp_path, b=item, incremental=True)
    go(tmp_path, b=item, incremental=True, seed=1)


def test_two_runs_in_one_folder(tmp_path):
    def nested(results, folder, progress):
        if os.fork() == 0:
            try:
                go(tmp_path)
            except LockedError:
                os._exit(42)
            except AomgenError:
                os._exit(1)
            os._exit(0)
        _, status = os.wait()
        write_text(folder / "child", str(os.waitstatus_to_exitcode(status)))
        return {}

    go(tmp_path, b=nested)
    assert (tmp_path / "out" / "02_b" / "child").read_text() == "42"


def test_warnings_are_told_kept_and_told_again(tmp_path):
    def warns(results: Results, folder: Path, progress) -> dict:
        return {**write_seed(results, folder, progress), WARNINGS: ["the far side was not seen"]}

    project = Project(capture=tmp_path, out=tmp_path / "out")
    first, second = Heard(), Heard()
    listed = (replace(stages()[0], function=warns),)
    run_stages(project, listed, first, inputs={"capture": "c"})
    run_stages(project, listed, second, inputs={"capture": "c"})
    assert second.kept == ["a"]
    assert first.warned == second.warned == [("a", "the far side was not seen")]
    manifest = read_manifest(project.out / "01_a")
    assert manifest is not None
    assert (manifest.figures, manifest.warnings) == ({"size": 1}, ("the far side was not seen",))


def test_items_stay_when_only_their_number_changes(tmp_path):
    made = []

    def items(results: Results, folder: Path, progress) -> dict:
        assert not (folder / MANIFEST).exists(), "it says complete while the stage works"
        for number in range(results.project.poses):
            if not (folder / f"{number}.txt").is_file():
                made.append(number)
                write_text(folder / f"{number}.txt", f"{results.project.seed}")
        return {}

    (stage,) = stages(b=items, incremental=True)[1:]
    counted = replace(stage, needs=("capture",), settings=("seed", "poses"), amount=("poses",))

    def make(poses: int, seed: int = 0) -> list[int]:
        made.clear()
        project = Project(capture=tmp_path, out=tmp_path / "out", seed=seed, poses=poses)
        run_stages(project, (counted,), Heard(), inputs={"capture": "x"})
        return list(made)

    assert make(2) == [0, 1]
    assert make(4) == [2, 3]
    assert make(4) == []
    assert make(4, seed=1) == [0, 1, 2, 3]


@pytest.mark.parametrize("linked", [True, False])
def test_stages_are_shared_with_another_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, linked: bool):
    for name in ("01_structure", "02_gaussians"):
        (tmp_path / "run" / name / "deep").mkdir(parents=True)
        (tmp_path / "run" / name / "deep" / "data").write_text(name)
    (tmp_path / "other" / "02_gaussians").mkdir(parents=True)
    if not linked:
        monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(OSError("another file system")))
    share_stages(sorted((tmp_path / "run").iterdir()), tmp_path / "other")
    shared = tmp_path / "other" / "01_structure" / "deep" / "data"
    assert shared.read_text() == "01_structure"
    assert shared.samefile(tmp_path / "run" / "01_structure" / "deep" / "data") == linked
    # A stage that the other run has stays.
    assert not list((tmp_path / "other" / "02_gaussians").iterdir())


@pytest.mark.parametrize("cause", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_stage_is_shared_completely_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cause):
    folder, out = tmp_path / "run" / "01_structure", tmp_path / "other"
    folder.mkdir(parents=True)
    for name in ("a", "b", MANIFEST):
        (folder / name).write_text(name)
    copies: list[str] = []

    def fill_disk(source: Path, target: Path) -> None:
        copies.append(source.name)
        if len(copies) == 2:
            raise cause
        target.write_bytes(source.read_bytes())

    with monkeypatch.context() as patch:
        patch.setattr(runner, "_link", fill_disk)
        expected = pytest.raises(StorageError, match="No space left") if isinstance(cause, OSError) else None
        with expected or pytest.raises(KeyboardInterrupt):
            share_stages([folder], out)
    assert [path.name for path in out.iterdir()] == [LOCK_FILE]
    share_stages([folder], out)
    assert {path.name for path in (out / folder.name).iterdir()} == set(os.listdir(folder))


def test_stages_are_not_shared_with_a_run_in_progress(tmp_path: Path):
    with lock(tmp_path), pytest.raises(LockedError):
        share_stages([], tmp_path)


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_without_file_locks_a_run_works_and_warns_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
):
    def refuse(file: object, operation: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        assert go(tmp_path).ran == ["a", "b"]
        assert go(tmp_path).kept == ["a", "b"]
    assert [str(item.message) for item in warned] == [
        f"{tmp_path / 'out'}: is on a file system without locks; simultaneous runs are not detected"
    ]


def test_other_errors_of_locks_are_not_hidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(file: object, operation: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with lock(tmp_path):
        pass
    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OSError, match="Input/output error"), lock(tmp_path):
        pass
