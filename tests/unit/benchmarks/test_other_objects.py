"""Ovens and cupboards, which are no category of the product: laws of their geometry, their file and their fit."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from aomgen.assets.usd_parse import parse_usd
from aomgen.assets.usd_write import write_usd
from asset_laws import (
    OUT,
    RIGHT,
    UP,
    faces_outwards,
    has_no_problems,
    is_found_again,
    moves_without_contact,
    opens_as,
    stays_where_left,
)
from benchmarks.other_objects import OTHER_OBJECTS, make_object

made = cache(make_object)
# As in `opens_as`.
OPENS = {
    "cupboard": [("prismatic", OUT, OUT), ("revolute", UP, OUT)],
    "oven": [("revolute", RIGHT, OUT)],
}


@pytest.mark.parametrize("category", sorted(OTHER_OBJECTS))
def test_objects_are_made_well(category: str) -> None:
    objects = [made(category, seed) for seed in range(6)]
    assert {item.category for item in objects} == {category}
    for item in objects[:4]:
        has_no_problems(item)
    opens_as(objects, OPENS[category])
    faces_outwards(objects[1], "handle")
    moves_without_contact(objects[0])
    moves_without_contact(objects[3])


def test_what_does_not_move_of_a_cupboard_belongs_to_its_body() -> None:
    for seed in range(6):
        asset = made("cupboard", seed)
        still = "drawer" if asset.joint.type == "revolute" else "door"
        assert {f"{still}_handle_bar"} <= {box.name for box in asset.static.colliders}
        assert asset.moving.name == ("door" if still == "drawer" else "drawer")


def test_an_ovens_door_stays_where_it_is_left() -> None:
    stays_where_left(made("oven", 1), 0.7)


@pytest.mark.parametrize(("category", "seed"), [("oven", 1), ("cupboard", 0), ("cupboard", 1)])
def test_objects_are_fitted_to_their_own_recording(category: str, seed: int) -> None:
    is_found_again(made(category, seed))


@pytest.mark.parametrize("category", sorted(OTHER_OBJECTS))
def test_a_usd_file_keeps_the_object(tmp_path: Path, category: str) -> None:
    asset = made(category, 1)
    write_usd(asset, tmp_path / "asset.usda")
    read = parse_usd(tmp_path / "asset.usda")
    assert (read.category, read.joint.type) == (asset.category, asset.joint.type)
    np.testing.assert_allclose(read.joint.axis, asset.joint.axis, atol=1e-6)
    np.testing.assert_allclose(read.handle_point, asset.handle_point, atol=1e-6)
    has_no_problems(read)
