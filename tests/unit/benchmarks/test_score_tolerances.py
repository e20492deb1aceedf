"""Verdicts on figures before and after a change."""

import pytest

from benchmarks.score_tolerances import as_rows, judge


@pytest.mark.parametrize(
    ("name", "old", "new", "verdict"),
    [
        ("capture-a.scan.psnr_db", 30.0, 29.81, "same"),
        ("capture-a.scan.psnr_db", 30.0, 29.79, "worse"),
        ("replace.mesh.psnr_256_worst", 30.0, 30.3, "better"),
        ("motion.summaries.all.joint.axis_deg.median", 1.0, 1.04, "same"),
        ("motion.summaries.all.joint.axis_deg.p90", 1.0, 1.06, "worse"),
        ("synthetic.worst.joint.origin_mm", 2.0, 1.8, "better"),
        ("splatting.cases.0.forward_ms", 10.0, 10.6, "worse"),
        ("generate.demonstrations_per_minute", 40.0, 37.0, "worse"),
        ("generate.core_seconds.render", 2.0, 2.2, "worse"),
        ("capture-a.parts.moving_iou", 0.9, 0.96, "better"),
        ("motion.summaries.all.joint.axis_deg.median", 1.0, float("nan"), "worse"),
    ],
)
def test_images_are_held_to_decibels_and_the_rest_to_shares(name, old, new, verdict):
    (row,) = judge({name: old}, {name: new})
    assert row.verdict == verdict
    assert row.passes == (verdict != "worse")


def test_success_rates_are_held_to_wilsons_interval():
    before = {"replay.drawer.success_rate": 0.9, "replay.drawer.attempts": 50.0}
    # Wilson's 95 % interval of 45 of 50 is 0.786 to 0.957.
    for rate, verdict in ((0.8, "same"), (0.78, "worse"), (0.96, "better")):
        rows = judge(before, before | {"replay.drawer.success_rate": rate})
        assert [row.verdict for row in rows] == [verdict]


def test_counts_of_failures_are_held_to_wilsons_interval():
    before = {"motion.summaries.all.failures": 2.0, "motion.summaries.all.worlds": 30.0}
    for count, verdict in ((4.0, "same"), (7.0, "worse"), (0.0, "better")):
        (row,) = judge(before, before | {"motion.summaries.all.failures": count})
        assert row.verdict == verdict
    # Without a number of trials, one more is worse.
    (row,) = judge({"synthetic.refusals": 0.0}, {"synthetic.refusals": 1.0})
    assert row.verdict == "worse"


def test_missing_figures_do_not_pass_and_neutral_ones_are_not_judged():
    rows = judge({"gone_mm": 1.0, "gaussians": 5.0}, {"new_mm": 2.0, "gaussians": 9.0})
    assert [(row["figure"], row["verdict"]) for row in as_rows(rows)] == [
        ("gone_mm", "missing"),
        ("new_mm", "new"),
    ]
    assert [row.passes for row in rows] == [False, True]
