"""What the parts' shape says of the joint and of the direction of its motion."""

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.transforms import angle_between, apply, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.motion.ee_path import EePath, GraspGuess
from aomgen.motion.joint_estimation import estimate_joint
from aomgen.motion.joint_models import Revolute
from aomgen.motion.part_shape import AxisPrior, infer_direction, measure_shape
from boxy_microwave import BODY, DOOR, R, box_points

HANDLE = R @ [0.18, -0.2, 0.13]
FRONT = R @ [0, -1.0, 0]


HINGE = R @ [-0.22, -0.145, 0.13]


def test_the_face_looks_forwards() -> None:
    assert np.degrees(angle_between(measure_shape(BODY, DOOR).face_normal, FRONT)) < 2


def test_one_of_the_sides_is_the_hinge() -> None:
    shape = measure_shape(BODY, DOOR)
    misfits = [np.abs(hint.residuals(R[:, 2], HINGE)).max() for hint in shape.revolute_priors()]
    assert min(misfits) < 2
    assert sum(hint.probability for hint in shape.revolute_priors()) == pytest.approx(0.9)


def test_a_drawer_may_run_forwards() -> None:
    misfits = [
        np.abs(hint.residuals(FRONT, HANDLE)).max() for hint in measure_shape(BODY, DOOR).prismatic_priors()
    ]
    assert min(misfits) < 3


@pytest.mark.parametrize("lean", [[0.5, 0.0, 0.0], [0.0, 0.0, 0.6], [0.3, -0.4, 0.2]])
def test_a_part_that_stands_open_has_its_own_box(lean: list) -> None:
    turn = matrix_from_rotvec(lean)
    open_door = (DOOR - HINGE) @ turn.T + HINGE
    box = measure_shape(BODY, open_door).box
    thin = box.T_world_box[:3, int(np.argmin(box.half_extents))]
    assert abs(thin @ turn @ FRONT) > np.cos(np.radians(2))


