import numpy as np
import pytest
from scipy.spatial import cKDTree

from aomgen.assets.choice import make_asset
from aomgen.conventions import MOVING, STATIC
from aomgen.core.mesh import sample_surface
from aomgen.core.transforms import apply
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene_renderer import SceneRenderer
from benchmarks.motion_scan import SPACING_M, Surface, raw_gaussians, seen_surface
from benchmarks.motion_upstream import Upstream
from synthetic.layout import SceneLayout, build_world, draw_layout
from synthetic.scene_recording import Conditions, scan_cameras


@pytest.fixture(scope="module")
def scanned(robot: RobotModel) -> tuple[SceneLayout, Surface]:
    rng = np.random.default_rng(0)
    layout = draw_layout(make_asset("drawer", 1), rng)
    world = build_world(robot, layout, visual=True)
    conditions = Conditions(size=(160, 120), scan_views=6)
    cameras = scan_cameras(layout, conditions, rng)
    with SceneRenderer(world, conditions.size) as painter:
        qpos = np.zeros(world.model.nq)
        surface, images = seen_surface(painter, cameras, qpos, layout.T_world_object[:3, 3], rng)
    assert [image.shape for image in images] == [(120, 160, 3)] * 6
    return layout, surface


def test_seen_points_lie_on_the_part_that_their_label_says(scanned):
    layout, surface = scanned
    rng = np.random.default_rng(1)
    for label, link in ((MOVING, layout.asset.moving), (STATIC, layout.asset.static)):
        points = surface.points[surface.labels == label]
        assert len(points) > 200
        true = np.concatenate(
            [sample_surface(mesh.vertices, mesh.faces, 60_000, rng)[0] for mesh in link.meshes]
        )
        distances, _ = cKDTree(apply(layout.T_world_object, true)).query(points)
        # Samples of the true surface are up to 5 mm apart; a pixel on an outline may miss by more.
        assert np.median(distances) < 0.0025
        assert np.percentile(distances, 95) < 0.006


def test_nothing_hidden_is_seen(scanned):
    layout, surface = scanned
    # The underside stands on its feet, the tray is in the closed body.
    height = (surface.points - layout.T_world_object[:3, 3])[:, 2]
    front = layout.asset.moving.bounds[0][1]
    place = apply(np.linalg.inv(layout.T_world_object), surface.points)
    assert height[surface.labels == STATIC].min() > -0.002
    assert np.median(place[surface.labels == MOVING, 1]) < front + 0.06


def test_gaussians_are_as_dense_as_asked(scanned):
    layout, surface = scanned
    gaussians = raw_gaussians(surface, layout.T_world_object[:3, 3], Upstream(), np.random.default_rng(2))
    assert len(gaussians) == len(surface.points)
    walls = surface.points[surface.labels == STATIC]
    nearest = cKDTree(walls).query(walls, k=2)[0][:, 1]
    assert 0.3 * SPACING_M[STATIC] < np.median(nearest) < 1.5 * SPACING_M[STATIC]
