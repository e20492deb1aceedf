"""How a hand holds bars, and rims that are part of the panel."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from aomgen.assets.asset_check import held_at_rim, outward_normal
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply, invert, matrix_from_rotvec
from aomgen.episodes.grasps import RIM_OVERLAPS_M, between, difference, grasp_depths, grasps
from aomgen.robots.robot import RobotModel
from toy_drawer import fitted_drawer

CORNERS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T


@pytest.fixture(scope="module", params=(8001, 8004, 8007))
def laptop(made: Callable[[str, int], ArticulatedAsset], request: pytest.FixtureRequest) -> FittedAsset:
    asset = made("laptop", request.param)
    assert held_at_rim(asset)
    thetas = np.asarray(np.linspace(0.0, 1.0, 20), np.float64)
    return replace(fitted_drawer(), asset=asset, contact_asset=asset.handle_point, thetas=thetas)


def from_above(asset: ArticulatedAsset, degrees: float) -> np.ndarray:
    """A hand before the front that looks down by an angle."""
    approach, along = -outward_normal(asset), asset.handle_axis
    R = np.stack([along, np.cross(approach, along), approach], 1)
    sideways = np.cross(approach, [0.0, 0.0, 1.0])
    return matrix_from_rotvec(-np.deg2rad(degrees) * sideways) @ R


def test_a_rim_is_held_by_the_tips_whatever_was_held(laptop: FittedAsset, robot: RobotModel) -> None:
    asset = laptop.asset
    first, *others = [grasp_depths(asset, shown, robot) for shown in (-0.02, 0.002, 0.03)]
    assert set(others) == {first}
    joints = np.zeros((1, 6))
    Ts = invert(robot.ee_poses(joints)) @ robot.link_poses(joints, 1.0)[0]
    tips = [
        apply(Ts[pad.body] @ pad.T_body_pad, CORNERS * pad.half_extents)[:, 2].max() for pad in robot.pads
    ]
    assert min(tips) - np.array(first) == pytest.approx(RIM_OVERLAPS_M, abs=1e-4)
    # Where the tips end is rim still, seen along the lid.
    bar = asset.handle_bar
    assert bar is not None
    inward = -outward_normal(asset)
    end = float((bar.T_asset_box[:3, 3] - asset.handle_point) @ inward) + float(bar.half_extents[1])
    assert min(tips) - min(first) < end


def test_fingers_close_across_the_plate_of_a_rim(laptop: FittedAsset) -> None:
    asset = laptop.asset
    plate = np.cross(asset.handle_axis, outward_normal(asset))
    found = list(grasps(laptop, from_above(asset, 35.0), [0.014], 0.85))
    assert "tilt +0" in found[0].name
    assert len({grasp.name for grasp in found}) == len(found) > 5
    deeper = list(grasps(laptop, from_above(asset, 35.0), [0.012, 0.014], 0.85))
    assert [grasp.name for grasp in deeper] == 2 * [grasp.name for grasp in found]
    angles = np.rad2deg([np.arccos(abs(plate @ grasp.R_object_ee[:, 1])) for grasp in found])
    assert angles.max() < 46.0


def test_a_bar_is_held_where_the_recorded_one_was_by_the_outer_half_of_the_pads(robot: RobotModel) -> None:
    fitted = fitted_drawer()
    assert not held_at_rim(fitted.asset)
    depths = [grasp_depths(fitted.asset, shown, robot)[0] for shown in (-0.01, 0.003, 0.008, 0.5)]
    assert 0.004 < depths[0] == depths[1] < depths[2] == 0.008 < depths[3] < 0.02


def test_a_hand_may_lean_along_the_bar_and_closes_across_it(robot: RobotModel) -> None:
    fitted = fitted_drawer()
    axis = fitted.asset.handle_axis
    R = from_above(fitted.asset, 10.0)
    found = list(grasps(fitted, R, [0.0], 1.0))
    leaning = [grasp for grasp in found if "swing" in grasp.name]
    assert leaning
    for grasp in found:
        assert abs(grasp.R_object_ee[:, 1] @ axis) < 1e-9
        np.testing.assert_allclose(grasp.R_object_ee @ grasp.R_object_ee.T, np.eye(3), atol=1e-9)
    assert (
        found.index(leaning[0])
        > sum("tilt" in grasp.name and "swing" not in grasp.name for grasp in found) - 1
    )
    leans = {round(float(np.rad2deg(np.arcsin(abs(g.R_object_ee[:, 2] @ axis))))) for g in leaning}
    assert leans == {20, 40}


def test_grasps_between_two_lead_evenly_from_one_to_the_other() -> None:
    fitted = fitted_drawer()
    first, last = list(grasps(fitted, from_above(fitted.asset, 10.0), [0.004], 1.0))[::9][:2]
    whole = difference(first, last)
    assert whole > 0.1
    for share in (0.0, 0.25, 0.5, 1.0):
        middle = between(first, last, share)
        assert difference(first, middle) == pytest.approx(share * whole, abs=1e-6)
        assert difference(middle, last) == pytest.approx((1 - share) * whole, abs=1e-6)
