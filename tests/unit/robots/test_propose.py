"""Robots from a user's file: what they do must be what the file says, whatever it leaves out."""

import mujoco
import numpy as np
import pytest

from aomgen.core.transforms import apply, invert, matrix_from_rotvec
from aomgen.errors import MalformedFileError
from aomgen.robots.description import FILE_NAME, description_toml
from aomgen.robots.loading import load_robot
from aomgen.robots.propose import propose_description

ARM = ("shoulder", "elbow", "wrist")
JOINTS = np.array([[0.4, -0.5, 0.9]])


def pad_faces_ee(robot, gripper):
    """Middles (2, 3) of the left and right face in the end effector's frame."""
    T_world_ee = robot.ee_poses(JOINTS)[0]
    poses = robot.link_poses(JOINTS, [gripper])[0]
    return np.array([apply(invert(T_world_ee) @ poses[pad.body], pad.face_body) for pad in robot.pads])


def test_arm_ends_where_the_fingers_branch(write_urdf):
    robot = load_robot(write_urdf())
    assert robot.name == "small"
    assert robot.joint_names == ARM
    assert robot.hand_bodies == ("finger_a", "finger_b")
    assert robot.joint_limits == pytest.approx(np.array([[-3, 3], [-2, 2], [-2, 2]]))


def test_gripper_value_closes_the_fingers_over_their_whole_stroke(write_urdf):
    robot = load_robot(write_urdf())
    gaps = [float(np.ptp(pad_faces_ee(robot, g)[:, 1])) for g in (0.0, 0.5, 1.0)]
    assert gaps[0] - gaps[2] == pytest.approx(2 * 0.04, abs=1e-6)
    assert gaps[1] == pytest.approx((gaps[0] + gaps[2]) / 2, abs=1e-6)
    assert gaps[2] == pytest.approx(0.01, abs=1e-6)


def test_grasp_point_lies_between_the_pads_and_looks_out_of_the_palm(write_urdf):
    robot = load_robot(write_urdf())
    left, right = pad_faces_ee(robot, 1.0)
    assert (left + right)[:2] == pytest.approx(0.0, abs=1e-3)
    across = (right - left) / np.linalg.norm(right - left)
    assert across == pytest.approx(robot.closing_ee, abs=0.05)
    palm = (
        invert(robot.ee_poses(JOINTS)[0]) @ robot.link_poses(JOINTS, [0.0])[0][robot.body_names.index("palm")]
    )
    assert -palm[:3, 3] @ robot.approach_ee > 0.05


def test_pads_look_at_each_other(write_urdf):
    robot = load_robot(write_urdf())
    poses = robot.link_poses(JOINTS, [0.3])[0]
    normals = [poses[pad.body][:3, :3] @ pad.normal_body for pad in robot.pads]
    assert normals[0] @ normals[1] == pytest.approx(-1.0, abs=1e-3)


def test_order_of_the_log_is_the_order_of_the_joints(write_urdf):
    path = write_urdf()
    forward, backward = load_robot(path), load_robot(path, joints=ARM[::-1])
    assert backward.ee_poses(JOINTS[:, ::-1]) == pytest.approx(forward.ee_poses(JOINTS), abs=1e-12)


def test_ur_base_turns_the_whole_robot(write_urdf):
    path = write_urdf()
    turn = np.eye(4)
    turn[:3, :3] = matrix_from_rotvec([0, 0, np.pi])
    straight, turned = load_robot(path), load_robot(path, "ur_base")
    assert turned.ee_poses(JOINTS) == pytest.approx(turn @ straight.ee_poses(JOINTS), abs=1e-9)


def test_base_shapes_are_kept_and_all_that_is_seen_is_meshed(write_urdf):
    robot = load_robot(write_urdf())
    assert {robot.body_names[mesh.body] for mesh in robot.meshes} >= {"upper", "fore", "palm", "finger_a"}
    lowest = min(
        float(apply(robot.link_poses(JOINTS, [0.0])[0][mesh.body], mesh.vertices_body)[:, 2].min())
        for mesh in robot.meshes
    )
    assert lowest == pytest.approx(0.0, abs=1e-9)


