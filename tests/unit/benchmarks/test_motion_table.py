import numpy as np
import pytest

from benchmarks.motion_accuracy import Case, Outcome, cases
from benchmarks.motion_table import (
    fractions_of,
    motion_table,
    percentile,
    summaries_of,
    summary,
    told,
    unsolvable_of,
)
from benchmarks.motion_worlds import UNSOLVABLE, Kind


def outcome(
    number: int, *, refusal: str = "", type_ok: bool = True, axis: float = 0.5, kind: Kind = "open"
) -> Outcome:
    figures = {
        "joint.type_ok": type_ok,
        "joint.axis_deg": axis,
        "joint.origin_mm": 2.0,
        "theta.rmse_deg": 0.1,
        "contact_mm": 5.0,
        "keyframes.start_error_s": 0.0,
        "keyframes.end_error_s": 0.1,
        "half_width.axis_deg": 1.0,
        "inside.axis": float(axis <= 1.0),
    }
    return Outcome(
        case=Case(
            category="microwave",
            seed=number,
            kind=kind,
            group="unsolvable" if kind in UNSOLVABLE else "solvable",
        ),
        joint_type="revolute",
        method="ours",
        refusal=refusal,
        reason="the part does not move" if refusal else "",
        figures={} if refusal else figures,
        moving_share=0.4,
        seconds=2.0,
    )


def test_percentile_by_hand():
    assert percentile([4.0, 1.0, 3.0, 2.0], 0.5) == 2.5
    assert percentile([0.0, 10.0], 0.9) == 9.0
    assert percentile([1.0, np.inf, 2.0], 0.5) == 2.0
    assert percentile([1.0, 2.0, np.inf], 0.9) is None
    assert percentile([], 0.5) is None


def test_refusals_and_wrong_types_are_failures_in_every_percentile():
    outcomes = [outcome(0), outcome(1), outcome(2, refusal="NoMotionError"), outcome(3, type_ok=False)]
    figures = summary(outcomes)
    assert (figures["refusals"], figures["wrong_type"], figures["failures"]) == (1, 1, 2)
    assert figures["joint.axis_deg"] == {"median": None, "p90": None, "of": 4}
    assert summary(outcomes[:3])["joint.axis_deg"] == {"median": 0.5, "p90": None, "of": 3}


def test_intervals_are_judged_where_there_is_an_answer():
    figures = summary([outcome(0, axis=0.4), outcome(1, axis=0.5), outcome(2, axis=3.0)])
    assert figures["intervals"]["axis"]["inside"] == pytest.approx(2 / 3)
    assert figures["intervals"]["axis"]["half_width_over_error"] == pytest.approx(2.0)


def test_a_figure_that_a_joint_type_lacks_is_not_a_failure():
    figures = summary([outcome(0)])
    assert figures["theta.rmse_mm"]["of"] == 0
    table = motion_table(summaries_of([outcome(0)]))
    row = next(line for line in table.splitlines() if "theta.rmse_mm" in line)
    assert row.split()[-2:] == ["-", "-"]


def test_progress_names_the_refusal():
    assert told(outcome(2, refusal="NoMotionError")).endswith("NoMotionError: the part does not move")


def test_unsolvable_worlds_count_as_right_only_with_the_error_that_says_why():
    outcomes = [
        outcome(0, kind="nothing", refusal="NoMotionError"),
        outcome(1, kind="nothing", refusal="AmbiguousJointError"),
        outcome(2, kind="short", refusal="DemonstrationTooShortError"),
        outcome(3, kind="short"),
    ]
    rows = {row["unsolvable"]: row for row in unsolvable_of(outcomes)}
    assert (rows["nothing"]["rightly_refused"], rows["nothing"]["refused_otherwise"]) == (1, 1)
    assert (rows["short"]["answered"], rows["all"]["share"]) == (1, 0.5)
    assert summaries_of(outcomes)["all"]["worlds"] == 0


def test_start_errors_are_grouped_by_moving_share():
    rows = {
        row["moving_share"]: row for row in fractions_of([outcome(0), outcome(1, refusal="NoMotionError")])
    }
    assert (rows["0.4-0.6"]["worlds"], rows["0.4-0.6"]["start_within"]) == (2, 1)
    assert rows["0.4-0.6"]["start_worst_s"] is None


def test_fifty_cases_are_ten_seeds_of_five_categories_with_twenty_unsolvable():
    found = cases(50, 2000)
    solvable = [case for case in found if case.group == "solvable"]
    assert len({(case.category, case.seed) for case in solvable}) == 50
    assert {case.seed for case in solvable} == set(range(2000, 2010))
    unsolvable = [case for case in found if case.group == "unsolvable"]
    assert len(unsolvable) == 20
    assert len({(case.category, case.kind) for case in unsolvable}) == 20
