"""`aomgen export` and `aomgen audit` from the command line: what is printed, and one sentence with an exit code for bad input."""

import shutil
from dataclasses import asdict
from pathlib import Path

import pytest

from aomgen.core.project import Project
from aomgen.datasets.audit import audit_dataset
from aomgen.datasets.formats import export_shard
from aomgen.datasets.selection import MARK
from aomgen.episodes.ledger import ACCOUNTS, Account
from aomgen.errors import ConfigError
from aomgen.io.episode_folder import list_committed
from aomgen.io.review import ReviewChange, change_review
from aomgen.pipeline.manifest import write_manifest
from aomgen.pipeline.project_file import write_project
from aomgen.pipeline.stages import PROJECT_FILE
from command_line import aomgen, one_sentence, started
from small_episodes import commit


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("run")
    for index, frames in enumerate((12, 9, 15)):
        commit(out / "08_episodes", index, frames)
    # What a killed worker left is no episode.
    (out / "08_episodes" / "000007").mkdir()
    write_project(out / PROJECT_FILE, Project(capture=out, out=out, assets=("microwave:1",)))
    return out


def test_export_and_audit(run, tmp_path):
    made = aomgen("export", run, "opening", "--format", "rlds", "--size", "64x48", folder=tmp_path)
    assert (made.returncode, made.stderr) == (0, "")
    assert made.stdout == "wrote opening: 2 training and 1 validation episodes, 36 frames\n"
    found = aomgen("audit", "opening", run, folder=tmp_path)
    assert (found.returncode, found.stderr) == (0, "")
    assert "2 train + 1 val of 3, 36 frames, actions ee_delta" in found.stdout


def test_rejected_episodes_are_left_out(run, tmp_path):
    reviewed = Path(shutil.copytree(run, tmp_path / "reviewed"))
    change_review(reviewed, reviewed / "08_episodes" / "000001", ReviewChange(decision="rejected"))
    made = aomgen("export", "reviewed", "d", "--format", "lerobot-v3", folder=tmp_path)
    said = "left out 1 of 3 episodes: review.json rejects them\n"
    assert made.stdout == f"{said}wrote d: 2 training and 0 validation episodes, 27 frames\n"
    found = aomgen("audit", "d", "reviewed", folder=tmp_path)
    assert (found.returncode, found.stderr) == (0, "")
    assert found.stdout.startswith(f"{said}episodes  2 train of 2, 27 frames")


def test_a_dataset_that_differs_ends_with_an_exit_code(run, tmp_path):
    assert aomgen("export", run, "d", "--format", "lerobot-v3", folder=tmp_path).returncode == 0
    fewer = tmp_path / "fewer"
    shutil.copytree(run, fewer)
    shutil.rmtree(fewer / "08_episodes" / "000001")
    found = aomgen("audit", "d", fewer, folder=tmp_path)
    assert "fault     episode 1 is not committed" in found.stdout
    one_sentence(found, 6, "differs from the episodes in 1 ways", "export it again")


def test_shards_contain_every_episode_once_and_are_kept(run, tmp_path):
    reviewed = Path(shutil.copytree(run, tmp_path / "run"))
    words = ("export", reviewed, "parts", "--format", "lerobot-v3", "--media", "none", "--shard")
    first = aomgen(*words, "1/2", folder=tmp_path)
    assert (first.returncode, first.stderr) == (0, "")
    assert first.stdout == "wrote parts/part_1_of_2: 2 training and 0 validation episodes, 27 frames\n"
    second = aomgen(*words, "2/2", folder=tmp_path)
    assert second.stdout == "wrote parts/part_2_of_2: 1 training and 0 validation episodes, 9 frames\n"
    found = aomgen("audit", "parts/part_1_of_2", "run", "--shard", "1/2", folder=tmp_path)
    assert (found.returncode, found.stderr) == (0, "")
    assert "2 train of 2, 27 frames" in found.stdout
    assert aomgen(*words, "1/2", folder=tmp_path).stdout == "kept parts/part_1_of_2: it is complete\n"
    # Without its request, a shard is as if its process had been killed; with other episodes, it is out of date.
    (tmp_path / "parts" / "shards" / "part_2_of_2.json").unlink()
    assert aomgen(*words, "2/2", folder=tmp_path).stdout == second.stdout
    (tmp_path / "parts" / "shards" / "part_1_of_2.json").write_text("{")
    damaged = started(*words, "1/2", folder=tmp_path)
    assert (damaged.returncode, damaged.stdout) == (0, first.stdout)
    assert damaged.stderr.startswith("warning: ")
    assert damaged.stderr.endswith("; it is computed again\n")
    assert damaged.stderr.count("\n") == 1
    change_review(reviewed, reviewed / "08_episodes" / "000002", ReviewChange(decision="rejected"))
    assert (
        "wrote parts/part_1_of_2: 1 training and 0 validation episodes, 12 frames"
        in aomgen(*words, "1/2", folder=tmp_path).stdout
    )


