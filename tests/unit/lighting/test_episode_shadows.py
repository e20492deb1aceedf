import numpy as np
import pytest

from aomgen.core.sh import sphere_directions
from aomgen.core.transforms import apply
from aomgen.lighting.episode_shadows import _cast_arm_shadow, find_body_spheres, measure_sphere_share
from aomgen.lighting.object_shadow import FILL
from aomgen.lighting.plane_shadow import PlaneGrid
from aomgen.twin.twin import TwinState, body_poses

RIGHT = 1.5


@pytest.mark.parametrize("middle", [(0.02, -0.01, 0.12), (0.3, 0.1, 0.4)])
def test_a_sphere_keeps_what_rays_say(middle):
    """Of rays to an even sky, counted by their sine, so many meet the sphere."""
    radius, place = 0.08, np.array([0.05, 0.03, 0.0])
    grid = PlaneGrid(low=place[:2] - 0.05, cell=0.1, columns=1, rows=1)
    rays = sphere_directions(400_000)
    rays = rays[rays[:, 2] > 0]
    beside = np.linalg.norm(np.cross(rays, middle - place), axis=1)
    met = rays[beside < radius, 2].sum() / rays[:, 2].sum()
    assert measure_sphere_share(np.array([middle]), radius, grid)[0, 0, 0] == pytest.approx(met, rel=0.02)


def test_spheres_lie_along_the_robot(toy_scene):
    """No piece of the arm is farther from a sphere than it is thick."""
    spheres, robot = find_body_spheres(toy_scene.robot), toy_scene.robot
    for mesh in robot.meshes:
        own = [item for item in spheres if item[0] == 1 + mesh.body]
        away = [np.linalg.norm(mesh.vertices_body - center, axis=1) - 2 * radius for _, center, radius in own]
        assert np.min(away, 0).max() < 0.03


def test_the_shadow_goes_with_the_arm(toy_scene):
    """At the scan's pose nothing changes; turned, it is dark below the arm and light comes back where it was."""
    twin = toy_scene.twin
    scan = twin.scan_state
    turned = TwinState(
        joints=scan.joints + RIGHT * np.eye(6)[0],
        gripper=scan.gripper,
        theta=scan.theta,
        T_world_object=scan.T_world_object,
    )
    grid, block = _cast_arm_shadow(twin, toy_scene.robot, 1 - FILL, np.eye(4))
    Ts = np.stack([body_poses(twin, toy_scene.robot, state) for state in (scan, turned)])
    still, moved = block(Ts)
    assert not still.any()
    upper = 1 + toy_scene.robot.body_names.index("upper_arm_link")
    under = grid.lookup(apply(Ts[:, upper], np.zeros(3))[:, :2]) @ moved.ravel()
    assert under[0] < -0.01
    assert under[1] > 0.01