def test_servos_hold_the_arm_against_gravity_and_reach_the_gripper_value(write_urdf):
    robot = load_robot(write_urdf())
    model = robot.spec(visual=False).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = robot.qpos(JOINTS, [0.0])[0]
    for name, value in zip(robot.joint_names, JOINTS[0], strict=True):
        data.ctrl[model.actuator(f"servo_{name}").id] = value
    data.ctrl[model.actuator(robot.drive.actuator).id] = robot.drive.control_range[1]
    mujoco.mj_step(model, data, 1000)
    qpos = data.qpos[[model.joint(name).qposadr[0] for name in robot.joint_names]]
    assert qpos == pytest.approx(JOINTS[0], abs=0.02)
    driver = data.qpos[model.joint(robot.drive.driver).qposadr[0]]
    assert driver == pytest.approx(robot.drive.driver_range[1], abs=0.002)


def test_two_free_fingers_close_against_each_other(write_urdf):
    both = load_robot(write_urdf())
    free = load_robot(write_urdf(mimic=""))
    assert pad_faces_ee(free, 1.0) == pytest.approx(pad_faces_ee(both, 1.0), abs=1e-6)


def test_what_a_person_tells_of_the_hand_wins(write_urdf):
    path = write_urdf()
    draft = propose_description(
        path,
        path.parent,
        opened={"slide_a": 0.03},
        closed={"slide_a": 0.01},
        fingers=("finger_b", "finger_a"),
    )
    (path.parent / FILE_NAME).write_text(description_toml(draft))
    robot = load_robot(path)
    assert robot.drive.driver_range == (0.03, 0.01)
    assert [robot.body_names[pad.body] for pad in robot.pads] == ["finger_b", "finger_a"]
    assert np.ptp(pad_faces_ee(robot, 0.0)[:, 1]) == pytest.approx(0.07, abs=1e-6)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"opened": {"slide_a": 0.0}, "closed": {"slide_a": 0.04}}, "farther apart"),
        ({"opened": {"slide_a": 0.0}}, "different joints"),
        ({"opened": {"thumb": 0.0}, "closed": {"thumb": 1.0}}, "no finger joint 'thumb'"),
        ({"fingers": ("finger_a", "thumb")}, "no body 'thumb'"),
    ],
)
def test_wrong_words_about_the_hand_are_refused(write_urdf, told, message):
    path = write_urdf()
    with pytest.raises(MalformedFileError, match=message):
        propose_description(path, path.parent, **told)


def test_the_first_driving_joint_may_rest(write_urdf):
    path = write_urdf(mimic="")
    draft = propose_description(
        path,
        path.parent,
        opened={"slide_a": 0.0, "slide_b": 0.04},
        closed={"slide_a": 0.0, "slide_b": 0.0},
    )
    (path.parent / FILE_NAME).write_text(description_toml(draft))
    drive = load_robot(path).drive
    assert (drive.driver, drive.driver_range) == ("slide_b", (0.04, 0.0))


def test_a_robot_without_a_name_has_that_of_its_file(write_urdf):
    path = write_urdf()
    path.write_text(path.read_text().replace('name="small"', 'name=""'))
    assert load_robot(path).name == "robot"


def test_a_joint_may_be_limited_to_angles_beyond_half_a_turn(write_urdf):
    path = write_urdf()
    path.write_text(path.read_text().replace('lower="-3" upper="3"', 'lower="3.3" upper="6"'))
    assert load_robot(path).joint_limits[0] == pytest.approx([3.3, 6])


@pytest.mark.parametrize(("kind", "unit"), [("prismatic", "m"), ("revolute", "rad")])
def test_fingers_that_stop_are_refused_in_their_unit(write_urdf, kind, unit):
    path = write_urdf()
    draft = propose_description(path, path.parent)
    text = description_toml(draft).replace('"slide_a" = 0.04', '"slide_a" = 0.07')
    (path.parent / FILE_NAME).write_text(text)
    path.write_text(path.read_text().replace('type="prismatic"', f'type="{kind}"'))
    with pytest.raises(MalformedFileError, match=rf"deviation is 0\.0\d+ {unit}, limit 0\.002 {unit};"):
        load_robot(path)


