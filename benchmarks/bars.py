"""Thresholds that a twin has to reach: one per metric, the same for every capture."""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """A limit on a metric.

    Attributes:
        limit: The value that still passes.
        at_most: Whether smaller is better.
    """

    limit: float
    at_most: bool

    def met(self, value: float | None) -> bool:
        """Return whether a metric passes; a refusal never does."""
        if value is None:
            return False
        return value <= self.limit if self.at_most else value >= self.limit

    def __str__(self) -> str:
        return f"{'<=' if self.at_most else '>='} {self.limit:g}"


def _at_most(limit: float) -> Bar:
    return Bar(limit=limit, at_most=True)


def _at_least(limit: float) -> Bar:
    return Bar(limit=limit, at_most=False)


BARS: Final[dict[str, Bar]] = {
    "alignment.end_effector_mm": _at_most(3.0),
    "alignment.end_effector_mm_worst": _at_most(6.0),
    "alignment.rotation_deg": _at_most(0.15),
    "alignment.scale_pct": _at_most(0.2),
    "cameras.median_mm": _at_most(3.0),
    "demo_camera.mm": _at_most(5.0),
    "clock_offset_ms_error": _at_most(20.0),
    "parts.robot_iou": _at_least(0.93),
    "parts.moving_iou": _at_least(0.88),
    "parts.static_iou": _at_least(0.88),
    "images.heldout_psnr": _at_least(29.0),
    "images.replay_psnr_rest": _at_least(27.0),
    "images.replay_psnr_robot": _at_least(22.0),
}
