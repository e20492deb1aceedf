"""Draws are pure, even, and held against table, reach and view before anything is planned."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from aomgen.core.boxes import OrientedBox
from aomgen.core.camera import Camera, look_at
from aomgen.core.demonstration import SupportPlane
from aomgen.core.plan import FittedAsset, OrbitChange, Variation
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.episodes.ledger import distributions
from aomgen.episodes.screening import Place, orbit_camera
from aomgen.episodes.variations import OrbitRanges, Ranges, area, draw, inside, scale_fit
from aomgen.errors import ConfigError
from aomgen.robots.robot import Reach, RobotModel, longest_reach
from aomgen.simulation.judge import PassRule
from toy_drawer import SUPPORT

HERE = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0)
# A rail carries an arm with six hinges.
SLIDES = (True, *[False] * 6)
SQUARE = ((0.5, -0.5), (1.2, -0.5), (1.2, 0.3), (0.5, 0.3))


@pytest.fixture(scope="module")
def camera(fitted: FittedAsset) -> Camera:
    held = apply(fitted.T_world_asset, fitted.contact_asset)
    eye = held + [-1.5, -1.0, 0.8]
    return Camera(fx=300, fy=300, cx=160, cy=120, width=320, height=240, T_world_cam=look_at(eye, held))


def place(
    camera: Camera,
    support: SupportPlane = SUPPORT,
    ranges: Ranges | None = None,
    free: int = 0,
    obstacles: tuple[OrientedBox, ...] = (),
) -> Place:
    reach = Reach(shoulder_world=np.array([0.0, 0.0, 0.16]), reach_m=1.1)
    return Place(
        ranges=ranges or Ranges(),
        support=support,
        obstacles=obstacles,
        reach=reach,
        cameras={"front": camera},
        free=free,
    )


def reason(where: Place, variation: Variation, fitted: FittedAsset) -> str:
    rejection = where.screen(variation, fitted)
    return rejection.reason if rejection else ""


def test_a_draw_depends_on_seed_asset_and_index_alone() -> None:
    drawn = [draw(3, 0, index, Ranges()) for index in range(40)]
    assert drawn[7] == draw(3, 0, 7, Ranges())
    assert drawn != [draw(4, 0, index, Ranges()) for index in range(40)]
    assert drawn != [draw(3, 1, index, Ranges()) for index in range(40)]
    # More joints and cameras, or wider ranges of something else, move no object.
    wide = Ranges(scale=(0.6, 1.0), start_deg=(-5, 5), around=OrbitRanges(turn_deg=(-9, 9)))
    for index in (0, 7, 39):
        other = draw(3, 0, index, wide, slides=SLIDES, cameras=2, free=3)
        assert (other.x, other.y, other.yaw) == (drawn[index].x, drawn[index].y, drawn[index].yaw)
        assert (len(other.start_offset), len(other.orbits)) == (7, 5)
        turning = draw(3, 0, index, wide, slides=[False] * 7, cameras=2, free=3)
        assert other == replace(turning, start_offset=(0.0, *turning.start_offset[1:]))


def test_draws_fill_their_ranges_evenly() -> None:
    ranges = Ranges(scale=(0.6, 1.0), light_temperature_k=(3000, 8000))
    drawn = [draw(1, 0, index, ranges) for index in range(64)]
    columns = {
        "x_m": [v.x for v in drawn], "y_m": [v.y for v in drawn], "yaw_deg": [np.rad2deg(v.yaw) for v in drawn],
        "scale": [v.scale for v in drawn], "light_temperature_k": [v.light.temperature_k for v in drawn],
    }  # fmt: skip
    for name, values in columns.items():
        counts = np.histogram(values, bins=4, range=getattr(ranges, name))[0]
        assert counts.sum() == 64
        assert counts.min() >= 13, name
    table = np.abs(np.corrcoef(list(columns.values())) - np.eye(len(columns)))
    assert table.max() < 0.25, "what is drawn together is independent"


def test_places_of_an_area_lie_in_it(fitted: FittedAsset, camera: Camera) -> None:
    triangle = ((0.5, -0.5), (1.2, -0.5), (1.2, 0.3))
    assert area(SQUARE) == pytest.approx(0.56)
    assert area(triangle) == pytest.approx(0.28)
    ranges = Ranges(polygon=triangle)
    drawn = [draw(0, 0, index, ranges) for index in range(60)]
    within = [inside(triangle, np.array([v.x, v.y])) for v in drawn]
    assert 24 <= sum(within) <= 36, "half of its bounding box"
    outside = drawn[within.index(False)]
    assert reason(place(camera, ranges=ranges), outside, fitted) == "outside_area"
    chosen = drawn[within.index(True)]
    low, high = fitted.asset.static.bounds
    middle = apply(chosen.place_at(fitted), np.append((low[:2] + high[:2]) / 2, 0.0))
    np.testing.assert_allclose(middle[:2], [chosen.x, chosen.y], atol=1e-9)


def test_x_and_y_may_be_the_objects_own(fitted: FittedAsset) -> None:
    own = replace(HERE, y=-0.1, frame="object")
    moved = own.place_at(fitted)[:3, 3] - fitted.T_world_asset[:3, 3]
    # The front faces -y of the asset's frame: towards the robot, which is along -x of the world.
    np.testing.assert_allclose(moved, [-0.1, 0, 0], atol=1e-9)


def test_ranges_that_hold_nothing_are_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"episodes.ranges.x_m: is \(0.3, 0.1\); give two numbers, the lower"
    ):
        Ranges(x_m=(0.3, 0.1))
    with pytest.raises(ConfigError, match=r"episodes.ranges.scale: .*expected more than 0"):
        Ranges(scale=(0.0, 1.0))
    with pytest.raises(ConfigError, match=r"episodes.ranges.polygon: has 3 corners and an area of 0"):
        Ranges(polygon=((0, 0), (1, 1), (2, 2)))
    for wrong in ((0.0, 1.0, 2.0), ((0, 0), (1, 1, 1), (0, 1))):
        with pytest.raises(ConfigError, match=r"episodes.ranges.polygon: is .*; give its corners"):
            Ranges(polygon=wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="'table'"):
        Ranges(axes="table")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"ranges\.free\.tilt_deg"):
        Ranges(free=OrbitRanges(tilt_deg=(0.0,)))  # type: ignore[arg-type]


def test_a_scaled_object_is_held_where_it_was_and_stands_on_the_table(fitted: FittedAsset) -> None:
    small = scale_fit(fitted, 0.7)
    held, before = (apply(fit.T_world_asset, fit.contact_asset) for fit in (small, fitted))
    np.testing.assert_allclose(held[:2], before[:2], atol=1e-9)
    assert held[2] - SUPPORT.height == pytest.approx(0.7 * (before[2] - SUPPORT.height))
    np.testing.assert_allclose(small.asset.static.bounds[1], 0.7 * fitted.asset.static.bounds[1])
    assert small.target_theta == pytest.approx(0.7 * fitted.target_theta)
    assert scale_fit(fitted, 1.0) is fitted


def test_a_small_slide_is_opened_as_far_as_counts_where_it_can_be(fitted: FittedAsset) -> None:
    assert fitted.asset.joint.type == "prismatic"
    least = PassRule().least_travel("prismatic")
    share = 0.9 * least / abs(fitted.travel)
    long = replace(
        fitted, asset=replace(fitted.asset, joint=replace(fitted.asset.joint, upper=least / share / 0.9))
    )
    assert abs(scale_fit(long, share).travel) >= least
    assert abs(scale_fit(long, share).travel) < 1.001 * least
    stop = replace(fitted.asset.joint, upper=1.001 * abs(fitted.travel))
    short = replace(fitted, asset=replace(fitted.asset, joint=stop))
    assert abs(scale_fit(short, share).travel) == pytest.approx(0.9 * least)


def test_poses_off_the_table_or_out_of_reach_are_not_tried(fitted: FittedAsset, camera: Camera) -> None:
    wide = replace(camera, fx=20, fy=20)
    T = fitted.T_world_asset[:2, 3]
    small = SupportPlane(height=0.05, low_xy=T - 0.3, high_xy=T + 0.3)
    assert reason(place(wide, small), HERE, fitted) == ""
    assert reason(place(wide, small), replace(HERE, y=0.3), fitted) == "off_table"
    assert reason(place(wide), replace(HERE, y=0.3), fitted) == ""
    assert reason(place(wide), replace(HERE, x=0.5), fitted) == "out_of_reach"
    # The recorded place counts as table even where its edge is estimated too near.
    assert reason(place(wide, replace(small, high_xy=T - 0.1)), HERE, fitted) == ""


def test_an_object_does_not_stand_where_something_else_does(fitted: FittedAsset, camera: Camera) -> None:
    wide, T = replace(camera, fx=20, fy=20), fitted.T_world_asset
    behind = T[:2, 3] + [0.5, 0.0]
    half = np.array([0.05, 0.05, 0.1])
    box = OrientedBox(T_world_box=transform(np.eye(3), np.append(behind, 0.15)), half_extents=half)
    beside = place(wide, obstacles=(box,))
    assert reason(beside, HERE, fitted) == ""
    depth = fitted.asset.static.bounds[1][1]
    # The drawer's back faces +x of the world: it comes up to the box's front.
    near = 0.5 - 0.05 - depth
    assert reason(beside, replace(HERE, x=near - 0.01), fitted) != "blocked"
    assert reason(beside, replace(HERE, x=near + 0.01), fitted) == "blocked"
    # Beside the corner of a turned box their outlines' bounds overlap, they do not.
    R = matrix_from_rotvec(np.array([0.0, 0.0, np.pi / 4]))
    width = fitted.asset.static.bounds[1][0]
    corner = T[:2, 3] + [depth + 0.04, width + 0.04]
    turned = OrientedBox(T_world_box=transform(R, np.append(corner, 0.15)), half_extents=half)
    assert reason(place(wide, obstacles=(turned,)), HERE, fitted) == ""
    assert reason(place(wide, obstacles=(turned,)), replace(HERE, x=0.02, y=0.02), fitted) == "blocked"


def test_a_pose_that_a_camera_does_not_show_is_not_in_view(fitted: FittedAsset, camera: Camera) -> None:
    assert reason(place(camera), HERE, fitted) == ""
    away = replace(HERE, y=0.5)
    assert reason(place(replace(camera, fx=900, fy=900)), away, fitted) == "out_of_view"
    behind = camera.move(
        look_at(camera.center, 2 * camera.center - apply(fitted.T_world_asset, fitted.contact_asset))
    )
    assert reason(place(behind), HERE, fitted) == "out_of_view"
    # The held point leaves the picture while the part opens.
    assert reason(place(replace(camera, fx=9000, fy=9000)), HERE, fitted) == "out_of_view"


def test_a_camera_orbits_about_its_point(camera: Camera) -> None:
    target = np.array([0.7, -0.2, 0.1])
    before, _ = camera.project(target)
    moved = orbit_camera(camera, target, OrbitChange(turn=0.4, tilt=0.2, distance=1.3))
    np.testing.assert_allclose(moved.project(target)[0], before, atol=1e-6)
    arm, new = camera.center - target, moved.center - target
    assert np.linalg.norm(new) == pytest.approx(1.3 * np.linalg.norm(arm))
    assert new[2] / np.linalg.norm(new) > arm[2] / np.linalg.norm(arm), "tilted upwards"
    assert orbit_camera(camera, target, OrbitChange()) is camera


def test_added_cameras_look_at_the_object_where_it_stands(fitted: FittedAsset, camera: Camera) -> None:
    ranges = Ranges(free=OrbitRanges())
    variation = replace(draw(0, 0, 0, ranges, cameras=1, free=1), x=0.05, y=0.2, yaw=0.0)
    views = place(camera, ranges=ranges, free=1).views(variation, fitted)
    held = apply(variation.place_at(fitted), fitted.contact_asset)
    np.testing.assert_allclose(views["free0"].project(held)[0], [160, 120], atol=1e-6)
    assert views["front"] is camera


def test_reach_of_the_arm(robot: RobotModel) -> None:
    reach = longest_reach(robot)
    np.testing.assert_allclose(reach.shoulder_world[:2], 0, atol=0.05)
    assert 0.9 < reach.reach_m < 1.3


def test_starts_are_counted_for_the_first_joint_with_an_offset() -> None:
    ranges = Ranges(start_deg=(-5.0, 5.0))
    drawn = [asdict(draw(0, 0, index, ranges, slides=SLIDES)) for index in range(16)]
    found = distributions([{"variation": item, "outcome": "committed"} for item in drawn], ranges, free=0)
    start = next(item for item in found if item.name.startswith("start"))
    assert (start.name, start.unit) == ("start of joint 2", "deg")
    assert start.drawn.max() < 16 == start.drawn.sum()


def test_moved_and_added_cameras_are_counted_over_their_own_ranges() -> None:
    ranges = Ranges(around=OrbitRanges(turn_deg=(-5, 5)), free=OrbitRanges(turn_deg=(-60, 60)))
    drawn = [asdict(draw(0, 0, index, ranges, cameras=1, free=1)) for index in range(16)]
    found = distributions([{"variation": item, "outcome": "committed"} for item in drawn], ranges, free=1)
    ends = {item.name: (item.edges[0], item.edges[-1]) for item in found}
    assert ends["camera 0 turn"] == (-5, 5)
    assert ends["camera 1 turn"] == (-60, 60)
    assert all(item.delivered.sum() == 16 for item in found)
