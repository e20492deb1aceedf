"""The table of both alignment methods."""

from benchmarks.alignment_methods import methods_table, paper_figures


def test_figures_of_both_methods_stand_side_by_side() -> None:
    scored = {"alignment.end_effector_mm": 8.0, "joint.axis_deg": 1.0, "parts.robot_iou": None}
    figures = {"alignment.end_effector_mm": 1.0, "parts.robot_iou": 0.9} | paper_figures(scored, 3.21)
    assert figures["paper.seconds"] == 3.2
    assert "paper.joint.axis_deg" not in figures
    lines = [line.split() for line in methods_table(figures).splitlines()]
    assert lines[0] == ["figure", "outlines", "paper"]
    assert ["alignment.end_effector_mm", "1", "8"] in lines
    assert ["parts.robot_iou", "0.9", "-"] in lines
