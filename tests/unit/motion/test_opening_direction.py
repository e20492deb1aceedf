"""Opening and closing, judged on boxes, doors, lids, drawers and sliding panels made of points."""

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.motion.opening_direction import infer_direction


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
DOOR = sheet((0, 0.4), (-0.01, -0.01), (0, 0.3))
BASE = sheet((0, 0.4), (0, 0.3), (0, 0.02))
LID = sheet((0, 0.4), (0, 0.3), (0.03, 0.03))
FRONT = sheet((0, 0.4), (-0.01, -0.01), (0, 0.3))
TRAY = np.concatenate(
    [FRONT, sheet((0.01, 0.39), (0, 0.28), (0.01, 0.01)), sheet((0.01, 0.01), (0, 0.28), (0.01, 0.2))]
)
# A cabinet whose right half is behind a fixed panel and whose left half is behind a sliding one.
CABINET = np.concatenate([SHELL, sheet((0.2, 0.4), (0, 0), (0, 0.3))])
PANEL = sheet((0, 0.21), (-0.01, -0.01), (0, 0.3))


def joint(kind: str, axis: list[float], origin: list[float]) -> Joint:
    return Joint(type=kind, axis=np.array(axis), origin=np.array(origin), lower=0.0, upper=1.0)  # type: ignore[arg-type]


CASES = {
    "side door": (joint("revolute", [0, 0, -1.0], [0, 0, 0]), SHELL, DOOR, np.radians(70)),
    "a little of a door": (joint("revolute", [0, 0, -1.0], [0, 0, 0]), SHELL, DOOR, np.radians(15)),
    "oven": (joint("revolute", [1.0, 0, 0], [0, 0, 0]), SHELL, DOOR, np.radians(80)),
    "laptop": (joint("revolute", [-1.0, 0, 0], [0, 0.3, 0.02]), BASE, LID, np.radians(100)),
    "drawer": (joint("prismatic", [0, -1.0, 0], [0, 0, 0]), SHELL, TRAY, 0.15),
    "drawer, front alone": (joint("prismatic", [0, -1.0, 0], [0, 0, 0]), SHELL, FRONT, 0.05),
    "sliding panel": (joint("prismatic", [1.0, 0, 0], [0, 0, 0]), CABINET, PANEL, 0.15),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("turned", [False, True])
def test_there_is_opening_and_back_is_closing(name: str, turned: bool) -> None:
    item, static, moving, theta = CASES[name]
    T = transform(matrix_from_rotvec([0.1, -0.2, 2.0]), np.array([0.4, -0.7, 0.1])) if turned else np.eye(4)
    item, static, moving = item.moved(T), apply(T, static), apply(T, moving)
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