@pytest.mark.parametrize("format", ["rlds", "hdf5", "lerobot-v3"])
def test_every_format_has_shards(run, tmp_path, format):
    folders = list_committed(run / "08_episodes")
    made = export_shard(folders, tmp_path / "parts", format, "1/1")
    assert made is not None
    assert audit_dataset(tmp_path / "parts" / "part_1_of_1", folders).faults == []


def test_wrong_options_keep_a_complete_shard(run, tmp_path):
    folders = list_committed(run / "08_episodes")
    export_shard(folders, tmp_path, "hdf5", "1/1")
    stated = tmp_path / "shards" / "part_1_of_1.json"
    written = stated.read_bytes()
    for wrong in ({"size": "wide"}, {"size": "800x600"}, {"actions": "ee"}):
        with pytest.raises(ConfigError):
            export_shard(folders, tmp_path, "hdf5", "1/1", **wrong)
    assert stated.read_bytes() == written
    assert export_shard(folders, tmp_path, "hdf5", "1/1") is None


def test_a_file_is_not_a_folder_of_shards(run, tmp_path):
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(ConfigError, match="is a file"):
        export_shard(list_committed(run / "08_episodes"), tmp_path / "notes", "hdf5", "1/1")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--format", "hdf5", "--shard", "3/2"), 2, "'3/2' is not i/n"),
        (("--format", "hdf5", "--shard", "half"), 2, "'half' is not i/n"),
        (("--format", "hdf5", "--shard", "9/9"), 2, "9/9 of 3 episodes has no episode"),
        (("--format", "images", "--n", "5", "--shard", "1/2"), 2, "has no meaning for --format images"),
        (("--format", "parquet"), 2, "'parquet' is unknown"),
        (("--format", "rlds", "--val", "3"), 2, "3 of 3 episodes leaves none to train on"),
        (("--format", "hdf5", "--size", "wide"), 2, "'wide' is not WxH"),
        (("--format", "hdf5", "--size", "800x600"), 2, "larger than what camera 'front' rendered, 80x64"),
    ],
)
def test_wrong_options_leave_nothing(run, tmp_path, words, code, said):
    one_sentence(aomgen("export", run, "dataset", *words, folder=tmp_path), code, said)
    assert list(tmp_path.iterdir()) == []


def test_a_foreign_folder_is_kept(run, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_bytes(b"cat")
    one_sentence(aomgen("export", run, "photos", "--format", "hdf5", folder=tmp_path), 2, "photos: ", MARK)
    one_sentence(aomgen("export", run, run, "--format", "hdf5", folder=tmp_path), 2, f"{run}: ", MARK)
    assert (tmp_path / "photos" / "cat.jpg").read_bytes() == b"cat"
    assert (run / PROJECT_FILE).is_file()


def test_the_status_of_finished_episodes_is_in_their_manifest(run, tmp_path):
    finished = Path(shutil.copytree(run, tmp_path / "run"))
    account = Account(
        asset="a", requested=4, committed=3, rejected=1, attempts=9, reasons={"collision": 2, "unstable": 4}
    )
    write_manifest(finished / "08_episodes", "episodes", (0, {}, {}), {ACCOUNTS: [asdict(account)]})
    stated = (
        "a: 3 of 4 episodes committed, 1 missing, 0 remaining; 9 samples planned "
        "(rejected or skipped: 4 unstable, 2 collision)"
    )
    assert stated in aomgen("status", "run", folder=tmp_path).stdout
    # Without one of its files the stage is not finished, and its episodes are counted.
    (finished / "08_episodes" / "000001" / "front.mp4").unlink()
    assert "a: 3 of 4" not in aomgen("status", "run", folder=tmp_path).stdout


def test_a_run_without_episodes_is_refused(run, tmp_path):
    (tmp_path / "08_episodes").mkdir()
    shutil.copy(run / PROJECT_FILE, tmp_path)
    one_sentence(
        aomgen("export", tmp_path, "d", "--format", "hdf5", folder=tmp_path), 3, "holds no committed episode"
    )
    one_sentence(aomgen("export", "nowhere", "d", "--format", "hdf5", folder=tmp_path), 3, "is missing")


def test_a_cut_shard_is_told(run, tmp_path):
    assert aomgen("export", run, "opening", "--format", "rlds", folder=tmp_path).returncode == 0
    shard = next((tmp_path / "opening" / "1.0.0").glob("*train*"))
    shard.write_bytes(shard.read_bytes()[:-100])
    one_sentence(
        aomgen("audit", "opening", run, folder=tmp_path), 3, "ends inside record 1", "export it again"
    )


def test_an_action_space_of_the_project_that_does_not_exist_is_refused(run, tmp_path):
    one_sentence(
        aomgen("run", run, "--set", "dataset.actions=ee_detla", folder=tmp_path), 2, "did you mean 'ee_delta'"
    )
