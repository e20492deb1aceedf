"""`refused.html`: what a demonstration showed from which no motion could be recovered."""

from pathlib import Path

import numpy as np

from aomgen.core.motion import MotionCurve
from aomgen.io.artifact import load_artifact
from aomgen.io.atomic import write_text
from aomgen.motion.estimates_file import REFUSED_FILE, REFUSED_MOTION
from aomgen.report.charts import Chart, draw_chart
from aomgen.report.html import page, paragraph, section


def write_refusal(out: Path, reason: str) -> Path | None:
    """Draw the motion score that a refused run left behind.

    Args:
        out: The run's folder.
        reason: The error's sentence.

    Returns:
        Path of the page; None when the run was refused before or after its motion.
    """
    if not (out / f"{REFUSED_MOTION}.json").is_file():
        return None
    curve = load_artifact(out, REFUSED_MOTION, MotionCurve)
    body = [
        "<h1>No motion was recovered</h1>",
        paragraph(reason),
        section("Evidence", *_charts(curve)),
    ]
    path = out / REFUSED_FILE
    write_text(path, page("No motion was recovered", body))
    return path


def _charts(curve: MotionCurve) -> list[str]:
    times = curve.times_s
    score = Chart(
        x_label="video time [s]",
        y_label="motion score",
        curves=[("score", times, curve.scores), ("smoothed", times, curve.smoothed)],
        level=("stillness", curve.threshold),
    )
    hand = Chart(
        x_label="video time [s]",
        y_label="hand, shares of the largest",
        curves=[
            (name, times, values / max(float(np.max(values)), 1e-9))
            for name, values in (
                (f"distance, largest {100 * float(curve.distances_m.max()):.0f} cm", curve.distances_m),
                (f"speed, {curve.speeds_m_s.max():.2f} m/s", curve.speeds_m_s),
                ("gripper closed", curve.gripper),
            )
        ],
    )
    return [
        paragraph("The share of the part's picture that shows neither its first nor its last place."),
        draw_chart(score),
        paragraph("Fingers to part, speed of the hand, and how far the gripper is closed."),
        draw_chart(hand),
    ]
