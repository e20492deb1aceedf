"""Made assets: laws of their geometry, and what the check must refuse."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from aomgen.assets.asset_check import check_asset, held_at_rim, outward_normal
from aomgen.assets.choice import MAKERS, OTHER_MAKERS, make_asset, open_asset
from aomgen.assets.mjcf import HOLDS, add_asset, holding_friction
from aomgen.assets.usd_write import write_usd
from aomgen.core.asset import ArticulatedAsset, BoxCollider
from aomgen.core.transforms import apply, transform
from aomgen.errors import AssetError, ConfigError
from benchmarks.other_objects import OTHER_OBJECTS

Made = Callable[[str, int], ArticulatedAsset]
# What seed 5 has always been.
MICROWAVE_5 = [0.10559253173070661, -0.23164226529445808, 0.138446210038801]
DRAWER_5 = [0.0, -0.2570228811938371, 0.21471920659513716]
MICROWAVE_5_TEXTURES = 54386905
KNOWN = MAKERS | OTHER_MAKERS | OTHER_OBJECTS
ALL = [(category, seed) for category in sorted(KNOWN) for seed in range(4)]


@pytest.mark.parametrize(("category", "seed"), ALL)
def test_made_asset_has_no_problems(made: Made, category: str, seed: int) -> None:
    asset = made(category, seed)
    assert check_asset(asset) == []
    assert asset.category == {"dresser": "drawer"}.get(category, category)
    assert outward_normal(asset) @ [0, -1, 0] > 0.99


# Joint type, unsigned axis or signed direction; and the handle's first motion. All are seen in six seeds.
LEFT, RIGHT, OUT, UP = [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 0, 1]
OPENS = {
    "cabinet": [("prismatic", RIGHT, RIGHT), ("prismatic", LEFT, LEFT)],
    "cupboard": [("prismatic", OUT, OUT), ("revolute", UP, OUT)],
    "drawer": [("prismatic", OUT, OUT)],
    "dresser": [("prismatic", OUT, OUT)],
    "laptop": [("revolute", LEFT, UP)],
    "microwave": [("revolute", UP, OUT)],
    "oven": [("revolute", RIGHT, OUT)],
    "toolbox": [("revolute", LEFT, UP)],
}


@pytest.mark.parametrize("category", sorted(KNOWN))
def test_joint_type_and_first_motion_are_the_category(made: Made, category: str) -> None:
    seen = set()
    for seed in range(6):
        asset = made(category, seed)
        joint, handle = asset.joint, asset.handle_point
        way = apply(joint.motion(0.02), handle) - handle
        way /= np.linalg.norm(way)
        for number, (kind, axis, direction) in enumerate(OPENS[category]):
            along = joint.axis @ axis if axis != UP else abs(joint.axis @ axis)
            if joint.type == kind and along > 0.999 and way @ direction > np.cos(np.deg2rad(30)):
                seen.add(number)
                break
        else:
            pytest.fail(f"seed {seed}: {joint.type} about {joint.axis}, handle moves along {way}")
    assert seen == set(range(len(OPENS[category])))


def test_what_does_not_move_of_a_cupboard_belongs_to_its_body(made: Made) -> None:
    for seed in range(6):
        asset = made("cupboard", seed)
        still = "drawer" if asset.joint.type == "revolute" else "door"
        assert {f"{still}_handle_bar"} <= {box.name for box in asset.static.colliders}
        assert asset.moving.name == ("door" if still == "drawer" else "drawer")


@pytest.mark.parametrize("category", ["laptop", "toolbox"])
def test_lid_hinges_at_the_back_and_clears_what_is_below(made: Made, category: str) -> None:
    asset = made(category, 3)
    _, high = asset.static.bounds
    assert np.abs(asset.joint.axis) == pytest.approx([1, 0, 0])
    assert asset.joint.origin[1] == pytest.approx(high[1], abs=0.005)
    assert asset.joint.upper >= np.deg2rad(100)
    opened = np.concatenate(
        [apply(asset.joint.motion(asset.joint.upper), box.corners) for box in asset.moving.colliders]
    )
    assert opened[:, 2].min() > 0.005


def test_laptop_lies_flat_and_its_lid_stands_out_over_a_notch(made: Made) -> None:
    for seed in range(6):
        asset = made("laptop", seed)
        assert held_at_rim(asset)
        assert asset.static.bounds[0][2] == pytest.approx(0.0)
        base = next(box for box in asset.static.colliders if box.name == "base")
        assert 0.012 <= 2 * base.half_extents[2] <= 0.020
        assert 0.005 <= 2 * asset.handle_bar.half_extents[2] <= 0.009  # type: ignore[union-attr]
        # A finger 22 mm wide fits between the base's front corners.
        left, right = (
            next(box for box in asset.static.colliders if box.name == f"front_{side}")
            for side in ("left", "right")
        )
        assert right.corners[:, 0].min() - left.corners[:, 0].max() > 0.06
        assert base.corners[:, 1].min() - asset.moving.bounds[0][1] > 0.010


def test_fronts_and_bars_of_a_dresser_are_alike(made: Made) -> None:
    for seed in range(6):
        asset = made("dresser", seed)
        bar = asset.handle_bar
        assert bar is not None
        assert 0.006 <= 2 * bar.half_extents.min() <= 0.010
        front = next(box for box in asset.moving.colliders if box.name == "front")
        others = [box for box in asset.static.colliders if box.name.startswith("front_")]
        bars = [box.half_extents for box in others if box.name.endswith("handle_bar")]
        fronts = [box.half_extents for box in others if "handle" not in box.name]
        assert 1 <= len(bars) == len(fronts) <= 3
        assert np.array(bars) == pytest.approx(np.tile(bar.half_extents, (len(bars), 1)))
        assert np.array(fronts) == pytest.approx(np.tile(front.half_extents, (len(fronts), 1)))
        textures = {
            mesh.texture_srgb.tobytes()
            for link in (asset.static, asset.moving)
            for mesh in link.meshes
            if mesh.name.startswith("front")
        }
        assert len(textures) == 1


def test_microwave_and_drawer_of_a_seed_stay_what_they_are(made: Made) -> None:
    """Runs name assets by category and seed, so that these values may not change."""
    microwave, drawer = made("microwave", 5), made("drawer", 5)
    assert microwave.handle_point == pytest.approx(MICROWAVE_5, abs=1e-12)
    assert drawer.handle_point == pytest.approx(DRAWER_5, abs=1e-12)
    total = sum(int(mesh.texture_srgb.sum(dtype=np.int64)) for mesh in microwave.moving.meshes)
    assert total == MICROWAVE_5_TEXTURES


def test_same_seed_same_asset(made: Made) -> None:
    a, b, c = made("microwave", 5), make_asset("microwave", 5), made("microwave", 6)
    assert np.array_equal(a.static.meshes[0].vertices, b.static.meshes[0].vertices)
    assert np.array_equal(a.moving.meshes[0].texture_srgb, b.moving.meshes[0].texture_srgb)
    assert not np.allclose(a.handle_point, c.handle_point)


def test_microwaves_come_with_both_hinge_sides(made: Made) -> None:
    assert {np.sign(made("microwave", seed).joint.axis[2]) for seed in range(8)} == {-1.0, 1.0}


def test_unknown_category_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="cabinet, drawer, laptop, microwave, toolbox, dresser"):
        make_asset("toaster", 0)


@pytest.mark.parametrize("category", sorted(KNOWN))
def test_meshes_face_outwards_and_textures_do_not_repeat(made: Made, category: str) -> None:
    asset = made(category, 1)
    for link in (asset.static, asset.moving):
        for mesh in link.meshes:
            if len(mesh.uvs):
                assert mesh.uvs.min() >= -1e-9
                assert mesh.uvs.max() <= 1 + 1e-9
    name = "lid" if category == "laptop" else "handle"
    handle = next(mesh for mesh in asset.moving.meshes if mesh.name == name)
    a, b, c = (handle.vertices[handle.faces[:, i]] for i in range(3))
    volume = np.einsum("ni,ni->", a, np.cross(b, c)) / 6
    assert volume > 1e-6


@pytest.mark.parametrize(("category", "seed"), ALL[::3])
def test_mujoco_sees_no_contact_along_the_joint(made: Made, category: str, seed: int) -> None:
    asset = made(category, seed)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    names = add_asset(spec, asset, np.eye(4), damping=0.1, frictionloss=0.1)
    # Without the exclude, MuJoCo reports every touch of door and body.
    for exclude in list(spec.excludes):
        spec.delete(exclude)
    model = spec.compile()
    data = mujoco.MjData(model)
    for theta in np.linspace(0, asset.joint.upper, 40):
        data.joint(names.joint).qpos[0] = theta
        mujoco.mj_forward(model, data)
        assert data.ncon == 0, theta


def test_mujoco_masses_limits_and_motion_are_the_assets(made: Made) -> None:
    asset = made("drawer", 2)
    T = transform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), [0.3, -0.2, 0.1])
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    names = add_asset(spec, asset, T, damping=4.0, frictionloss=2.0, visual=True)
    model = spec.compile()
    data = mujoco.MjData(model)
    assert model.body(names.moving_body).mass[0] == pytest.approx(asset.moving.mass)
    assert model.joint(names.joint).range.tolist() == pytest.approx([0.0, asset.joint.upper])
    visuals = [g for g in range(model.ngeom) if "_visual_" in model.geom(g).name]
    assert len(visuals) == len(asset.static.meshes) + len(asset.moving.meshes)
    assert all("handle" in name for name in names.handle_geoms)
    assert len(names.handle_geoms) == 3
    data.joint(names.joint).qpos[0] = 0.17
    mujoco.mj_kinematics(model, data)
    expected = (T @ asset.joint.motion(0.17))[:3, 3]
    assert data.body(names.moving_body).xpos == pytest.approx(expected, abs=1e-9)


def test_friction_bears_the_weight_of_a_lid_and_nothing_where_none_pulls(made: Made) -> None:
    asset = made("toolbox", 0)
    middle = asset.joint.origin + [0.0, -0.1, 0.0]
    plate = BoxCollider(name="plate", T_asset_box=transform(np.eye(3), middle), half_extents=np.full(3, 0.02))
    lid = replace(asset, moving=replace(asset.moving, colliders=(plate,), mass=2.0))
    assert holding_friction(lid) == pytest.approx(HOLDS * 2.0 * 9.81 * 0.1)
    for category in ("cabinet", "drawer", "microwave"):
        assert holding_friction(made(category, 0)) == 0.0


@pytest.mark.parametrize(("category", "theta"), [("toolbox", 0.3), ("laptop", 0.9), ("oven", 0.7)])
def test_lid_stays_where_it_is_left_and_yields_to_a_push(made: Made, category: str, theta: float) -> None:
    asset = made(category, 1)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    names = add_asset(spec, asset, np.eye(4), damping=0.05, frictionloss=0.02)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.joint(names.joint).qpos[0] = theta
    mujoco.mj_step(model, data, 1000)
    assert data.joint(names.joint).qpos[0] == pytest.approx(theta, abs=np.deg2rad(0.2))
    data.joint(names.joint).qfrc_applied[0] = 2.5 * holding_friction(asset)
    mujoco.mj_step(model, data, 300)
    assert data.joint(names.joint).qpos[0] > theta + 0.1


def test_degrees_are_refused(made: Made) -> None:
    with pytest.raises(ValueError, match="degree"):
        add_asset(mujoco.MjSpec(), made("drawer", 0), np.eye(4), damping=1, frictionloss=0)


def _with_collider(asset, box):
    return replace(asset, moving=replace(asset.moving, colliders=(*asset.moving.colliders, box)))


def test_check_names_the_colliders_that_overlap(made: Made, tmp_path: Path) -> None:
    asset = made("microwave", 0)
    peg = BoxCollider(
        name="peg", T_asset_box=transform(np.eye(3), [0, 0, 0.01]), half_extents=[0.02, 0.02, 0.02]
    )
    problems = check_asset(_with_collider(asset, peg))
    assert any("'peg'" in problem and "overlap" in problem for problem in problems)
    write_usd(_with_collider(asset, peg), tmp_path / "pegged.usda")
    with pytest.raises(AssetError, match="peg"):
        open_asset(str(tmp_path / "pegged.usda"))


def test_check_wants_room_for_a_finger_behind_the_handle(made: Made) -> None:
    asset = made("drawer", 0)
    behind = asset.handle_point + [0, 0.016, 0]
    filler = BoxCollider(
        name="filler", T_asset_box=transform(np.eye(3), behind), half_extents=[0.03, 0.005, 0.01]
    )
    problems = check_asset(_with_collider(asset, filler))
    assert len(problems) == 1
    assert "12 mm ball" in problems[0]


def test_check_wants_room_for_a_finger_on_both_sides_of_a_rim(made: Made) -> None:
    asset = made("laptop", 0)
    below = asset.handle_point - [0, 0, 0.012]
    filler = BoxCollider(
        name="filler", T_asset_box=transform(np.eye(3), below), half_extents=[0.03, 0.005, 0.002]
    )
    problems = check_asset(_with_collider(asset, filler))
    assert len(problems) == 1
    assert "both sides" in problems[0]


def test_check_refuses_wrong_units(made: Made) -> None:
    asset = made("microwave", 0)
    assert "metersPerUnit" in check_asset(asset.transformed(np.diag([100.0, 100, 100, 1])))[0]
    degrees = replace(asset, joint=replace(asset.joint, upper=100.0))
    assert any("degrees" in problem for problem in check_asset(degrees))
    stuck = replace(asset, joint=replace(asset.joint, upper=0.1))
    assert any("opens by" in problem for problem in check_asset(stuck))


def test_scaled_asset_stays_usable(made: Made) -> None:
    asset = made("microwave", 3).transformed(np.diag([0.9, 0.9, 0.9, 1.0]))
    assert check_asset(asset) == []
