"""The recorded object itself as an asset: its truth is the asset that was recorded."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.assets.asset_check import check_asset
from aomgen.assets.choice import make_asset, open_assets
from aomgen.conventions import MOVING, STATIC
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity, transform
from aomgen.errors import AssetError, EstimationError
from aomgen.replacement.correspondence import describe_contact
from aomgen.replacement.original import fit_original, original_twin
from aomgen.twin.twin import pose_twin
from backwards import closing_of, scanned_open
from recordings import PLACE, SCALE, YAW, gripped_recording


def original(category: str) -> FittedAsset:
    demo, recorded = gripped_recording(category)
    return fit_original(demo, describe_contact(demo, recorded, "opening"), recorded, category)


@pytest.mark.parametrize("category", ["microwave", "drawer"])
def test_the_recorded_object_is_found_again_as_boxes(category: str) -> None:
    found = original(category)
    truth = make_asset(category, 1).transform(similarity(SCALE, np.eye(3), np.zeros(3)))
    assert check_asset(found.asset) == []
    T_world_truth = transform(matrix_from_rotvec(np.array([0.0, 0.0, YAW])), PLACE)
    handle = apply(found.T_world_asset, found.asset.handle_point)
    assert np.linalg.norm(handle - apply(T_world_truth, truth.handle_point)) < 0.01
    assert abs(found.asset.handle_axis @ truth.handle_axis) > 0.99
    size, true_size = (np.ptp(asset.static.bounds, axis=0) for asset in (found.asset, truth))
    np.testing.assert_allclose(size, true_size, atol=0.02)
    assert found.residual_mm < 10.0


def test_an_object_without_a_handle_that_was_scanned_is_refused() -> None:
    demo, recorded = gripped_recording("microwave")
    place = apply(demo.Ts_world_ee[demo.contact_frames[0]], demo.grasp_ee)
    far = np.linalg.norm((recorded.moving_points_world - place)[:, :2], axis=1) > 0.06
    bare = replace(recorded, moving_points_world=recorded.moving_points_world[far])
    with pytest.raises(EstimationError, match="protrude from the part"):
        fit_original(demo, describe_contact(demo, bare, "opening"), bare, "microwave")


def test_a_part_that_is_not_larger_than_its_handle_is_refused() -> None:
    demo, recorded = gripped_recording("microwave")
    place = apply(demo.Ts_world_ee[demo.contact_frames[0]], demo.grasp_ee)
    near = np.linalg.norm((recorded.moving_points_world - place)[:, :2], axis=1) < 0.02
    small = replace(recorded, moving_points_world=recorded.moving_points_world[near])
    with pytest.raises(EstimationError, match="not larger than its handle"):
        fit_original(demo, describe_contact(demo, small, "opening"), small, "microwave")


def test_an_object_that_was_scanned_open_is_refused() -> None:
    demo, recorded = gripped_recording("microwave")
    opened, closing = scanned_open(demo, recorded), closing_of(demo)
    with pytest.raises(EstimationError, match="scanned open"):
        fit_original(closing, describe_contact(closing, opened, "closing"), opened, "microwave")


def test_the_recorded_object_is_named_once() -> None:
    with pytest.raises(AssetError, match="original"):
        open_assets(["original", "original"])


def test_its_gaussians_stand_where_they_were_scanned_and_move_with_it(toy_scene) -> None:
    recorded, found = toy_scene.twin, original("microwave")
    background = recorded.select(~np.isin(recorded.labels, (STATIC, MOVING)))
    twin = original_twin(background, recorded, found)
    own, scanned = (np.isin(t.labels, (STATIC, MOVING)) for t in (twin, recorded))
    before = pose_twin(recorded, toy_scene.robot, recorded.scan_state).select(scanned)
    again = pose_twin(twin, toy_scene.robot, twin.scan_state).select(own)
    np.testing.assert_allclose(again.means, before.means, atol=1e-5)
    shift = transform(matrix_from_rotvec(np.array([0.0, 0.0, 0.4])), np.array([0.1, 0.0, 0.0]))
    state = replace(twin.scan_state, T_world_object=shift @ twin.T_world_object)
    moved = pose_twin(twin, toy_scene.robot, state).select(own)
    np.testing.assert_allclose(moved.means, apply(shift, before.means), atol=1e-5)
