"""Joints are hidden behind a hand's path and asked back."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.transforms import angle_between, invert, matrix_from_rotvec, transform
from aomgen.errors import AmbiguousJointError, DemonstrationTooShortError
from aomgen.motion.ee_path import GraspGuess, thin_path
from aomgen.motion.joint_estimation import JointEstimate, choose_type, estimate_joint, fit_candidates

HANDLE = np.array([0.55, -0.12, 0.22])
DOOR = Joint(type="revolute", axis=[0, 0, -1], origin=[0.62, 0.19, 0.0], lower=0, upper=2)
DRAWER = Joint(type="prismatic", axis=[-0.8, 0.6, 0], origin=HANDLE, lower=0, upper=0.3)
GRASP_EE = np.array([0.0, 0.002, 0.005])
HOLD = GraspGuess(point_ee=GRASP_EE)


@dataclass(frozen=True)
class Flaws:
    """What is wrong with a demonstration."""

    turn_ratio: float = 1.0
    position_m: float = 0.0005
    wobble_rad: float = 0.005
    slide_m: float = 0.0


def hand_path(
    joint: Joint, travel: float, flaws: Flaws, rng: np.random.Generator, count: int = 250
) -> np.ndarray:
    """Hand poses (T, 4, 4) that hold HANDLE while the part moves with a soft start and stop."""
    values = travel * 0.5 * (1 - np.cos(np.linspace(0, np.pi, count)))
    part = joint.motion(values)
    handle = np.einsum("tij,j->ti", part[:, :3, :3], HANDLE) + part[:, :3, 3]
    if flaws.slide_m:
        radial = HANDLE - joint.origin
        radial = radial - (radial @ joint.axis) * joint.axis
        radial /= np.linalg.norm(radial)
        slide = flaws.slide_m * np.linspace(0, 1, count)[:, None]
        handle = handle + slide * np.einsum("tij,j->ti", part[:, :3, :3], radial)
    R_start = matrix_from_rotvec([0.2, 1.5, 0.1])
    turn = (
        joint.axis * (values * flaws.turn_ratio)[:, None]
        if joint.type == "revolute"
        else np.zeros((count, 3))
    )
    drift = rng.normal(size=3) * flaws.wobble_rad * np.linspace(0, 1, count)[:, None]
    R = matrix_from_rotvec(turn + drift) @ R_start
    points = handle + rng.normal(size=(count, 3)) * flaws.position_m
    return transform(R, points - R @ GRASP_EE)


def axis_error_deg(estimate: JointEstimate, truth: Joint) -> float:
    return float(np.degrees(angle_between(estimate.joint.axis, truth.axis)))


def origin_error_m(estimate: JointEstimate, truth: Joint) -> float:
    near = truth.origin + truth.axis * ((HANDLE - truth.origin) @ truth.axis)
    return float(np.linalg.norm(np.cross(near - estimate.joint.origin, estimate.joint.axis)))


@pytest.mark.parametrize("ratio", [1.0, 0.9, 0.5, 0.0])
def test_a_handle_may_turn_in_the_fingers(ratio: float) -> None:
    path = hand_path(DOOR, np.radians(65), Flaws(turn_ratio=ratio), np.random.default_rng(3))
    estimate = estimate_joint(path, GraspGuess(point_ee=np.zeros(3)))
    assert estimate.joint.type == "revolute"
    assert axis_error_deg(estimate, DOOR) < 1.0
    assert origin_error_m(estimate, DOOR) < 0.008
    assert estimate.turn_ratio == pytest.approx(ratio, abs=0.06)


def test_a_short_arc_is_known_less_well_and_says_so() -> None:
    rng = np.random.default_rng(4)
    short = estimate_joint(hand_path(DOOR, np.radians(25), Flaws(), rng), HOLD)
    long = estimate_joint(hand_path(DOOR, np.radians(80), Flaws(), rng), HOLD)
    assert axis_error_deg(short, DOOR) < 4
    assert origin_error_m(short, DOOR) < 0.04
    assert short.origin_sd_m > 3 * long.origin_sd_m
    assert short.axis_sd_rad > long.axis_sd_rad


def test_errors_stay_within_three_standard_deviations() -> None:
    rng = np.random.default_rng(5)
    for _ in range(6):
        flaws = Flaws(turn_ratio=float(rng.uniform(0.6, 1)), position_m=0.001, wobble_rad=0.02)
        estimate = estimate_joint(
            hand_path(DOOR, np.radians(50), flaws, rng), GraspGuess(point_ee=np.zeros(3))
        )
        assert np.radians(axis_error_deg(estimate, DOOR)) < 3 * estimate.axis_sd_rad
        assert origin_error_m(estimate, DOOR) < 3 * estimate.origin_sd_m


def test_sliding_on_the_handle_costs_centimetres_at_most() -> None:
    path = hand_path(DOOR, np.radians(65), Flaws(slide_m=0.01), np.random.default_rng(6))
    estimate = estimate_joint(path, HOLD)
    assert estimate.joint.type == "revolute"
    assert axis_error_deg(estimate, DOOR) < 2
    assert origin_error_m(estimate, DOOR) < 0.025


def test_a_drawer_is_prismatic() -> None:
    estimate = estimate_joint(hand_path(DRAWER, 0.18, Flaws(), np.random.default_rng(7)), HOLD)
    assert estimate.joint.type == "prismatic"
    assert axis_error_deg(estimate, DRAWER) < 0.5
    assert estimate.joint.upper == pytest.approx(0.18, abs=0.012)


def test_a_retreat_at_the_end_of_the_path_is_forgotten() -> None:
    path = hand_path(DOOR, np.radians(65), Flaws(), np.random.default_rng(8))
    away = np.repeat(path[-1:], 25, 0)
    away[:, :3, 3] += np.linspace(0, 0.05, 25)[:, None] * np.array([-1.0, 0, 0.4])
    estimate = estimate_joint(np.concatenate([path, away]), HOLD)
    assert axis_error_deg(estimate, DOOR) < 1.5
    assert origin_error_m(estimate, DOOR) < 0.012


@pytest.mark.parametrize(("joint", "travel"), [(DOOR, np.radians(9)), (DRAWER, 0.02)])
def test_too_short_a_demonstration_is_refused(joint: Joint, travel: float) -> None:
    path = hand_path(joint, travel, Flaws(), np.random.default_rng(9))
    with pytest.raises(DemonstrationTooShortError, match="need"):
        estimate_joint(path, HOLD)


def wide_pull(radius: float, angle_deg: float, noise_m: float, seed: int) -> np.ndarray:
    """A handle that turns freely in the fingers, on a door of this radius."""
    wide = Joint(type="revolute", axis=[0, 0, -1], origin=HANDLE + [0, radius, 0], lower=0, upper=1)
    flaws = Flaws(turn_ratio=0, position_m=noise_m)
    return hand_path(wide, np.radians(angle_deg), flaws, np.random.default_rng(seed))


def test_a_noisy_pull_is_ambiguous() -> None:
    with pytest.raises(AmbiguousJointError):
        estimate_joint(wide_pull(0.6, 17, 0.008, 2), HOLD)


@pytest.mark.parametrize(("radius", "angle_deg", "noise_m"), [(0.3, 16, 0.004), (0.6, 4, 0.002)])
def test_a_straight_looking_short_pull_is_too_short(radius: float, angle_deg: float, noise_m: float) -> None:
    with pytest.raises(DemonstrationTooShortError, match="would bend it"):
        estimate_joint(wide_pull(radius, angle_deg, noise_m, 1), HOLD)


@pytest.mark.parametrize("ratio", [1.0, 0.7])
def test_five_degrees_of_a_wide_door_are_no_drawer(ratio: float) -> None:
    wide = Joint(type="revolute", axis=[0, 0, -1], origin=HANDLE + [0, 0.5, 0], lower=0, upper=1)
    path = hand_path(wide, np.radians(5), Flaws(turn_ratio=ratio), np.random.default_rng(2))
    with pytest.raises(DemonstrationTooShortError, match="turned"):
        estimate_joint(path, HOLD)


def test_the_film_decides_where_the_hand_cannot() -> None:
    found = fit_candidates(wide_pull(0.6, 17, 0.008, 2), HOLD)
    assert choose_type(found, 20.0) == "revolute"
    assert choose_type(found, -20.0) == "prismatic"


def test_the_film_outweighs_a_hand_that_slips() -> None:
    found = fit_candidates(hand_path(DRAWER, 0.18, Flaws(), np.random.default_rng(7)), HOLD)
    assert found.margin < 0
    wide = replace(found, revolute=replace(found.revolute, joint=replace(DOOR, upper=1.0)))
    assert choose_type(wide, 5 - found.margin) == "revolute"


def test_a_filmed_door_of_a_few_degrees_is_too_short() -> None:
    found = fit_candidates(wide_pull(0.6, 4, 0.002, 1), HOLD)
    with pytest.raises(DemonstrationTooShortError, match="turned"):
        choose_type(found, 50.0)


def test_values_just_below_a_limit_are_not_printed_as_equal_to_it() -> None:
    def candidates(turn_deg: float, margin: float) -> SimpleNamespace:
        joint = replace(DOOR, upper=float(np.radians(turn_deg)))
        return SimpleNamespace(margin=margin, revolute=SimpleNamespace(joint=joint))

    with pytest.raises(DemonstrationTooShortError, match=r"turned 14\.96 degrees, need 15"):
        choose_type(candidates(14.96, 50.0))
    with pytest.raises(AmbiguousJointError, match=r"differs by 2\.98, need 3\.0") as refused:
        choose_type(candidates(60.0, 2.98))
    # A project cannot state the type of the joint.
    assert refused.value.remedy == "record a longer demonstration"
    path = hand_path(DRAWER, 0.0304, Flaws(position_m=0, wobble_rad=0), np.random.default_rng(9))
    with pytest.raises(DemonstrationTooShortError, match=r"29\.\d mm, need 30 mm"):
        estimate_joint(path, HOLD)


@pytest.mark.parametrize(("joint", "travel"), [(DOOR, np.radians(60)), (DRAWER, 0.15)])
def test_moving_the_world_moves_the_joint_along(joint: Joint, travel: float) -> None:
    path = hand_path(joint, travel, Flaws(turn_ratio=0.8), np.random.default_rng(10))
    T = transform(matrix_from_rotvec([0.4, -1.1, 0.7]), [0.3, -2, 0.5])
    here = estimate_joint(path, HOLD).joint
    there = estimate_joint(T @ path, HOLD).joint.move(invert(T))
    assert np.degrees(angle_between(here.axis, there.axis)) < 0.05
    assert there.upper == pytest.approx(here.upper, rel=1e-3)
    if joint.type == "revolute":
        assert np.linalg.norm(np.cross(here.origin - there.origin, here.axis)) < 5e-4


@pytest.mark.parametrize(("joint", "travel"), [(DOOR, np.radians(60)), (DRAWER, 0.15)])
def test_running_the_film_backwards_turns_the_axis(joint: Joint, travel: float) -> None:
    path = hand_path(joint, travel, Flaws(), np.random.default_rng(11))
    forwards, backwards = (estimate_joint(series, HOLD).joint for series in (path, path[::-1]))
    assert np.degrees(angle_between(forwards.axis, -backwards.axis)) < 0.3


def test_a_quick_hand_is_seen_from_its_first_to_its_last_place() -> None:
    """12 cm in 0.2 s, looked at every 10 ms."""
    path = hand_path(DRAWER, 0.12, Flaws(), np.random.default_rng(0), count=21)
    points = thin_path(path, HOLD, nodes=24).points_world
    assert np.linalg.norm(points[-1] - points[0]) > 0.96 * 0.12


def sliding_pull(slide: np.ndarray) -> np.ndarray:
    """The drawer, pulled by a hand that slides by this at the end (3,), [m]."""
    path = hand_path(DRAWER, 0.12, Flaws(), np.random.default_rng(12)).copy()
    share = np.linspace(0, 1, len(path))[:, None]
    path[:, :3, 3] += slide * (share + 0.6 * share * (1 - share))
    return path


def closing_along(path: np.ndarray, way: np.ndarray) -> GraspGuess:
    """A hold whose fingers close in a direction of the world (3,)."""
    return GraspGuess(point_ee=GRASP_EE, closing_ee=path[0, :3, :3].T @ way)


UP, SIDE = np.array([0.0, 0, 1]), np.array([0.6, 0.8, 0])


def test_a_straight_pull_tells_least_along_the_fingers_pads() -> None:
    path = sliding_pull(0.008 * SIDE)
    estimate = estimate_joint(path, closing_along(path, UP))
    up, side = np.abs((estimate.axes - estimate.joint.axis) @ np.stack([UP, SIDE], 1)).mean(0)
    assert side > 5 * up


def test_a_hand_that_slides_along_its_pads_says_how_little_it_knows() -> None:
    path = sliding_pull(0.008 * SIDE)
    aware = estimate_joint(path, closing_along(path, UP))
    assert axis_error_deg(aware, DRAWER) <= np.degrees(aware.axis_ci95_rad)
    assert aware.give_rate > 2 * estimate_joint(sliding_pull(0 * UP), HOLD).give_rate


def test_fingers_that_close_along_the_way_hold_in_no_direction_across_it() -> None:
    path = sliding_pull(0 * UP)
    nothing = estimate_joint(path, HOLD)
    along = estimate_joint(path, closing_along(path, DRAWER.axis))
    assert along.axis_ci95_rad == pytest.approx(nothing.axis_ci95_rad, rel=0.02)
