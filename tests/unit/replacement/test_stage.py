"""Which of a project's assets take the recorded object's place."""

from types import SimpleNamespace
from typing import Any

import pytest

from aomgen.errors import EstimationError
from aomgen.replacement.stage import fit_assets
from recordings import gripped_recording


def fits(*specs: str) -> Any:
    """What comes of a project's assets when a microwave was recorded."""
    demo, recorded = gripped_recording("microwave")
    project = SimpleNamespace(assets=specs, adapt="object")
    results: Any = SimpleNamespace(
        project=project,
        demonstration=demo,
        motion=SimpleNamespace(direction="opening"),
        recorded=SimpleNamespace(category="microwave"),
        params=lambda stage, default: default,
    )
    return fit_assets(results, recorded)


def test_an_asset_that_moves_otherwise_is_left_out_with_its_reason() -> None:
    fitted, rejected = fits("microwave:1", "drawer:1", "microwave:2")
    assert [item.asset.name for item in fitted] == ["microwave-1", "microwave-2"]
    assert {spec: found.reason for spec, found in rejected.items()} == {"drawer:1": "joint_type"}


def test_a_project_of_which_no_asset_fits_is_refused() -> None:
    with pytest.raises(EstimationError, match=r"drawer:1: asset is prismatic.*drawer:2: asset is prismatic"):
        fits("drawer:1", "drawer:2")


def test_a_project_without_assets_has_none() -> None:
    assert fits() == ([], {})


def test_the_recorded_object_itself_stands_beside_other_assets() -> None:
    fitted, _ = fits("original", "microwave:2")
    assert [item.asset.name for item in fitted] == ["original", "microwave-2"]
