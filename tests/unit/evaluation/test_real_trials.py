"""Real trials beside the twin: known correlations and rank violations, coverage of the interval in a simulated reality."""

import json
from pathlib import Path

import numpy as np
import pytest

from aomgen.errors import ConfigError, MalformedFileError, UnknownNameError
from aomgen.evaluation.prediction_powered import (
    correlate,
    estimate_real_success,
    mean_maximum_rank_violation,
)
from aomgen.evaluation.real_trials import compare_with_reality, read_real_trials, read_twin_trials
from command_line import aomgen, one_sentence


def reality(
    rng: np.random.Generator, real: float, twin: float, correlation: float, pairs: int, more: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of real and twin results of given rates and correlation, and further twin results."""
    both = real * twin + correlation * np.sqrt(real * (1 - real) * twin * (1 - twin))
    shares = np.array([1 - real - twin + both, twin - both, real - both, both])
    cells = rng.choice(4, pairs, p=shares)
    return cells // 2, cells % 2, (rng.random(more) < twin).astype(int)


@pytest.mark.parametrize("pairs", [10, 20, 50])
@pytest.mark.parametrize(
    ("real", "twin", "correlation"),
    [(0.5, 0.5, 0.0), (0.5, 0.6, 0.6), (0.5, 0.5, 0.9), (0.8, 0.9, 0.5), (0.9, 0.9, 0.7), (0.9, 0.95, 0.0), (0.7, 0.3, 0.4)],
)  # fmt: skip
def test_the_interval_holds_the_real_rate(pairs: int, real: float, twin: float, correlation: float) -> None:
    rng = np.random.default_rng(7)
    held = []
    for _ in range(600):
        low, high = estimate_real_success(
            *reality(rng, real, twin, correlation, pairs, 200 - pairs)
        ).interval_95
        held.append(low <= real <= high)
    # Two standard errors of 600 draws below 95 %.
    assert np.mean(held) >= 0.932


def test_a_related_twin_saves_trials_and_another_does_not() -> None:
    rng = np.random.default_rng(3)
    saved = {
        correlation: np.mean(
            [
                estimate_real_success(*reality(rng, 0.5, 0.6, correlation, 40, 400)).saved_trials
                for _ in range(200)
            ]
        )
        for correlation in (0.0, 0.5, 0.8)
    }
    # n / (1 - r^2) - n real trials are as good, where the twin's rate is known exactly.
    assert saved[0.0] < 3
    assert 6 < saved[0.5] < 16
    assert 30 < saved[0.8] < 75


def test_a_biased_twin_does_not_move_the_estimate() -> None:
    """The twin succeeds far more often than reality; the pairs show it."""
    rng = np.random.default_rng(5)
    estimates = [estimate_real_success(*reality(rng, 0.4, 0.7, 0.5, 200, 2000)).estimate for _ in range(300)]
    assert abs(np.mean(estimates) - 0.4) < 0.01


def test_without_pairs_the_twin_has_no_weight() -> None:
    found = estimate_real_success([1, 1, 0, 1], [], [1] * 100)
    assert (found.weight, found.saved_trials) == (0.0, 0.0)
    # Agresti and Coull's interval: two of each added.
    assert found.estimate == pytest.approx(5 / 8)


def test_trials_that_all_agree_leave_doubt() -> None:
    found = estimate_real_success(np.ones(10), np.ones(10), np.ones(100))
    low, high = found.interval_95
    assert low < 0.85
    assert high == 1.0


def test_rank_violations_by_hand() -> None:
    assert mean_maximum_rank_violation([0.1, 0.5, 0.9], [0.2, 0.3, 0.4]) == 0
    # The second and the third are swapped: each is off by 0.4.
    assert mean_maximum_rank_violation([0.1, 0.5, 0.9], [0.2, 0.7, 0.6]) == pytest.approx(0.8 / 3)
    # The best is taken for the worst.
    assert mean_maximum_rank_violation([0.1, 0.5, 0.9], [0.5, 0.6, 0.1]) == pytest.approx(
        (0.8 + 0.4 + 0.8) / 3
    )


def test_correlation() -> None:
    assert correlate([0.1, 0.5, 0.9], [0.2, 0.4, 0.6]) == pytest.approx(1.0)
    assert correlate([0.1, 0.5, 0.9], [0.9, 0.5, 0.1]) == pytest.approx(-1.0)
    assert correlate([0.5], [0.5]) is None
    assert correlate([0.2, 0.8], [1.0, 1.0]) is None


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two policies, judged in 100 trials of the twin and 20 real ones."""
    rng, rows = np.random.default_rng(11), ["policy,success,trial"]
    for name, real, twin in (("lerobot:act", 0.85, 0.9), ("nearest_replay", 0.4, 0.55)):
        y, f, more = reality(rng, real, twin, 0.5, 20, 80)
        results = [*f, *more]
        rollouts = [
            {"trial": k, "fail_reason": "" if ok else "target", "opening_share": 1.0, "frames": 9}
            for k, ok in enumerate(results)
        ]
        figures = {"policy": name, "suite": "5" * 64, "rollouts": rollouts}
        (tmp_path / f"{real}.json").write_text(json.dumps(figures))
        rows += [f"{name},{'yes' if ok else 'no'},{k}" for k, ok in enumerate(y)]
    (tmp_path / "trials.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "other.json").write_text("{}")
    return tmp_path


def test_the_command(folder: Path) -> None:
    done = aomgen("evaluate", "--real", "trials.csv", "--json", "compared.json", folder=folder)
    assert (done.returncode, done.stderr) == (0, "")
    compared = json.loads((folder / "compared.json").read_text())
    assert set(compared["policies"]) == {"lerobot:act", "nearest_replay"}
    assert (compared["mmrv"], compared["pearson_r"]) == (0, pytest.approx(1.0))
    for item in compared["policies"].values():
        assert (item["pairs"], item["twin"]["trials"], item["real"]["trials"]) == (20, 100, 20)
        low, high = item["combined"]["interval_95"]
        assert high - low < item["real"]["interval_95"][1] - item["real"]["interval_95"][0]
    assert "20 pairs, as " in done.stdout
    assert "MMRV           0.000" in done.stdout


@pytest.mark.parametrize("words", [("--real=trials.csv", "0.4.json"), ("0.4.json", "--real", "trials.csv")])
def test_the_option_is_accepted_in_all_forms(folder: Path, words: tuple[str, ...]) -> None:
    (folder / "trials.csv").write_text("policy,success\nnearest_replay,1\n")
    done = aomgen("evaluate", *words, folder=folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert "over 1 policies" in done.stdout


def test_trials_without_numbers(folder: Path) -> None:
    (folder / "trials.csv").write_text("policy,success\nlerobot:act,1\nlerobot:act,0\n")
    done = aomgen("evaluate", "trials.csv", "--real", folder=folder)
    assert "0 pairs, no trial is named" in done.stdout
    assert "Pearson's r    undefined over 1 policies" in done.stdout


@pytest.mark.parametrize(
    ("text", "code", "said"),
    [
        ("policy,trial\na,1\n", 3, "no rows with the column success"),
        ("", 3, "no rows with the column policy"),
        ("policy,success\nlerobot:act,maybe\n", 3, "row 2 has policy 'lerobot:act', success 'maybe'"),
        ("policy,success,trial\nlerobot:act,1,x\n", 3, "trial 'x'"),
        ("policy,success,trial\nlerobot:act,1,3\nlerobot:act,1,\n", 3, "names the trial in 1 of 2 rows"),
        ("policy,success,trial\nlerobot:act,1,3\nlerobot:act,0,3\n", 3, "trial 3 of policy 'lerobot:act' more than once"),
        ("policy,success,trial\nlerobot:act,1,100\n", 2, "names trial 100, which the suite does not have"),
        ("policy,success\nlerobot:act2,1\n", 2, "did you mean 'lerobot:act'?"),
    ],
)  # fmt: skip
def test_wrong_files(folder: Path, text: str, code: int, said: str) -> None:
    (folder / "trials.csv").write_text(text)
    one_sentence(aomgen("evaluate", "--real", "trials.csv", folder=folder), code, said)


def test_figures_that_do_not_belong_together(folder: Path) -> None:
    with pytest.raises(ConfigError, match="evaluates policy 'lerobot:act', and so does"):
        read_twin_trials([folder / "0.85.json"] * 2)
    other = json.loads((folder / "0.4.json").read_text()) | {"suite": "6" * 64}
    (folder / "0.4.json").write_text(json.dumps(other))
    with pytest.raises(ConfigError, match="belongs to another suite than"):
        read_twin_trials([folder / "0.4.json", folder / "0.85.json"])
    with pytest.raises(MalformedFileError, match="contains no metrics"):
        read_twin_trials([folder / "other.json"])
    with pytest.raises(UnknownNameError):
        compare_with_reality(read_real_trials(folder / "trials.csv"), {"x": {0: 1}}, folder / "trials.csv")
