"""Pads closed on colliders, measured on meshes."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import similarity
from aomgen.replacement.correspondence import describe_contact
from aomgen.replacement.fitting import FitParams, fit_asset
from aomgen.robots.robot import RobotModel
from benchmarks import grip_on_meshes as grip_measurement
from benchmarks.grip_on_meshes import MAX_GAP_MM, grip_on_meshes
from recordings import recording

# The bar's mesh against its colliders, and whether the pads that close on these still hold what is seen.
THICKNESSES = [(1.0, True), (0.3, False), (2.2, False)]


@pytest.fixture(scope="module")
def gripped() -> tuple[FittedAsset, Demonstration]:
    """A fitted microwave and the demonstration that grips its bar."""
    asset = make_asset("microwave", 1)
    demo, recorded = recording(asset)
    demo = replace(demo, gripper=np.clip(demo.times_s - 1.0, 0.0, 0.8))
    fitted = fit_asset(asset, describe_contact(demo, recorded, "opening"), "revolute", "object", FitParams())
    assert isinstance(fitted, FittedAsset)
    return fitted, demo


@pytest.mark.parametrize(("factor", "holds"), THICKNESSES)
def test_pads_closed_on_colliders_are_measured_on_the_meshes(
    gripped: tuple[FittedAsset, Demonstration],
    robot: RobotModel,
    monkeypatch: pytest.MonkeyPatch,
    factor: float,
    holds: bool,
) -> None:
    monkeypatch.setattr(grip_measurement, "POSES", 2)
    fitted, demo = gripped
    place = fitted.asset.handle_point
    S = similarity(factor, np.eye(3), (1 - factor) * place)
    moving = fitted.asset.moving
    meshes = tuple(m.transform(S) if m.name == "handle" else m for m in moving.meshes)
    seen = replace(fitted, asset=replace(fitted.asset, moving=replace(moving, meshes=meshes)))
    grip = grip_on_meshes(seen, demo, robot)
    assert grip.holds == holds
    if factor < 1:
        assert grip.gap_mm > MAX_GAP_MM
