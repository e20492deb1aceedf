"""What a refused demonstration leaves for its user."""

from pathlib import Path

import numpy as np

from aomgen.core.motion import MotionCurve
from aomgen.io.artifact import save_artifact
from aomgen.motion.estimates_file import REFUSED_MOTION, forget_refusal
from aomgen.report.refusal import write_refusal


def curve() -> MotionCurve:
    times = np.arange(20) / 10
    return MotionCurve(
        times_s=times,
        scores=np.full(20, 0.01),
        smoothed=np.zeros(20),
        threshold=0.02,
        distances_m=np.full(20, 0.3),
        speeds_m_s=np.zeros(20),
        gripper=np.zeros(20),
    )


def test_the_score_is_drawn_beside_the_reason(tmp_path: Path) -> None:
    save_artifact(tmp_path, REFUSED_MOTION, curve())
    page = write_refusal(tmp_path, "the part does not move")
    assert page is not None
    text = page.read_text()
    assert "the part does not move" in text
    assert text.count("<svg") == 2


def test_a_run_refused_elsewhere_or_forgotten_has_no_page(tmp_path: Path) -> None:
    assert write_refusal(tmp_path, "no images") is None
    save_artifact(tmp_path, REFUSED_MOTION, curve())
    write_refusal(tmp_path, "the part does not move")
    forget_refusal(tmp_path)
    assert list(tmp_path.iterdir()) == []
