"""Decisions on episodes: nothing is lost when several processes write, are killed, or run again."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from aomgen.errors import ConfigError, MalformedFileError, MissingFileError
from aomgen.io.review import (
    REVIEW_FILE,
    Review,
    ReviewChange,
    change_review,
    leave_out_rejected,
    read_reviews,
)
from small_episodes import commit

# Decides about one episode after the other, and prints what is on disk when a decision has returned.
WRITER = """
import sys
from pathlib import Path
from aomgen.io.review import ReviewChange, change_review
out = Path(sys.argv[1])
for number in range(1_000):
    change_review(out, out / "000001", ReviewChange(note=str(number)))
    print(number, flush=True)
"""


@pytest.fixture
def out(tmp_path: Path) -> Path:
    for index in (0, 1, 2):
        commit(tmp_path, index, 5, cameras=("front",))
    return tmp_path


def test_changes_are_merged(out: Path) -> None:
    assert read_reviews(out) == {}
    change_review(out, out / "000001", ReviewChange(decision="rejected", add_tags=("dark", "blurred")))
    change_review(out, out / "000001", ReviewChange(note=" too dark ", remove_tags=("dark",)))
    change_review(out, out / "000002", ReviewChange(decision="accepted"))
    found = read_reviews(out)
    assert {n: (r.decision, r.tags, r.note) for n, r in found.items()} == {
        1: ("rejected", ("blurred",), "too dark"),
        2: ("accepted", (), ""),
    }
    kept = leave_out_rejected(out, [out / f"{n:06d}" for n in (0, 1, 2)])
    assert [path.name for path in kept] == ["000000", "000002"]


def test_many_windows_lose_nothing(out: Path) -> None:
    def decide(number: int) -> None:
        change_review(out, out / "000001", ReviewChange(add_tags=(f"tag {number:02d}",)))
        change_review(out, out / "000002", ReviewChange(add_tags=(f"tag {number:02d}",)))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(decide, range(24)))
    wanted = tuple(f"tag {number:02d}" for number in range(24))
    assert {number: item.tags for number, item in read_reviews(out).items()} == {1: wanted, 2: wanted}


def test_a_killed_process_loses_no_decision(out: Path) -> None:
    writer = subprocess.Popen([sys.executable, "-c", WRITER, out], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    for _ in range(20):
        last = int(writer.stdout.readline())
    os.kill(writer.pid, signal.SIGKILL)
    last = max([last, *map(int, writer.stdout.read().split())])
    writer.wait()
    note = int(read_reviews(out)[1].note)
    # The next decision may be on disk without having returned.
    assert last <= note <= last + 1
    start = time.monotonic()
    change_review(out, out / "000001", ReviewChange(note="after"))
    assert time.monotonic() - start < 5


def test_another_episode_of_the_same_number_is_undecided(out: Path) -> None:
    change_review(out, out / "000001", ReviewChange(decision="rejected", note="blurred"))
    commit(out, 1, 6, cameras=("front",))
    assert len(leave_out_rejected(out, [out / "000000", out / "000001"])) == 2
    changed = change_review(out, out / "000001", ReviewChange(add_tags=("new",)))
    assert (changed.decision, changed.tags, changed.note) == ("", ("new",), "")


def test_rejecting_all_is_named(out: Path) -> None:
    change_review(out, out / "000001", ReviewChange(decision="rejected"))
    with pytest.raises(ConfigError, match="rejects all 1 episodes; accept some of them"):
        leave_out_rejected(out, [out / "000001"])
    with pytest.raises(MissingFileError):
        change_review(out, out / "000009", ReviewChange(decision="rejected"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is not valid JSON"),
        ('{"episodes": {"000001": {"decision": "perhaps"}}}', "'episodes.000001.decision' is 'perhaps'"),
        ('{"episodes": {"000001": {"colour": "red"}}}', "colour' is unknown"),
        ('{"episodes": {"one": {}}}', "names no episode"),
        ("[]", "review.json: "),
    ],
)
def test_a_damaged_file_is_one_sentence_and_stays(out: Path, text: str, said: str) -> None:
    (out / REVIEW_FILE).write_text(text)
    with pytest.raises(MalformedFileError) as caught:
        change_review(out, out / "000001", ReviewChange(decision="accepted"))
    assert said in str(caught.value)
    assert "or delete review.json and with it all decisions" in str(caught.value)
    assert (out / REVIEW_FILE).read_text() == text


def test_reviews_are_bounded() -> None:
    for change in ({"decision": "maybe"}, {"note": "x" * 2001}, {"add_tags": [" "]}, {"episode": 3}):
        with pytest.raises(ValueError):
            ReviewChange.model_validate(change)
    assert Review().merge(ReviewChange(note="  a "), "digest").note == "a"
