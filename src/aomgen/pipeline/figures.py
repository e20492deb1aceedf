"""Presentation of the metrics of stages: names, units, digits, and limits of good values."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

Verdict = Literal["good", "poor", ""]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """Presentation of one metric of a stage.

    Attributes:
        name: Name of the metric in words.
        unit: Unit after the number; a number without a unit is a count.
        digits: Number of digits after the decimal point.
        factor, offset: The displayed number is the value times `factor`, plus `offset`.
        above, below: The metric is good if the displayed number is above, or below, this limit; at most one of them is given.
        of: Name of the metric of which this one is a part; the limit is then a percentage of it.
        zero_is_unknown: 0 means that the method does not estimate the metric, which is then not displayed.
    """

    name: str
    unit: str = ""
    digits: int = 0
    factor: float = 1.0
    offset: float = 0.0
    above: float | None = None
    below: float | None = None
    of: str = ""
    zero_is_unknown: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One metric, formatted for display; fields that do not apply are "".

    Attributes:
        name: Name of the metric in words.
        number: Number without unit, or a word.
        unit: Unit of the number.
        verdict: Comparison of the number with its limit.
        limit: Text of the limit, for example "good below 1".
        counted: The value precedes the name, as in "64 of 64 images registered".
    """

    name: str
    number: str
    unit: str = ""
    verdict: Verdict = ""
    limit: str = ""
    counted: bool = False

    @property
    def value(self) -> str:
        """Number and unit."""
        return f"{self.number} {self.unit}".strip()

    @property
    def title(self) -> str:
        """Name and unit, for the header of a column."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def sentence(self) -> str:
        """Value, name and limit as a phrase, which contains "poor" if the value is poor."""
        words = f"{self.value} {self.name}" if self.counted else f"{self.name} {self.value}"
        if not self.limit:
            return words
        return f"{words} ({'poor, ' if self.verdict == 'poor' else ''}{self.limit})"


# The limits of good values are stricter than those at which a stage refuses to finish, which every finished stage satisfies.
# Limits that docs/results.md states as required are used here as well.
FIGURES: Final[dict[str, dict[str, Figure]]] = {
    "structure": {
        # Every image that is not registered leaves a gap in the scan; the stage refuses results below 80 %.
        "registered": Figure(name="images registered", of="of", above=95.0),
        # SIFT locates corners with an accuracy of about half a pixel; the stage refuses results above 1.5 px.
        "reprojection_error_px": Figure(name="reprojection error", unit="px", digits=2, below=1.0),
        "points": Figure(name="points"),
    },
    "gaussians": {
        "gaussians": Figure(name="Gaussians"),
        # The bundled capture and five synthetic captures all reach 28.5 dB.
        "heldout_psnr": Figure(name="held-out views", unit="dB", digits=1, above=28.0),
    },
    "alignment": {
        "residual_px": Figure(name="outline error", unit="px", digits=2, below=1.0),
        "end_effector_sd_mm": Figure(name="end effector, standard deviation", unit="mm", digits=2, below=3.0),
        "largest_joint_zero_deg": Figure(
            name="largest joint zero", unit="deg", digits=2, below=0.5, zero_is_unknown=True
        ),
    },
    "parts": {
        "robot": Figure(name="Gaussians of the robot"),
        "static": Figure(name="of the static part"),
        "moving": Figure(name="of the moving part"),
        # The stage warns below 60 %.
        "static_agreement": Figure(name="labels in masks, static", unit="%", factor=100.0, above=60.0),
        "moving_agreement": Figure(name="labels in masks, moving", unit="%", factor=100.0, above=60.0),
        # This is the mean over the four sides of a box; the stage warns above 5 %.
        "box_misfit": Figure(
            name="distance from the prompted boxes", unit="% of a box", digits=1, factor=25.0, below=5.0
        ),
    },
    "motion": {
        "direction": Figure(name="direction"),
        "joint": Figure(name="joint"),
        # Verification requires at least this travel of an episode.
        "moved_deg": Figure(name="moved by", unit="deg", digits=1, above=30.0),
        "moved_mm": Figure(name="moved by", unit="mm", above=100.0),
        "start_s": Figure(name="from", unit="s", digits=2),
        "end_s": Figure(name="to", unit="s", digits=2),
        "axis_ci95_deg": Figure(
            name="uncertainty of the axis", unit="deg", digits=1, below=2.0, zero_is_unknown=True
        ),
        "origin_ci95_mm": Figure(
            name="uncertainty of the origin", unit="mm", digits=1, below=10.0, zero_is_unknown=True
        ),
        "clock_offset_s": Figure(name="clock offset", unit="s", digits=3),
        # The stage warns below 2.
        "part_odds": Figure(
            name="fit of the prompted part against any other", unit="times better", digits=1, above=2.0
        ),
    },
    "twin": {"gaussians": Figure(name="Gaussians"), "moving": Figure(name="on moving bodies")},
    "replacement": {
        "assets": Figure(name="assets"),
        "rejected": Figure(name="assets left out"),
        "removed": Figure(name="Gaussians removed"),
        "filled": Figure(name="Gaussians filled in"),
        "obstacles": Figure(name="obstacles"),
    },
    "episodes": {
        "episodes": Figure(name="episodes"),
        "short": Figure(name="missing"),
        "rejected": Figure(name="samples rejected"),
        "skipped": Figure(name="samples skipped"),
        # The pass rule requires 90 % of the planned travel in every setting.
        "smallest_margin": Figure(
            name="least travel", unit="% of the plan", digits=1, factor=100.0, offset=90.0, above=90.0
        ),
        "cameras": Figure(name="cameras"),
    },
    "dataset": {"episodes": Figure(name="episodes"), "frames": Figure(name="frames")},
    # The following groups are not stages: verdicts of episodes, planned motions, coverage of the object's sides, fixed cameras.
    "verdict": {
        "target_share": Figure(name="least travel", unit="% of the plan", digits=1, factor=100.0, above=90.0),
        "contact_share": Figure(name="moved in contact", unit="%", digits=1, factor=100.0, above=80.0),
        "tracking_mm": Figure(name="tracking error", unit="mm", digits=1, below=20.0),
        "torque_share": Figure(name="torque of the drives", unit="%", factor=100.0, below=90.0),
        "handle_penetration_mm": Figure(name="penetration of the handle", unit="mm", digits=1, below=1.5),
        "robot_force_n": Figure(name="force on other bodies", unit="N", below=15.0),
        "peak_force_n": Figure(name="peak grip force", unit="N"),
        "peak_reaction_n": Figure(name="peak force on the object", unit="N"),
        # A certified episode satisfies these limits of the pass rule.
        "pushed_share": Figure(name="moved by other contacts", unit="%", digits=1, factor=100.0, below=10.0),
        "start_share": Figure(name="moved before contact", unit="%", digits=2, factor=100.0, below=2.0),
        "written_share": Figure(name="travel without a force", unit="%", digits=2, factor=100.0, below=5.0),
        "penetration_mm": Figure(name="penetration of other bodies", unit="mm", digits=2, below=1.0),
        "drift_mm": Figure(name="displacement of the base", unit="mm", digits=1, below=5.0),
    },
    # Metrics of a commanded motion before it is simulated.
    "plan": {
        "residual_mm": Figure(name="position error of the end effector", unit="mm", digits=2, below=1.0),
        "residual_deg": Figure(name="orientation error of the end effector", unit="deg", digits=2, below=0.5),
        "grip_gap_mm": Figure(
            name="distance of the farther pad from the handle", unit="mm", digits=2, below=10.0
        ),
        "handle_penetration_mm": Figure(
            name="planned penetration of the handle", unit="mm", digits=2, below=6.0
        ),
        "penetration_mm": Figure(name="planned penetration of other bodies", unit="mm", digits=2, below=1.0),
        "self_penetration_mm": Figure(name="self-penetration", unit="mm", digits=2, below=1.0),
    },
    "coverage": {
        "views": Figure(name="views (median)"),
        "spread_deg": Figure(name="spread of directions", unit="deg"),
        "share": Figure(name="observed sufficiently", unit="%", factor=100.0),
    },
    "camera": {
        "offset_s": Figure(name="clock offset", unit="s", digits=3),
        "sd_s": Figure(name="standard deviation", unit="s", digits=3),
        "moved_mm": Figure(name="displacement since the scan", unit="mm", digits=1),
        "moved_deg": Figure(name="rotation since the scan", unit="deg", digits=2),
    },
}


def read_figure(group: str, name: str, value: float) -> Reading:
    """Format one metric, selected by group and name.

    Raises:
        KeyError: `FIGURES` does not contain this metric.
    """
    return _read(FIGURES[group][name], value, {})


def read_figures(stage: str, figures: Mapping[str, Any]) -> list[Reading]:
    """Format the metrics of a stage that are listed in `FIGURES`, in the order of that table.

    Args:
        stage: Name of the stage.
        figures: Metrics that the stage returned, by name.
    """
    known = FIGURES.get(stage, {})
    return [
        _read(figure, figures[name], figures)
        for name, figure in known.items()
        if name in figures and not (figure.zero_is_unknown and figures[name] == 0)
    ]


def _read(figure: Figure, value: Any, figures: Mapping[str, Any]) -> Reading:
    if isinstance(value, str):
        return Reading(name=figure.name, number=value)
    number = figure.factor * value + figure.offset
    shown = f"{number:,.{figure.digits}f}"
    limit = ""
    if figure.of:
        total = figures[figure.of]
        shown, number = f"{shown} of {total:,}", 100 * value / max(total, 1)
    verdict: Verdict = ""
    if figure.above is not None:
        limit = f"good above {figure.above:g}{' %' if figure.of else ''}"
        verdict = "good" if number >= figure.above else "poor"
    elif figure.below is not None:
        limit = f"good below {figure.below:g}"
        verdict = "good" if number <= figure.below else "poor"
    return Reading(
        name=figure.name,
        number=shown,
        unit=figure.unit,
        verdict=verdict,
        limit=limit,
        counted=not figure.unit,
    )
