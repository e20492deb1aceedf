"""The asset takes the recorded object's place: known answers, and cases that must be refused."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.joint import Joint
from aomgen.core.plan import FittedAsset, Rejection
from aomgen.core.transforms import apply, transform
from aomgen.errors import EstimationError
from aomgen.replacement.correspondence import (
    bar_reach,
    describe_contact,
    find_front,
    held_point_of,
    measure_rim_distance,
    mirror_asset,
    smooth_rise,
)
from aomgen.replacement.fitting import FitParams, face_thetas, fit_asset
from asset_laws import is_found_again
from backwards import closing_of, scanned_open
from recordings import PLACE, SCALE, YAW, recording


def fitted(asset: ArticulatedAsset, mode: str, **changes: float) -> FittedAsset | Rejection:
    demo, recorded = recording(make_asset("microwave", 1), **changes)
    return fit_asset(asset, describe_contact(demo, recorded, "opening"), demo.joint.type, mode, FitParams())


@pytest.mark.parametrize("category", ["microwave", "drawer"])
def test_front_of_a_turned_asset_is_found(category: str) -> None:
    demo, recorded = recording(make_asset(category, 1))
    yaw = describe_contact(demo, recorded, "opening").yaw
    assert np.rad2deg(abs(yaw - YAW)) < 2.0


# Slides to the right, to the left; two lids.
ODD = [("cabinet", 2), ("cabinet", 0), ("laptop", 1), ("toolbox", 1)]


@pytest.mark.parametrize(("category", "seed"), ODD)
def test_every_kind_of_object_is_found_again(category: str, seed: int) -> None:
    is_found_again(make_asset(category, seed))


@pytest.mark.parametrize("mode", ["object", "trajectory"])
@pytest.mark.parametrize(
    ("category", "seed"), [("microwave", 1), ("drawer", 1), ("toolbox", 1), ("cabinet", 1)]
)
def test_an_object_that_is_closed_is_fitted_as_one_that_is_opened(
    category: str, seed: int, mode: str
) -> None:
    asset = make_asset(category, seed)
    demo, recorded = recording(asset, noise_m=0.001)
    closing = describe_contact(closing_of(demo), scanned_open(demo, recorded), "closing")
    opened, closed = (
        fit_asset(asset, contact, demo.joint.type, mode, FitParams())
        for contact in (describe_contact(demo, recorded, "opening"), closing)
    )
    assert isinstance(opened, FittedAsset)
    assert isinstance(closed, FittedAsset)
    assert closed.start_theta == pytest.approx(opened.target_theta, abs=1e-6)
    assert (closed.target_theta, closed.travel) == (0.0, -closed.start_theta)
    np.testing.assert_allclose(closed.T_world_asset, opened.T_world_asset, atol=1e-6)
    np.testing.assert_allclose(closed.contact_asset, opened.contact_asset, atol=1e-6)
    shares = np.linspace(0, 1, 50)
    np.testing.assert_allclose(closed.theta_at(shares), opened.theta_at(1 - shares), atol=1e-6)


def test_a_panel_that_slides_the_other_way_is_mirrored() -> None:
    right = make_asset("cabinet", 2)
    demo, recorded = recording(right)
    contact = describe_contact(demo, recorded, "opening")
    assert not contact.opens_left
    result = fit_asset(mirror_asset(right), contact, "prismatic", "object", FitParams())
    assert isinstance(result, FittedAsset)
    assert result.mirrored
    assert result.residual_mm < 3.0
    strict = FitParams(allow_mirror=False)
    refused = fit_asset(mirror_asset(right), contact, "prismatic", "object", strict)
    assert isinstance(refused, Rejection)
    assert refused.reason == "hinge_side"


@pytest.mark.parametrize(("category", "seed"), [("drawer", 1), ("toolbox", 1), ("laptop", 1)])
def test_what_a_mirror_leaves_as_it_is_is_never_mirrored(category: str, seed: int) -> None:
    asset = make_asset(category, seed)
    demo, recorded = recording(asset)
    result = fit_asset(
        mirror_asset(asset),
        describe_contact(demo, recorded, "opening"),
        demo.joint.type,
        "object",
        FitParams(),
    )
    assert isinstance(result, FittedAsset)
    assert not result.mirrored


def test_object_mode_recovers_a_known_scale_place_and_motion() -> None:
    asset = make_asset("microwave", 1)
    result = fitted(asset, "object", noise_m=0.001)
    assert isinstance(result, FittedAsset)
    assert abs(result.scale - SCALE) < 0.03
    assert np.linalg.norm(result.T_world_asset[:3, 3] - PLACE) < 0.015
    assert abs(result.target_theta - 1.0) < 0.03
    assert result.residual_mm < 6.0
    assert not result.mirrored


def test_object_mode_recovers_a_drawer() -> None:
    asset = make_asset("drawer", 1)
    demo, recorded = recording(asset)
    result = fit_asset(asset, describe_contact(demo, recorded, "opening"), "prismatic", "object", FitParams())
    assert isinstance(result, FittedAsset)
    assert abs(result.scale - SCALE) < 0.03
    assert abs(result.target_theta - 0.16) < 0.003


def test_trajectory_mode_keeps_size_and_meets_the_recorded_handle_from_above() -> None:
    result = fitted(make_asset("microwave", 2), "trajectory")
    assert isinstance(result, FittedAsset)
    demo, _ = recording(make_asset("microwave", 1))
    held = apply(result.T_world_asset, result.contact_asset)
    assert result.scale == 1.0
    np.testing.assert_allclose(held[:2], demo.Ts_world_ee[demo.contact_frames[0], :2, 3], atol=1e-9)
    assert result.T_world_asset[2, 3] == PLACE[2]
    assert np.all(np.diff(result.thetas) >= 0)
    assert result.thetas[0] == 0


def test_asset_with_another_kind_of_joint_is_refused() -> None:
    result = fitted(make_asset("drawer", 0), "trajectory")
    assert isinstance(result, Rejection)
    assert result.reason == "joint_type"


def test_hinge_on_the_other_side_is_mirrored_or_refused() -> None:
    other = mirror_asset(make_asset("microwave", 1))
    result = fitted(other, "object")
    assert isinstance(result, FittedAsset)
    assert result.mirrored
    demo, recorded = recording(make_asset("microwave", 1))
    strict = FitParams(allow_mirror=False)
    refused = fit_asset(other, describe_contact(demo, recorded, "opening"), "revolute", "object", strict)
    assert isinstance(refused, Rejection)
    assert refused.reason == "hinge_side"


def test_asset_that_cannot_open_far_enough_is_refused() -> None:
    asset = make_asset("microwave", 1)
    stiff = replace(asset, joint=replace(asset.joint, upper=0.6))
    result = fitted(stiff, "object")
    assert isinstance(result, Rejection)
    assert result.reason == "size"


def test_auto_scales_where_that_fits_and_else_keeps_the_size() -> None:
    asset = make_asset("microwave", 1)
    demo, recorded = recording(asset)
    contact = describe_contact(demo, recorded, "opening")
    for given, mode in (
        (asset, "object"),
        (replace(asset, joint=replace(asset.joint, upper=0.6)), "trajectory"),
    ):
        found = fit_asset(given, contact, demo.joint.type, "auto", FitParams())
        assert isinstance(found, FittedAsset)
        assert found.mode == mode
        expected = fit_asset(given, contact, demo.joint.type, mode, FitParams())
        assert isinstance(expected, FittedAsset)
        np.testing.assert_array_equal(found.T_world_asset, expected.T_world_asset)
    refused = fit_asset(make_asset("drawer", 1), contact, demo.joint.type, "auto", FitParams())
    assert isinstance(refused, Rejection)
    assert refused.reason == "joint_type"


def test_mirroring_twice_is_nothing_and_once_keeps_the_opening_direction() -> None:
    asset = make_asset("microwave", 3)
    once = mirror_asset(asset)
    M = np.diag([-1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(once.joint.motion(0.7), M @ asset.joint.motion(0.7) @ M, atol=1e-12)
    for before, after in zip(asset.moving.meshes, mirror_asset(once).moving.meshes, strict=True):
        np.testing.assert_array_equal(before.vertices, after.vertices)
        np.testing.assert_array_equal(before.faces, after.faces)
    for box in once.moving.colliders:
        assert np.linalg.det(box.T_asset_box[:3, :3]) == pytest.approx(1.0)


def test_held_point_stays_on_the_bar_and_off_its_posts() -> None:
    asset = make_asset("microwave", 0)
    for height in (-1.0, 0.5, 2.0):
        held = held_point_of(asset, np.array([0.5, 0.5, height]))
        offset = held - asset.handle_point
        np.testing.assert_allclose(np.cross(offset, asset.handle_axis), 0, atol=1e-12)
        bar = asset.handle_bar
        assert bar is not None
        assert abs(offset @ asset.handle_axis) <= bar.half_extents.max() - 0.029


def test_face_thetas_ignore_sliding_along_the_face() -> None:
    joint = Joint(type="revolute", axis=[0, 0, 1], origin=[0.2, 0.1, 0], lower=0, upper=2)
    held = np.array([0.5, 0.1, 0.3])
    thetas = np.linspace(0, 1.5, 20)
    slid = held + np.linspace(0, 0.05, 20)[:, None] * np.array([1.0, 0, 0])
    path = apply(joint.motion(thetas), slid)
    np.testing.assert_allclose(face_thetas(joint, held, path), thetas, atol=1e-9)


def test_smooth_rise_never_falls_and_keeps_the_travel() -> None:
    noisy = np.linspace(0, 1, 30) ** 2 + np.random.default_rng(0).normal(0, 0.01, 30)
    rise = smooth_rise(noisy)
    assert np.all(np.diff(rise) >= 0)
    assert rise[0] == 0
    assert abs(rise[-1] - 1.0) < 0.04


def test_a_part_that_moves_straight_up_has_no_front() -> None:
    joint = Joint(type="prismatic", axis=[0, 0, 1], origin=[0, 0, 0], lower=0, upper=1)
    with pytest.raises(EstimationError, match="no front"):
        find_front(joint, np.zeros(3), np.zeros((0, 3)))


def test_a_lid_held_at_its_rim_is_scaled_by_width_and_depth_and_not_by_its_blurred_thickness() -> None:
    asset = make_asset("laptop", 1)
    demo, recorded = recording(asset, noise_m=0.001)
    blur = np.random.default_rng(1).normal(0, 0.006, recorded.moving_points_world.shape) * [0, 0, 1]
    blurred = replace(recorded, moving_points_world=recorded.moving_points_world + blur)
    result = fit_asset(
        asset, describe_contact(demo, blurred, "opening"), demo.joint.type, "object", FitParams()
    )
    assert isinstance(result, FittedAsset)
    assert abs(result.scale - SCALE) < 0.03
    assert result.residual_mm < 6.0


def test_the_held_point_of_a_thin_part_is_put_on_its_rim_and_that_of_a_bar_is_left() -> None:
    low, high = np.array([-0.15, 0.0, 0.02]), np.array([0.15, 0.22, 0.03])
    # The fingers close upwards; the palm looks into the part.
    R = np.stack([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], 1)
    before = np.array([0.0, -0.012, 0.025])
    assert measure_rim_distance(before, R, low, high) == pytest.approx(0.012)
    assert measure_rim_distance(before + [0, 0.02, 0], R, low, high) == 0.0
    assert measure_rim_distance(before - [0, 0.02, 0], R, low, high) == 0.0
    assert measure_rim_distance(before, R, low, high + [0, 0, 0.1]) == 0.0


def test_a_bent_handle_is_followed_along_its_colliders() -> None:
    asset = make_asset("microwave", 0)
    bar = asset.handle_bar
    assert bar is not None
    third, step = bar.half_extents * [1, 1, 1 / 3], 2 * bar.half_extents[2] / 3
    T = bar.T_asset_box
    pieces = tuple(
        replace(
            bar,
            name=f"handle_{k}",
            half_extents=third,
            T_asset_box=transform(T[:3, :3], T[:3, 3] + [0, -0.01 * abs(k), k * step]),
        )
        for k in (-1, 0, 1)
    )
    moving = replace(
        asset.moving,
        colliders=(*pieces, *(b for b in asset.moving.colliders if not b.name.startswith("handle"))),
    )
    bent = replace(asset, moving=moving)
    assert bar_reach(bent) == pytest.approx(bar_reach(asset))
    for share, depth in ((0.5, 0.0), (2.0, -0.01)):
        straight, held = (held_point_of(a, np.array([0.5, 0.5, share])) for a in (asset, bent))
        np.testing.assert_allclose(held - straight, [0.0, depth, 0.0], atol=2e-3)
