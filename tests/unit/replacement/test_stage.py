"""Which of a project's assets take the recorded object's place, and what lights them."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aomgen.core.environment_map import map_directions
from aomgen.core.light import hemisphere_light
from aomgen.errors import EstimationError
from aomgen.lighting.light_estimation import SceneLight, ToneCurve
from aomgen.replacement.stage import fit_assets, light_of_assets
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


SCAN_LIGHT = SceneLight(hemisphere_light(np.ones(3), np.full(3, 0.4)), ToneCurve(0.8, 0.1), "robot")


def chosen(light: str, yaw_deg: float = 0.0) -> SceneLight:
    """The light of a project's assets."""
    results: Any = SimpleNamespace(project=SimpleNamespace(light=light, light_yaw_deg=yaw_deg))
    view: Any = None
    return light_of_assets(results, SCAN_LIGHT, view)


def test_assets_are_in_the_light_of_the_scene_unless_a_file_is_named(tmp_path: Path) -> None:
    assert chosen("scan") is SCAN_LIGHT
    # A window on the side of +x, which a quarter turn brings to +y.
    window = np.maximum(map_directions(32, 64)[..., :1], 0) + np.full(3, 0.1)
    path = tmp_path / "window.pfm"
    path.write_bytes(b"PF\n64 32\n-1.0\n" + window[::-1].astype("<f4").tobytes())
    towards_x, towards_y = (
        chosen(str(path), yaw_deg).arriving.irradiance(np.eye(3)).mean(1) for yaw_deg in (0.0, 90.0)
    )
    assert chosen(str(path)).source == "file"
    assert towards_x[0] > 2 * towards_x[1]
    np.testing.assert_allclose(towards_y[[1, 2]], towards_x[[0, 2]], rtol=1e-3)


def test_the_recorded_object_itself_stands_beside_other_assets() -> None:
    fitted, _ = fits("original", "microwave:2")
    assert [item.asset.name for item in fitted] == ["original", "microwave-2"]