def test_fingers_that_hardly_move_are_no_gripper(write_urdf):
    with pytest.raises(MalformedFileError, match="no two fingers that close"):
        load_robot(write_urdf(stroke=0.001))


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (("shoulder", "elbow", "hip"), "no joint 'hip'"),
        (("shoulder", "slide_a", "slide_b"), "another branch"),
        (("shoulder", "wrist"), "'elbow', which is neither"),
    ],
)
def test_joint_names_that_make_no_arm_are_refused(write_urdf, joints, message):
    with pytest.raises(MalformedFileError, match=message):
        load_robot(write_urdf(), joints=joints)


MJCF = """<mujoco model="one">
  <worldbody><light pos="0 0 3"/><geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="cup" pos="1 0 0"><freejoint/><geom type="sphere" size="0.05"/></body>
    <body name="mount" pos="0 0 0.2"><geom type="box" size="0.05 0.05 0.2"/>
      <body name="arm" pos="0 0 0.2"><joint name="turn" axis="0 0 1" range="-90 90"/>
        <geom type="capsule" size="0.03 0.1" pos="0 0 0.15"/>
        {fingers}
      </body></body></worldbody>
  {rest}
</mujoco>"""
TENDON = (
    '<tendon><fixed name="both"><joint joint="a" coef="0.5"/><joint joint="b" coef="0.5"/></fixed></tendon>'
    '<equality><joint joint1="a" joint2="b"/></equality>'
    '<actuator><general name="grip" tendon="both" ctrlrange="0 255"/></actuator>'
)
FINGERS = """
<body name="right_finger" pos="0 -0.005 0.3"><joint name="a" type="slide" axis="0 -1 0" range="0 0.03"/>
  <geom type="box" size="0.01 0.005 0.03" pos="0 -0.005 0.03"/></body>
<body name="left_finger" pos="0 0.005 0.3"><joint name="b" type="slide" axis="0 1 0" range="0 0.03"/>
  <geom type="box" size="0.01 0.005 0.03" pos="0 0.005 0.03"/></body>"""


def write_mjcf(folder, *, fingers=FINGERS, rest=TENDON):
    path = folder / "robot.xml"
    path.write_text(MJCF.format(fingers=fingers, rest=rest))
    return path


def test_only_the_robot_of_a_scene_is_taken(tmp_path):
    robot = load_robot(write_mjcf(tmp_path))
    assert "cup" not in robot.body_names
    assert robot.joint_names == ("turn",)
    # Degrees in the file, radians afterwards.
    assert robot.joint_limits == pytest.approx(np.array([[-np.pi / 2, np.pi / 2]]))
    assert robot.spec().compile().nlight == 0


def test_sides_follow_the_names_of_the_fingers(tmp_path):
    robot = load_robot(write_mjcf(tmp_path))
    assert [robot.body_names[pad.body] for pad in robot.pads] == ["left_finger", "right_finger"]


def test_an_arm_without_fingers_has_no_pads(tmp_path):
    robot = load_robot(write_mjcf(tmp_path, fingers='<site name="attachment_site" pos="0 0 0.3"/>', rest=""))
    assert robot.pads == ()
    assert robot.drive is None
    assert robot.ee_site == "attachment_site"


def test_words_about_the_hand_of_an_arm_without_fingers_are_refused(tmp_path):
    path = write_mjcf(tmp_path, fingers="", rest="")
    with pytest.raises(MalformedFileError, match="no finger joints"):
        propose_description(path, tmp_path, opened={"a": 0.0}, closed={"a": 1.0})


def test_a_file_without_joints_is_refused(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text('<mujoco><worldbody><body><geom size="0.1"/></body></worldbody></mujoco>')
    with pytest.raises(MalformedFileError, match="no robot"):
        load_robot(path)


def test_fingers_that_nothing_ties_together_need_words(tmp_path):
    third = '<body name="third" pos="0.02 0 0.3"><joint name="c" type="slide" range="0 0.03"/><geom size="0.01"/></body>'
    with pytest.raises(MalformedFileError, match="how the finger joints"):
        load_robot(write_mjcf(tmp_path, fingers=FINGERS + third, rest=""))
