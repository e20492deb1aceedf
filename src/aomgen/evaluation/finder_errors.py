"""Tables of keypoint errors: median, 90th percentile, and the share that the gripper tolerates."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from aomgen.core.keypoints import KEYPOINTS
from aomgen.core.values import Array

# The gripper tolerates about this error at the handle, [mm].
TOLERATED_MM: Final = 10.0
Row = dict[str, Any]


def summarize_errors(errors_mm: Array) -> Row:
    """Compute number, median, 90th percentile and tolerated share of finite errors; only the number if it is zero."""
    known = errors_mm[np.isfinite(errors_mm)]
    if not len(known):
        return {"number": 0}
    median, high = np.percentile(known, (50, 90))
    share = float(np.mean(known <= TOLERATED_MM))
    return {"number": len(known), "median_mm": float(median), "p90_mm": float(high), "within_10_mm": share}


def summarize_points(errors_mm: Array) -> dict[str, Row]:
    """Summarize the errors (N, 5) of each keypoint; missing values are NaN."""
    return {name: summarize_errors(errors_mm[:, number]) for number, name in enumerate(KEYPOINTS)}


def format_errors(table: Mapping[str, Row], title: str) -> str:
    """Format a table as text, with one line for each row that has errors."""
    lines = [f"{title:24}{'number':>8}{'median':>12}{'90 %':>12}{'within 10 mm':>15}"]
    lines += [
        f"{name:24}{row['number']:8d}{row['median_mm']:9.1f} mm{row['p90_mm']:9.1f} mm{row['within_10_mm']:15.2f}"
        for name, row in table.items()
        if row["number"]
    ]
    return "\n".join(lines)
