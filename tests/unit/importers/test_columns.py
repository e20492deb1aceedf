"""Units, joints and grippers are recognised or asked for, and never guessed in silence."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from aomgen.errors import AomgenError, ConfigError, MalformedFileError, UnitsError, UnknownNameError
from aomgen.importers.gripper_column import find_gripper, read_share
from aomgen.importers.joint_columns import choose_table, parse_joint_map, read_column_unit, read_joints
from aomgen.importers.recorded import JointTable

JOINTS = ("elbow_joint", "wrist_1_joint")


def make_table(columns: Mapping[str, Sequence[float]], name: str = "log", unit: str = "") -> JointTable:
    values = {column: np.array(numbers, np.float64) for column, numbers in columns.items()}
    return JointTable(
        name=name, times_s=np.arange(len(next(iter(values.values())))), columns=values, unit=unit
    )


def read(
    values: Sequence[float], stated: str = "", unit: str = "", names: Sequence[str] = JOINTS
) -> np.ndarray:
    table = make_table({name: values for name in names}, unit=unit)
    limits = np.array([[-1.0, 1.0], [0.0, 4.0]])
    return read_joints(table, list(names), stated, lambda: (limits, np.zeros(2, bool)), "log")[0]


def read_rail(rail: float, elbow: float, stated: str = "", elbow_name: str = "elbow") -> list[float]:
    """Read one row of a prismatic and a continuous joint."""
    table = make_table({"rail": [rail], elbow_name: [elbow]})
    limits = np.array([[0.0, 2.0], [-np.inf, np.inf]])
    robot = limits, np.array([True, False])
    return read_joints(table, ["rail", elbow_name], stated, lambda: robot, "log")[0][0].tolist()


@pytest.mark.parametrize(
    ("name", "unit"),
    [("elbow_deg", "deg"), ("elbow (rad)", "rad"), ("Elbow [Degrees]", "deg"), ("elbow", ""), ("q_grad", "")],
)
def test_units_in_names(name: str, unit: str):
    assert read_column_unit(name) == unit


def test_units_are_recognised():
    np.testing.assert_allclose(read([0.5, -3.0])[:, 0], [0.5, -3.0])
    np.testing.assert_allclose(read([0.5, -130.0])[:, 0], np.radians([0.5, -130.0]))
    np.testing.assert_allclose(
        read([0.5, 5.0], names=["elbow [deg]", "wrist [deg]"]), np.radians([[0.5] * 2, [5.0] * 2])
    )


def test_units_are_stated():
    np.testing.assert_allclose(read([0.5, 90.0], "deg")[:, 0], np.radians([0.5, 90.0]))
    np.testing.assert_allclose(read([-100.0, 50.0], "normalized"), [[-1.0, 0.0], [0.5, 3.0]])


def test_only_revolute_joints_have_a_unit_of_angles():
    degrees = pytest.approx([0.5, np.radians(130)])
    assert read_rail(0.5, 130.0) == degrees
    assert read_rail(0.5, 130.0, "deg") == degrees
    assert read_rail(0.5, 130.0, elbow_name="elbow [deg]") == degrees
    assert read_rail(0.5, 3.0, elbow_name="elbow [rad]") == [0.5, 3.0]
    for stated in ("", "rad", "deg"):
        with pytest.raises(UnitsError, match=r"'rail' of a prismatic joint reaches 598.0, limit 6.41 m"):
            read_rail(598.0, 1.0, stated)
    with pytest.raises(UnitsError, match="'elbow' of a continuous joint cannot be normalized"):
        read_rail(0.0, 50.0, "normalized")


@pytest.mark.parametrize(
    ("values", "stated", "unit", "words"),
    [
        ([0.5, 90.0], "", "", "--unit deg or --unit normalized"),
        ([0.5, 90.0], "", "rad", "limit 6.41 for rad (the format's unit); state the unit: --unit deg"),
        ([0.5, 90.0], "rad", "", "--unit deg or normalized"),
        ([0.5, 120.0], "normalized", "", "limit 102.00"),
        ([0.5, 4000.0], "", "", "reaches 4000.0"),
    ],
)
def test_ambiguous_units_are_asked_for(values: Sequence[float], stated: str, unit: str, words: str):
    with pytest.raises(UnitsError, match=r"'elbow_joint' reaches") as caught:
        read(values, stated, unit)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("values", "stated", "expected"),
    [
        ([0.0, 0.5, 0.8], (None, None), [0.0, 0.5, 0.8]),
        ([3.0, 127.5, 200.0], (None, None), [3 / 255, 0.5, 200 / 255]),
        ([1.0, 0.5, 0.0], (1.0, None), [0.0, 0.5, 1.0]),
        ([255.0, 0.0], (255.0, None), [0.0, 1.0]),
        ([255.0, 0.0], (0.0, None), [1.0, 0.0]),
        ([100.0, 25.0], (100.0, None), [0.0, 0.75]),
        ([0.085, 0.017], (0.085, None), [0.0, 0.8]),
        ([85.0, 17.0], (85.0, None), [0.0, 0.8]),
        ([0.0, 0.6], (0.0, 0.8), [0.0, 0.75]),
        ([0.0, 60.0], (0.0, 80.0), [0.0, 0.75]),
        ([0.9, 0.1], (0.0, None), [0.9, 0.1]),
    ],
)
def test_grippers(values: Sequence[float], stated: tuple, expected: Sequence[float]):
    np.testing.assert_allclose(read_share(np.array(values), "gripper", *stated, "log")[0], expected)


@pytest.mark.parametrize(
    ("values", "stated", "name", "kind", "words"),
    [
        (
            [0.08, 0.01],
            (None, None),
            "gripper",
            UnitsError,
            "opening in meters?; state it: --gripper-open 0.085",
        ),
        (
            [1.0, 0.0],
            (None, None),
            "gripper",
            UnitsError,
            "reversed?; state which one is open: --gripper-open 0",
        ),
        ([255.0, 0.0], (None, None), "gripper", UnitsError, "--gripper-open 255"),
        ([0.5, 0.5], (None, None), "gripper", UnitsError, "half open"),
        ([0.0, 80.0], (None, None), "gripper", UnitsError, "percent, millimeters"),
        ([0.0, 900.0], (None, None), "gripper", UnitsError, "another one?"),
        ([0.0, 0.7], (None, None), "finger_joint", UnitsError, "--gripper-open 0 --gripper-closed 0.8"),
        ([0.0, 0.7], (0.0, None), "finger_joint", UnitsError, "state it with --gripper-closed"),
        ([0.0, 60.0], (0.0, None), "gripper", UnitsError, "state it with --gripper-closed"),
        ([0.0, 60.0], (0.0, 40.0), "gripper", UnitsError, "outside 0 (open) .. 40 (closed)"),
        ([0.0, 1.0], (None, 1.0), "gripper", ConfigError, "is given without --gripper-open"),
        ([0.0, 1.0], (1.0, 1.0), "gripper", ConfigError, "values of both"),
    ],
)
def test_ambiguous_grippers_are_asked_for(values, stated, name: str, kind: type[AomgenError], words: str):
    with pytest.raises(kind) as caught:
        read_share(np.array(values), name, *stated, "log")
    assert words in str(caught.value)


def test_joints_are_found_by_name():
    table = make_table({"Wrist-1.pos": [1], "gripper": [0], "left/elbow": [2], "velocity": [3]})
    assert choose_table([table], JOINTS, {}, "", "log")[1] == ("left/elbow", "Wrist-1.pos")


def test_joints_are_mapped():
    table = make_table(
        {"q1": [1], "q2": [2], "a_elbow_joint": [3], "a_wrist_1_joint": [4], "b_elbow_joint": [5]}
    )
    mapped = parse_joint_map(["elbow_joint=q2, wrist_1_joint=q1"], JOINTS)
    assert choose_table([table], JOINTS, mapped, "", "log")[1] == ("q2", "q1")
    assert choose_table([table], JOINTS, parse_joint_map(["a_*"], JOINTS), "", "log")[1][0] == "a_elbow_joint"


@pytest.mark.parametrize(
    ("entry", "kind", "words"),
    [
        ("elbow_joint", ConfigError, "'elbow_joint' is not JOINT=COLUMN"),
        ("elbow=q1", UnknownNameError, "did you mean 'elbow_joint'?"),
    ],
)
def test_wrong_maps(entry: str, kind: type[AomgenError], words: str):
    with pytest.raises(kind) as caught:
        parse_joint_map([entry], JOINTS)
    assert words in str(caught.value)


def test_a_missing_joint_suggests_near_names():
    table = make_table({"elbw_joint": [1], "wrist_1_joint": [2]})
    with pytest.raises(MalformedFileError) as caught:
        choose_table([table], JOINTS, {}, "", "log")
    assert "no column for joint 'elbow_joint' (columns of log: elbw_joint, wrist_1_joint)" in str(
        caught.value
    )
    assert "did you mean 'elbw_joint'? State it with --joint-map elbow_joint=COLUMN" in str(caught.value)


def test_two_robots_are_asked_about():
    left, right = (make_table({key: [1.0] for key in JOINTS}, name) for name in ("/left", "/right"))
    with pytest.raises(ConfigError, match=r"2 robots: /left, /right; choose one with --topic"):
        choose_table([left, right], JOINTS, {}, "", "bag")
    assert choose_table([left, right], JOINTS, {}, "/right", "bag")[0] is right
    with pytest.raises(UnknownNameError, match=r"--topic: '/center' is unknown; known: /left, /right"):
        choose_table([left, right], JOINTS, {}, "/center", "bag")
    both = make_table({f"{side}_{name}": [1.0] for side in ("left", "right") for name in JOINTS})
    with pytest.raises(ConfigError, match=r"2 columns for 'elbow_joint': .* or --joint-map 'left_\*'"):
        choose_table([both], JOINTS, {}, "", "bag")


def test_the_gripper_is_found_or_asked_for():
    arm = make_table({"elbow_joint": [1], "force": [0]})
    hand = make_table({"left_finger_joint": [1], "right_finger_joint": [1]}, "/hand")
    with pytest.raises(
        MalformedFileError, match=r"no column of the gripper \(other columns: force\).*--gripper-column"
    ):
        find_gripper([arm], arm, ["elbow_joint"], "", "bag")
    with pytest.raises(ConfigError, match=r"2 columns of a gripper: left_finger_joint, right_finger_joint"):
        find_gripper([arm, hand], arm, ["elbow_joint"], "", "bag")
    assert find_gripper([arm, hand], arm, ["elbow_joint"], "left_finger_joint", "bag") == (
        hand,
        "left_finger_joint",
    )
    with pytest.raises(UnknownNameError, match=r"'left_finger' is unknown; did you mean 'left_finger_joint'"):
        find_gripper([arm, hand], arm, ["elbow_joint"], "left_finger", "bag")
