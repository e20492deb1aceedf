"""Robot model against MuJoCo itself, and silhouettes against projected vertices."""

import mujoco
import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.transforms import apply, invert
from aomgen.errors import BackendError, ConfigError, MissingFileError
from aomgen.robots.loading import load_robot
from aomgen.robots.silhouette import SilhouetteRenderer

JOINTS = np.array([3.2, -1.9, 2.1, 0.3, 1.2, 0.4])


@pytest.fixture(scope="module")
def renderer(robot):
    with SilhouetteRenderer(robot, max_width=320, max_height=240) as renderer:
        yield renderer


def camera() -> Camera:
    return Camera(
        fx=260.0, fy=250.0, cx=171.3, cy=109.2, width=320, height=240,
        T_world_cam=look_at([1.6, -1.1, 0.9], [0.0, 0.0, 0.35]),
    )  # fmt: skip


def test_link_poses_are_mujoco_forward_kinematics(robot):
    model = robot.spec().compile()
    data = mujoco.MjData(model)
    data.qpos[:] = robot.qpos(JOINTS[None], [0.3])[0]
    mujoco.mj_forward(model, data)
    poses = robot.link_poses(JOINTS[None], [0.3])[0]
    for index, name in enumerate(robot.body_names):
        assert poses[index, :3, 3] == pytest.approx(data.body(name).xpos, abs=1e-9)
        assert poses[index, :3, :3].ravel() == pytest.approx(data.body(name).xmat, abs=1e-9)
    ee = robot.ee_poses(JOINTS[None])[0]
    assert ee[:3, 3] == pytest.approx(data.site(robot.ee_site).xpos, abs=1e-9)


def test_fingers_close_symmetrically_and_their_loop_stays_shut(robot):
    gripper = np.linspace(0.0, 1.0, 9)
    poses = robot.link_poses(np.repeat(JOINTS[None], 9, 0), gripper)
    pads = {pad.finger: pad for pad in robot.pads}
    tips = {
        name: np.array([apply(T, pad.center_body) for T in poses[:, pad.body]]) for name, pad in pads.items()
    }
    gaps = np.linalg.norm(tips["left"] - tips["right"], axis=1)
    assert np.all(np.diff(gaps) < 0)
    assert gaps[0] > 0.08
    ee = robot.ee_poses(JOINTS[None])[0]
    middle = apply(invert(ee), (tips["left"] + tips["right"]) / 2)
    assert np.abs(middle[:, :2]).max() < 5e-4
    for pad in pads.values():
        other = pads["left" if pad.finger == "right" else "right"]
        R_world_body = poses[0, pad.body, :3, :3]
        towards = tips[other.finger][0] - tips[pad.finger][0]
        assert R_world_body @ pad.normal_body @ towards > 0.9 * np.linalg.norm(towards)
    follower = robot.body_names.index("gripper_right_follower")
    coupler = robot.body_names.index("gripper_right_coupler")
    T_coupler_follower = invert(poses[:, coupler]) @ poses[:, follower]
    assert np.ptp(T_coupler_follower[:, :3, 3], axis=0).max() < 1e-3


def test_ur_base_turns_the_world_half_a_turn(robot):
    turned = load_robot("ur5e_2f85", base_frame="ur_base")
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    expected = half_turn @ robot.link_poses(JOINTS[None], 0.0)
    assert turned.link_poses(JOINTS[None], 0.0) == pytest.approx(expected, abs=1e-9)


def test_fast_spec_keeps_kinematics_and_collisions(robot):
    model = robot.spec(visual=False).compile()
    assert [model.body(b).name for b in range(1, model.nbody)] == list(robot.body_names)
    assert model.geom("gripper_left_pad1").id >= 0
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.impratio == 10.0


def test_silhouette_covers_exactly_the_projected_vertices(robot, renderer):
    view = camera()
    bodies, depth = renderer.draw(view, JOINTS, 0.2)
    poses = robot.link_poses(JOINTS[None], [0.2])[0]
    vertices = np.concatenate([apply(poses[m.body], m.vertices_body) for m in robot.meshes])
    pixels, depths = view.project(vertices)
    rows, columns = np.nonzero(bodies >= 0)
    assert columns.min() == pytest.approx(pixels[:, 0].min(), abs=1.0)
    assert columns.max() + 1 == pytest.approx(pixels[:, 0].max(), abs=1.0)
    assert rows.min() == pytest.approx(pixels[:, 1].min(), abs=1.0)
    inside = np.all((pixels >= 0) & (pixels < [320, 240]), axis=1)
    u, v = pixels[inside].astype(int).T
    near = np.zeros_like(bodies, bool)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            near |= np.roll(bodies >= 0, (dv, du), (0, 1))
    assert near[v, u].all()
    assert depth[bodies >= 0].min() == pytest.approx(depths.min(), abs=0.005)
    seen = depth[v, u] > 0
    assert np.quantile((depths[inside] - depth[v, u])[seen], 0.02) > -0.01


def test_a_camera_turned_away_sees_nothing(renderer):
    away = camera().move(look_at([1.6, -1.1, 0.9], [3.2, -2.2, 1.5]))
    bodies, depth = renderer.draw(away, JOINTS, 0.0)
    assert np.all(bodies == -1)
    assert np.all(depth == 0)


def test_a_urdf_is_read(tmp_path):
    path = tmp_path / "two_links.urdf"
    path.write_text(
        "<robot name='two'><link name='base'/><link name='tip'><visual><geometry><box size='.1 .1 .1'/></geometry>"
        "</visual><inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial>"
        "</link><joint name='turn' type='revolute'><parent link='base'/><child link='tip'/><axis xyz='0 0 1'/>"
        "<origin xyz='0 0 0.5'/><limit lower='-1' upper='2' effort='1' velocity='1'/></joint></robot>"
    )
    robot = load_robot(path)
    assert robot.joint_names == ("turn",)
    assert robot.joint_limits.tolist() == [[-1.0, 2.0]]
    assert robot.ee_poses(np.array([[np.pi / 2]]))[0] == pytest.approx(
        np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1.0]]), abs=1e-9
    )


def test_unknown_robots_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="known: ur5e_2f85"):
        load_robot("ur9000")
    with pytest.raises(MissingFileError):
        load_robot(tmp_path / "robot.urdf")
    with pytest.raises(ConfigError, match="base_link or ur_base"):
        load_robot("ur5e_2f85", base_frame="flange")


def test_a_picture_larger_than_the_context_is_refused(renderer):
    with pytest.raises(BackendError, match="exceeds"):
        renderer.draw(camera().resize(640, 480), JOINTS, 0.0)
