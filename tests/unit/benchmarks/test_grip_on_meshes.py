"""Pads closed on colliders, measured on meshes."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import similarity
from aomgen.replacement.correspondence import describe_contact
from aomgen.replacement.fitting import FitParams, fit_asset
from aomgen.robots.loading import load_robot
from benchmarks.grip_on_meshes import MAX_GAP_MM, grip_on_meshes
from recordings import recording
from synthetic.world import DEFAULT_ROBOT

# The bar's mesh against its colliders, and whether the pads that close on these still hold what is seen.
THICKNESSES = [(1.0, True), (0.3, False), (2.2, False)]


@pytest.mark.parametrize(("factor", "holds"), THICKNESSES)
def test_pads_that_close_on_colliders_are_told_off_the_meshes(factor: float, holds: bool) -> None:
    asset = make_asset("microwave", 1)
    demo, recorded = recording(asset)
    demo = replace(demo, gripper=np.clip(demo.times_s - 1.0, 0.0, 0.8))
    fitted = fit_asset(asset, describe_contact(demo, recorded, "opening"), "revolute", "object", FitParams())
    assert isinstance(fitted, FittedAsset)
    place = fitted.asset.handle_point
    S = similarity(factor, np.eye(3), (1 - factor) * place)
    moving = fitted.asset.moving
    meshes = tuple(m.transform(S) if m.name == "handle" else m for m in moving.meshes)
    seen = replace(fitted, asset=replace(fitted.asset, moving=replace(moving, meshes=meshes)))
    grip = grip_on_meshes(seen, demo, load_robot(DEFAULT_ROBOT))
    assert grip.holds == holds
    if factor < 1:
        assert grip.gap_mm > MAX_GAP_MM
