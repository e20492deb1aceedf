"""Median and worst over captures, where refusals count as failures."""

import pytest

from aomgen.errors import AlignmentError, ConfigError
from benchmarks import synthetic_captures
from benchmarks.bars import BARS, Bar
from benchmarks.estimate_commands import accuracy
from benchmarks.synthetic_captures import (
    REFUSED,
    accuracy_table,
    run_synthetic,
    summary,
    synthetic_table,
)

EE, PSNR = "alignment.end_effector_mm", "images.heldout_psnr"


def captures(*rows: dict | None) -> dict:
    return {f"capture-{i}": row or {REFUSED: "no"} for i, row in enumerate(rows)}


def test_worst_is_the_largest_error_and_the_smallest_psnr():
    result = summary(captures({EE: 1.0, PSNR: 30.0}, {EE: 4.0, PSNR: 31.0}, {EE: 2.0, PSNR: 25.0}))
    assert (result["median"][EE], result["worst"][EE]) == (2.0, 4.0)
    assert (result["median"][PSNR], result["worst"][PSNR]) == (30.0, 25.0)


def test_a_refusal_is_the_worst_and_moves_the_median():
    result = summary(captures({EE: 1.0, PSNR: 30.0}, {EE: 2.0, PSNR: 31.0}, None))
    assert result["worst"][EE] is None
    assert result["worst"][PSNR] is None
    assert result["median"][EE] == 2.0
    assert result["median"][PSNR] == 30.0
    assert result["refusals"][EE] == 1
    mostly_refused = summary(captures({EE: 1.0}, None, None))
    assert mostly_refused["median"][EE] is None


def test_bars_reject_refusals_and_know_their_direction():
    small, large = Bar(limit=3.0, at_most=True), Bar(limit=22.0, at_most=False)
    assert small.met(3.0)
    assert not small.met(3.01)
    assert not small.met(None)
    assert large.met(22.0)
    assert not large.met(21.9)
    assert not large.met(None)


def test_tables_name_every_bar_and_every_capture():
    results = {"captures": captures({EE: 1.0}, None)}
    table = synthetic_table(results | summary(results["captures"]))
    assert all(name in table for name in BARS)
    assert "capture-1" in table
    assert "no" in table
    assert "False" in accuracy_table({EE: 99.0})


def test_refused_capture_is_kept_and_not_run_again(tmp_path, monkeypatch):
    calls = []

    def refuse(capture, out, run_project):
        calls.append(capture)
        raise AlignmentError("alignment", "two places of the robot are confirmed alike", "add a box")

    monkeypatch.setattr(synthetic_captures, "make_capture", lambda folder, **_: folder.mkdir(parents=True))
    monkeypatch.setattr(synthetic_captures, "run_accuracy", refuse)
    first = run_synthetic(2, tmp_path, lambda *_: None)
    again = run_synthetic(2, tmp_path, lambda *_: None)
    assert len(calls) == 2
    assert first == again
    assert all("two places" in figures[REFUSED] for figures in first["captures"].values())
    assert first["refusals"][EE] == 2


def test_captures_of_one_category(tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic_captures, "make_capture", lambda folder, **_: folder.mkdir(parents=True))
    monkeypatch.setattr(synthetic_captures, "run_accuracy", lambda *_: {})
    result = run_synthetic(3, tmp_path, lambda *_: None, 6000, category="laptop")
    assert list(result["captures"]) == ["laptop-6000", "laptop-6001", "laptop-6002"]
    with pytest.raises(
        ConfigError, match=r"'toaster' is unknown.*cabinet, drawer, laptop, microwave, toolbox"
    ):
        run_synthetic(1, tmp_path, lambda *_: None, category="toaster")
    with pytest.raises(ConfigError, match="--synthetic"):
        accuracy(capture=tmp_path, category="laptop")


def test_errors_of_the_machine_are_not_refusals(tmp_path, monkeypatch):
    def broken(*_):
        raise OSError("disk full")

    monkeypatch.setattr(synthetic_captures, "make_capture", lambda folder, **_: folder.mkdir(parents=True))
    monkeypatch.setattr(synthetic_captures, "run_accuracy", broken)
    with pytest.raises(OSError, match="disk full"):
        run_synthetic(1, tmp_path, lambda *_: None)
