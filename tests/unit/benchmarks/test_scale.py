"""The runs of the benchmark of scale have the requested episodes, and their steps end."""

from pathlib import Path

from aomgen.episodes.ledger import read_accounts
from benchmarks.scale import EPISODES_FOLDER, complete, find_missing, make_run


def test_the_steps_of_a_small_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    make_run(str(run), "120", "")
    for step in (find_missing, complete):
        step(str(run), "120")
        accounts = read_accounts(run / EPISODES_FOLDER)
        assert [(item.committed, item.attempts) for item in accounts] == [(12, 13)] * 10
    assert [item.left for item in accounts] == [0] * 10
    assert sorted(path.name for path in (run / EPISODES_FOLDER / "000000").iterdir()) == ["episode.json"]
    assert (run / EPISODES_FOLDER / "manifest.json").is_file()
