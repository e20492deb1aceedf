"""What the shape of the parts suggests."""

import numpy as np
import pytest

from aomgen.core.transforms import angle_between, matrix_from_rotvec
from aomgen.motion.axis_prior import AxisHint, measure_shape
from aomgen.motion.ee_path import EePath, GraspGuess
from aomgen.motion.joint_estimation import estimate_joint
from aomgen.motion.joint_models import Revolute
from boxy_microwave import BODY, DOOR, R, box_points

HANDLE = R @ [0.18, -0.2, 0.13]
FRONT = R @ [0, -1.0, 0]


HINGE = R @ [-0.22, -0.145, 0.13]


def test_the_face_looks_forwards() -> None:
    assert np.degrees(angle_between(measure_shape(BODY, DOOR).face_normal, FRONT)) < 2


def test_one_of_the_sides_is_the_hinge() -> None:
    shape = measure_shape(BODY, DOOR)
    misfits = [np.abs(hint.residuals(R[:, 2], HINGE)).max() for hint in shape.hinges()]
    assert min(misfits) < 2
    assert sum(hint.probability for hint in shape.hinges()) == pytest.approx(0.9)


def test_a_drawer_may_run_forwards() -> None:
    misfits = [np.abs(hint.residuals(FRONT, HANDLE)).max() for hint in measure_shape(BODY, DOOR).rails()]
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
    hint = AxisHint(
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
    path = EePath.of(np.repeat(np.eye(4)[None], 4, 0), GraspGuess(point_ee=np.zeros(3)))
    door = Revolute(path=path, start=R[:, 2], reach_m=shape.reach_m(HANDLE))
    x = door.first()
    x[4] = 0.9 * door.reach_m
    assert door.beliefs(x)[-1] == 0
    x[4] = 2.0 * door.reach_m
    assert door.beliefs(x)[-1] > 5


@pytest.mark.parametrize("ajar", [0.0, 0.5, 1.2, 2.6])
def test_another_door_of_the_object_that_stands_ajar_does_not_mislead(ajar: float) -> None:
    """A second cupboard to the right, hinged at its far side: its door belongs to the static part."""
    hinge = R @ [0.65, -0.145, 0.13]
    door = box_points((0.23, -0.17, 0.01), (0.65, -0.145, 0.25), 6)
    swung = (door - hinge) @ matrix_from_rotvec([0.0, 0.0, ajar]).T + hinge
    static = np.concatenate([BODY, box_points((0.22, -0.14, 0), (0.66, 0.2, 0.26), 5), swung])
    shape = measure_shape(static, DOOR)
    assert np.degrees(angle_between(shape.face_normal, FRONT)) < 2
    assert min(np.abs(hint.residuals(R[:, 2], HINGE)).max() for hint in shape.hinges()) < 2
