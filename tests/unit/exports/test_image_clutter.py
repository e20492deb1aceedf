"""Clutter is beside the labeled object, stands on the table, and is never of its category."""

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.core.light import hemisphere_light
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.exports import image_clutter
from aomgen.exports.image_clutter import Clutter, ClutterPlacer, cover_object, find_footprint, make_clutter

# The table is tilted by 2 degrees.
T_WORLD_PLANE = transform(matrix_from_rotvec([np.deg2rad(2.0), 0.0, 0.0]), [0.4, 0.0, 0.1])
FREE = np.array([0.0, -0.5]), np.array([1.0, 0.5])


@pytest.fixture(scope="module")
def items() -> list[Clutter]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("KINDS", 2), ("OBJECTS", 1), ("OBJECT_DISCS", 300), ("DISCS", 60)):
            patch.setattr(image_clutter, name, value)
        return make_clutter(np.random.default_rng(0))


@pytest.fixture(scope="module")
def placer() -> ClutterPlacer:
    return ClutterPlacer(hemisphere_light([0.8] * 3, [0.2] * 3), T_WORLD_PLANE, FREE)


def test_an_object_stands_beside_the_labeled_one(items: list[Clutter], placer: ClutterPlacer) -> None:
    rng, taken = np.random.default_rng(1), (np.array([0.7, 0.0]), 0.25)
    fronts = []
    for item in (item for item in items if item.category):
        for _ in range(20):
            T = placer.find_place(item, np.eye(3), taken, rng)
            if T is not None:
                assert np.linalg.norm(T[:2, 3] - taken[0]) > taken[1] + item.radius_m
                # Its bottom is on the surface of the table.
                assert apply(np.linalg.inv(T_WORLD_PLANE), T[:3, 3])[2] == pytest.approx(0.0, abs=1e-9)
                fronts.append(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
    assert len(fronts) > 50
    assert max(np.abs(fronts)) <= image_clutter.FACING_DEG


def test_an_object_without_room_is_left_out(items: list[Clutter], placer: ClutterPlacer) -> None:
    item = next(item for item in items if item.category)
    rng = np.random.default_rng(0)
    assert placer.find_place(item, np.eye(3), (np.array([0.5, 0.0]), 2.0), rng) is None


def test_an_object_of_the_same_category_would_have_no_label(
    items: list[Clutter], placer: ClutterPlacer, monkeypatch: pytest.MonkeyPatch
) -> None:
    lit = list[str]()
    light_item = placer.light_item

    def remember(item: Clutter, T: np.ndarray) -> object:
        lit.append(item.category)
        return light_item(item, T)

    monkeypatch.setattr(placer, "light_item", remember)
    rng = np.random.default_rng(2)
    for _ in range(60):
        placer.place(items, "microwave", np.eye(3), (np.array([0.7, 0.0]), 0.2), rng)
    assert set(lit) == {"", "cabinet", "drawer", "laptop", "toolbox"}


def test_the_footprint_encloses_the_body() -> None:
    asset = make_asset("microwave", 3)
    T = transform(matrix_from_rotvec([0.0, 0.0, 0.7]), [0.8, 0.1, 0.1])
    fitted = FittedAsset(
        asset=asset, T_world_asset=T, contact_asset=asset.handle_point, shares=np.array([0.0, 1.0]),
        thetas=np.array([0.0, 1.0]), scale=1.0, mirrored=False, mode="trajectory", residual_mm=0.0,
    )  # fmt: skip
    center, radius = find_footprint(fitted, T)
    vertices = np.concatenate([apply(T, box.corners) for box in asset.static.colliders])
    assert np.linalg.norm(vertices[:, :2] - center, axis=1).max() < radius
    item = cover_object(asset, np.random.default_rng(0))
    assert np.linalg.norm(item.surfels.gaussians.means[:, :2], axis=1).max() <= item.radius_m + 0.01
