"""Every figure of a stage has a name, a unit and digits, or a reason why it is not shown."""

import ast
from pathlib import Path

import pytest

import aomgen
from aomgen.pipeline.figures import FIGURES, Reading, read_figures
from aomgen.pipeline.runner import WARNINGS
from aomgen.pipeline.stages import STAGES

SOURCE = Path(aomgen.__file__).parent
# Packages that are not named as their stage.
PACKAGES = {"twin": "appearance", "dataset": "datasets"}
# Figures that stay in the manifests alone, and why.
NOT_SHOWN = {
    "structure": {"of": "shown with the registered images"},
    "gaussians": {"heldout_ssim": "says what the PSNR says"},
    "alignment": {
        "support": "means something only beside what chance confirms; the standard deviation follows from it",
        "runner_up_support": "0 where no other place of the robot was found, which is no measurement",
        "fixed_cameras": "a table of its own in the report",
    },
    "parts": {"method": "a choice of the program", "coverage": "a table of its own in the report"},
    "twin": {"tray": "0 for most objects"},
    "replacement": {
        "light": "a choice of the program",
        "fit_residual_mm": "an asset that keeps its own size is not meant to follow the recorded path",
    },
}


def returned_figures() -> dict[str, set[str]]:
    """Names of the figures that each stage returns, from its source; "moved_*" for f-strings."""
    found: dict[str, set[str]] = {}
    for stage in STAGES:
        path = SOURCE / PACKAGES.get(stage.name, stage.name) / "stage.py"
        # Its first function that ends in a table of figures; later ones return other things.
        keys = next(
            node.body[-1].value.keys
            for node in ast.parse(path.read_text("utf-8")).body
            if isinstance(node, ast.FunctionDef)
            and isinstance(node.body[-1], ast.Return)
            and isinstance(node.body[-1].value, ast.Dict)
        )
        found[stage.name] = {_key(key) for key in keys} - {"", WARNINGS}
    return found


def _key(node: ast.expr | None) -> str:
    if isinstance(node, ast.JoinedStr):
        head = node.values[0]
        return f"{head.value}*" if isinstance(head, ast.Constant) else ""
    return str(node.value) if isinstance(node, ast.Constant) else ""


def test_every_figure_is_in_the_table_or_left_out_for_a_reason() -> None:
    returned = returned_figures()
    assert set(returned) == {stage.name for stage in STAGES}
    for stage, names in returned.items():
        known = set(FIGURES[stage]) | set(NOT_SHOWN.get(stage, {}))
        if "moved_*" in names:
            names = names - {"moved_*"} | {"moved_deg", "moved_mm"}
        assert names == known, stage


def sentences(stage: str, figures: dict) -> list[str]:
    return [item.sentence for item in read_figures(stage, figures)]


def test_figures_are_read_as_sentences_with_what_is_good() -> None:
    figures = {"of": 64, "points": 5925, "registered": 64, "reprojection_error_px": 0.557}
    assert sentences("structure", figures) == [
        "64 of 64 images registered (good above 95 %)",
        "reprojection error 0.56 px (good below 1)",
        "5,925 points",
    ]


def test_what_is_poor_says_so_in_words() -> None:
    figures = {"of": 64, "registered": 55, "reprojection_error_px": 1.234}
    registered, error = read_figures("structure", figures)
    assert registered.sentence == "55 of 64 images registered (poor, good above 95 %)"
    assert error.sentence == "reprojection error 1.23 px (poor, good below 1)"
    assert (registered.verdict, error.verdict) == ("poor", "poor")


def test_the_margin_is_told_as_the_opening_it_means() -> None:
    (item,) = read_figures("episodes", {"smallest_margin": 0.09178})
    assert item == Reading(
        name="least travel", number="99.2", unit="% of the plan", verdict="good", limit="good above 90"
    )


def test_figures_without_a_meaning_are_not_shown() -> None:
    assert read_figures("replacement", {"fit_residual_mm": 48.3}) == []
    # A sliding joint has an axis and no origin; the paper's method knows neither.
    assert read_figures("motion", {"axis_ci95_deg": 0.0, "origin_ci95_mm": 0.0}) == []


@pytest.mark.parametrize("value", [float("nan"), 3.1])
def test_a_value_that_is_no_number_is_poor(value: float) -> None:
    (item,) = read_figures("alignment", {"end_effector_sd_mm": value})
    assert item.verdict == "poor"
