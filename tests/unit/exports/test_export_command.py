"""`aomgen export` to files: refusals are one sentence and leave nothing behind."""

from pathlib import Path

import pytest

from aomgen.core.project import Project
from aomgen.exports import formats
from aomgen.io.atomic import write_bytes
from aomgen.pipeline.project_file import write_project
from aomgen.pipeline.stages import PROJECT_FILE
from command_line import aomgen, one_sentence


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    (out / "01_structure").mkdir()
    write_project(out / PROJECT_FILE, Project(capture=out, out=out, assets=("microwave:1",)))
    return out


@pytest.mark.parametrize(
    ("words", "code", "parts"),
    [
        (("twin.foo",), 2, ("has suffix '.foo'", ".usda", ".mcap", "lerobot-v3")),
        (("dataset",), 2, ("has no suffix of a file", "--format")),
        (("twin.ply", "--val", "1"), 2, ("--val: has no meaning for .ply", "leave it out")),
        (("twin.usdc", "--format", "rlds"), 2, ("--format: has no meaning for .usdc",)),
        (("dataset", "--format", "rlds", "--joint", "1"), 2, ("--joint: has no meaning for a dataset",)),
        (("twin.xml", "--time", "2"), 2, ("--time: has no meaning for .xml", ".ply, .splat, .spz, .glb")),
        (("d", "--format", "rlds", "--n", "9"), 2, ("--n: has no meaning without --format images",)),
        (("twin.ply", "--style", "wide"), 2, ("--style: has no meaning without --format images",)),
        (("d", "--format", "images"), 2, ("--n: is missing", "state the number")),
        (("d", "--format", "images", "--n", "9", "--val", "1"), 2, ("--val: has no meaning for --format",)),
        (("d", "--format", "images", "--n", "9", "--size", "9"), 2, ("'9' is not WxH",)),
        (("d", "--format", "images", "--n", "9"), 3, ("has no result of stage 'replacement'",)),
        (("twin.ply",), 3, ("has no result of stage 'twin'", "aomgen run")),
        (("twin.usdc",), 3, ("has no result of stage 'replacement'",)),
        (("twin.ply", "--episode", "3"), 3, ("has no result of stage 'replacement'",)),
        (("twin.xml",), 3, ("holds no committed episode", "aomgen run")),
    ],
)
def test_refusals(
    run: Path, tmp_path: Path, words: tuple[str, ...], code: int, parts: tuple[str, ...]
) -> None:
    one_sentence(aomgen("export", run, *words, folder=tmp_path), code, *parts)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".rrd", ".mcap"])
def test_a_missing_package_is_named_with_its_extra(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    monkeypatch.setitem(formats.PACKAGES, suffix, ("no_such_package", "the-extra"))
    done = aomgen("export", run, f"twin{suffix}", folder=tmp_path)
    one_sentence(done, 4, "no_such_package: is not installed", "pip install 'aomgen[the-extra]'")


@pytest.mark.parametrize("suffix", [".usdc", ".xml", ".ply", ".spz", ".glb", ".rrd", ".mcap"])
def test_a_folder_that_cannot_be_written(results, motion, tmp_path: Path, suffix: str) -> None:
    from aomgen.errors import StorageError
    from aomgen.exports.formats import write_motion

    if suffix in formats.PACKAGES:
        pytest.importorskip(formats.PACKAGES[suffix][0])
    # A file where the folder should be is refused to everybody, a read-only folder not to root.
    write_bytes(tmp_path / "file", b"")
    with pytest.raises(StorageError, match="free space or choose another folder"):
        write_motion(results, motion, tmp_path / "file" / f"twin{suffix}")
    assert [item.name for item in tmp_path.iterdir()] == ["file"]