def test_a_hint_is_a_density_over_directions() -> None:
    """Summed over the sphere, both signs, exp(-r.r/2 + log density) is the hint's probability."""
    hint = AxisPrior(
        axis=np.array([0.0, 0.6, 0.8]),
        axis_sd_rad=0.05,
        at=np.zeros(3),
        across=np.zeros((0, 3)),
        across_sds_m=np.zeros(0),
        probability=0.3,
    )
    axes = np.random.default_rng(0).normal(size=(400_000, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    density = np.exp(-0.5 * (hint.residuals(axes, axes * 0) ** 2).sum(1) + hint.log_density)
    assert 4 * np.pi * density.mean() == pytest.approx(0.3, rel=0.05)


def test_the_shape_helps_a_short_arc() -> None:
    hinge = HINGE
    angles = np.radians(20) * 0.5 * (1 - np.cos(np.linspace(0, np.pi, 200)))
    rng = np.random.default_rng(2)
    offset = HANDLE - hinge
    c, s = np.cos(angles), np.sin(angles)
    turned = np.stack(
        [c * offset[0] + s * offset[1], -s * offset[0] + c * offset[1], np.full(200, offset[2])], 1
    )
    poses = np.repeat(np.eye(4)[None], 200, 0)
    poses[:, :3, :3] = matrix_from_rotvec(np.outer(-0.8 * angles, R[:, 2]))
    poses[:, :3, 3] = hinge + turned + rng.normal(size=(200, 3)) * 0.001
    prior = measure_shape(BODY, DOOR)

    def error(shape) -> float:
        joint = estimate_joint(poses, GraspGuess(point_ee=np.zeros(3)), shape).joint
        return float(np.linalg.norm(np.cross(hinge - joint.origin, joint.axis)))

    assert error(prior) < 0.02
    assert error(prior) <= error(None) + 0.002


def test_no_hinge_is_farther_away_than_the_object_reaches() -> None:
    """A straight way of 12 cm might be an arc about a hinge 1.2 m away, but there is nothing there."""
    shape = measure_shape(BODY, DOOR)
    farthest = np.linalg.norm(np.concatenate([BODY, DOOR]) - HANDLE, axis=1).max()
    assert shape.reach_m(HANDLE) == pytest.approx(farthest, rel=0.1)
    Ts, still = np.repeat(np.eye(4)[None], 4, 0), np.zeros((4, 3))
    hold = GraspGuess(point_ee=np.zeros(3))
    path = EePath(Ts_world_ee=Ts, hold=hold, points_world=still, turns_world=still)
    door = Revolute(path=path, start=R[:, 2], reach_m=shape.reach_m(HANDLE))
    x = door.first()
    x[4] = 0.9 * door.reach_m
    assert door.prior_residuals(x)[-1] == 0
    x[4] = 2.0 * door.reach_m
    assert door.prior_residuals(x)[-1] > 5


@pytest.mark.parametrize("ajar", [0.0, 0.5, 1.2, 2.6])
def test_another_door_of_the_object_that_stands_ajar_does_not_mislead(ajar: float) -> None:
    """A second cupboard to the right, hinged at its far side: its door belongs to the static part."""
    hinge = R @ [0.65, -0.145, 0.13]
    door = box_points((0.23, -0.17, 0.01), (0.65, -0.145, 0.25), 6)
    swung = (door - hinge) @ matrix_from_rotvec([0.0, 0.0, ajar]).T + hinge
    static = np.concatenate([BODY, box_points((0.22, -0.14, 0), (0.66, 0.2, 0.26), 5), swung])
    shape = measure_shape(static, DOOR)
    assert np.degrees(angle_between(shape.face_normal, FRONT)) < 2
    assert min(np.abs(hint.residuals(R[:, 2], HINGE)).max() for hint in shape.revolute_priors()) < 2


def sheet(
    x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], step: float = 0.01
) -> Array:
    """Points on a grid over a box; one extent is usually nothing."""
    sides = [np.arange(low, high + step / 2, step) for low, high in (x, y, z)]
    return np.stack([grid.ravel() for grid in np.meshgrid(*sides)], 1)


# A hollow body, 40 x 30 x 30 cm, open towards -y, whose back and floor no scan sees.
SHELL = np.concatenate(
    [sheet((0, 0.4), (0, 0.3), (0.3, 0.3)), sheet((0, 0), (0, 0.3), (0, 0.3)), sheet((0.4, 0.4), (0, 0.3), (0, 0.3))]
)  # fmt: skip
LEAF = sheet((0, 0.4), (-0.01, -0.01), (0, 0.3))
BASE = sheet((0, 0.4), (0, 0.3), (0, 0.02))
LID = sheet((0, 0.4), (0, 0.3), (0.03, 0.03))
DRAWER_FRONT = sheet((0, 0.4), (-0.01, -0.01), (0, 0.3))
TRAY = np.concatenate(
    [DRAWER_FRONT, sheet((0.01, 0.39), (0, 0.28), (0.01, 0.01)), sheet((0.01, 0.01), (0, 0.28), (0.01, 0.2))]
)
# A cabinet whose right half is behind a fixed panel and whose left half is behind a sliding one.
CABINET = np.concatenate([SHELL, sheet((0.2, 0.4), (0, 0), (0, 0.3))])
PANEL = sheet((0, 0.21), (-0.01, -0.01), (0, 0.3))


def joint(kind: str, axis: list[float], origin: list[float]) -> Joint:
    return Joint(type=kind, axis=np.array(axis), origin=np.array(origin), lower=0.0, upper=1.0)  # type: ignore[arg-type]


CASES = {
    "side door": (joint("revolute", [0, 0, -1.0], [0, 0, 0]), SHELL, LEAF, np.radians(70)),
    "a little of a door": (joint("revolute", [0, 0, -1.0], [0, 0, 0]), SHELL, LEAF, np.radians(15)),
    "oven": (joint("revolute", [1.0, 0, 0], [0, 0, 0]), SHELL, LEAF, np.radians(80)),
    "laptop": (joint("revolute", [-1.0, 0, 0], [0, 0.3, 0.02]), BASE, LID, np.radians(100)),
    "drawer": (joint("prismatic", [0, -1.0, 0], [0, 0, 0]), SHELL, TRAY, 0.15),
    "drawer, front alone": (joint("prismatic", [0, -1.0, 0], [0, 0, 0]), SHELL, DRAWER_FRONT, 0.05),
    "sliding panel": (joint("prismatic", [1.0, 0, 0], [0, 0, 0]), CABINET, PANEL, 0.15),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("turned", [False, True])
def test_there_is_opening_and_back_is_closing(name: str, turned: bool) -> None:
    item, static, moving, theta = CASES[name]
    T = transform(matrix_from_rotvec([0.1, -0.2, 2.0]), np.array([0.4, -0.7, 0.1])) if turned else np.eye(4)
    item, static, moving = item.move(T), apply(T, static), apply(T, moving)
    assert infer_direction(item, theta, static, moving) == "opening"
    gone = apply(item.motion(theta), moving)
    back = Joint(type=item.type, axis=-item.axis, origin=item.origin, lower=0.0, upper=1.0)
    assert infer_direction(back, theta, static, gone) == "closing"


@pytest.mark.parametrize("name", CASES)
def test_noise_and_missing_surface_change_nothing(name: str) -> None:
    item, static, moving, theta = CASES[name]
    rng = np.random.default_rng(5)
    static, moving = (points[rng.random(len(points)) < 0.2] for points in (static, moving))
    static, moving = (points + rng.normal(0, 0.004, points.shape) for points in (static, moving))
    assert infer_direction(item, theta, static, moving) == "opening"


def test_half_a_closing_is_a_closing() -> None:
    """A door that goes from 80 to 40 degrees."""
    item, static, moving, _ = CASES["side door"]
    ajar = apply(item.motion(np.radians(80)), moving)
    back = Joint(type="revolute", axis=-item.axis, origin=item.origin, lower=0.0, upper=1.0)
    assert infer_direction(back, np.radians(40), static, ajar) == "closing"


def test_a_panel_closes_though_the_scan_never_saw_what_it_stood_before() -> None:
    """Half open, the sliding panel hides most of the fixed one, and jars stand in the opening."""
    ajar = PANEL + [0.12, 0.0, 0.0]
    seen = CABINET[~((CABINET[:, 1] == 0) & (CABINET[:, 0] > 0.12) & (CABINET[:, 0] < 0.33))]
    jars = [sheet((x, x + 0.04), (0.02, 0.06), (0.02, 0.13)) for x in (0.01, 0.06)]
    static = np.concatenate([seen, *jars])
    back = joint("prismatic", [-1.0, 0, 0], [0, 0, 0])
    assert infer_direction(back, 0.12, static, ajar) == "closing"
    assert infer_direction(joint("prismatic", [1.0, 0, 0], [0, 0, 0]), 0.05, static, ajar) == "opening"
