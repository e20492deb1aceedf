"""A filmed drawer whose tray no scan has seen: it is found from the film, or left out."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.appearance.drawer_interior import add_drawer_interior
from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.core.joint import Joint
from aomgen.core.transforms import apply, transform
from aomgen.lighting.shadowed_twin import render_state
from aomgen.robots.robot import RobotModel
from aomgen.twin.binding import bind
from aomgen.twin.twin import PosedImages, TwinModel, TwinState

TRAVEL = 0.2
CAMERA = Camera(
    fx=300.0, fy=300.0, cx=160.0, cy=120.0, width=320, height=240,
    T_world_cam=look_at([0.25, -0.7, 0.95], [0.63, 0.25, 0.12]),
)  # fmt: skip
# Cabinet: the front is at y = 0.3 and opens towards -y; its tray lies behind it.
FRONT = ([0.5, 0.285, 0.06], [0.8, 0.3, 0.24])


def box(low: list[float], high: list[float], color: list[float], step: float = 0.007) -> Gaussians:
    """Round Gaussians on the faces of a box; flat boxes are sheets."""
    axes = [np.linspace(a, b, max(2, round((b - a) / step) + 1)) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    on_face = np.any((np.abs(points - low) < 1e-9) | (np.abs(points - high) < 1e-9), axis=1)
    points = np.unique(points[on_face].round(6), axis=0)
    count = len(points)
    return gaussians_of(
        means=points.astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.6 * step, np.float32),
        opacities=np.full(count, 0.95, np.float32),
        sh=np.tile(((np.array(color) - 0.5) / SH_C0).astype(np.float32), (count, 1, 1)),
    )


def tray() -> Gaussians:
    low, high = [0.51, 0.3, 0.07], [0.79, 0.5, 0.17]
    return concatenate(
        [
            box(low, [low[0], high[1], high[2]], [0.9, 0.8, 0.2]),
            box([high[0], low[1], low[2]], high, [0.9, 0.8, 0.2]),
            box(low, [high[0], high[1], low[2]], [0.2, 0.7, 0.3]),
        ]
    )


def cabinet(robot: RobotModel, moving: list[Gaussians], joint: Joint) -> TwinModel:
    body = [
        box([0.48, 0.3, 0.25], [0.82, 0.6, 0.27], [0.5, 0.3, 0.2]),
        box([0.48, 0.3, 0.0], [0.49, 0.6, 0.25], [0.5, 0.3, 0.2]),
        box([0.81, 0.3, 0.0], [0.82, 0.6, 0.25], [0.5, 0.3, 0.2]),
        box([0.48, 0.3, 0.0], [0.82, 0.6, 0.05], [0.5, 0.3, 0.2]),
    ]
    table = box([0.1, -0.4, -0.01], [1.2, 0.8, -0.01], [0.55, 0.55, 0.6], 0.015)
    pieces = [(table, BACKGROUND), *((piece, STATIC) for piece in body), *((m, MOVING) for m in moving)]
    labels = np.concatenate([np.full(len(piece), value, np.uint8) for piece, value in pieces])
    state = TwinState(
        joints=np.zeros(6), gripper=0.0, theta=0.0, T_world_object=transform(np.eye(3), [0.65, 0.45, 0.0])
    )
    return bind(
        concatenate([piece for piece, _ in pieces]),
        labels, np.full(len(labels), -1, np.int32), robot, joint, state,
    )  # fmt: skip


def slide() -> Joint:
    return Joint(
        type="prismatic",
        axis=np.array([0.0, -1, 0]),
        origin=np.array([0.65, 0.3, 0.1]),
        lower=0,
        upper=TRAVEL,
    )


def make_images(twin: TwinModel, robot: RobotModel) -> PosedImages:
    thetas = [0.0, 0.0, *np.linspace(0, TRAVEL, 9)]
    states = tuple(replace(twin.scan_state, theta=float(theta)) for theta in thetas)
    images = [np.clip(render_state(twin, robot, state, CAMERA).rgb, 0, 1) for state in states]
    return PosedImages(
        camera=CAMERA, images_srgb=tuple((255 * image).astype(np.uint8) for image in images), states=states
    )


def test_a_hidden_tray_is_found_in_the_film(robot):
    front = box(*FRONT, [0.7, 0.2, 0.2])
    view = make_images(cabinet(robot, [front, tray()], slide()), robot)
    scanned = cabinet(robot, [front], slide())
    found = add_drawer_interior(scanned, robot, view)
    count = len(scanned.gaussians)
    added = found.gaussians.select(np.arange(len(found.gaussians)) >= count)
    assert len(added) > 500
    assert np.array_equal(found.gaussians.means[:count], scanned.gaussians.means)
    assert np.all(found.labels[count:] == MOVING)
    assert np.all(found.bodies[count:] == found.body("part"))
    places = apply(scanned.T_world_object, np.asarray(added.means, np.float64))
    assert np.all((places > [0.49, 0.28, 0.05]) & (places < [0.81, 0.51, 0.24]))
    opened = view.states[-1]
    before, after = (
        np.square(np.clip(render_state(twin, robot, opened, CAMERA).rgb, 0, 1) - view.images_srgb[-1] / 255.0)
        for twin in (scanned, found)
    )
    assert after.mean() < 0.35 * before.mean()


def test_a_closed_drawer_looks_as_before(robot):
    front = box(*FRONT, [0.7, 0.2, 0.2])
    scanned = cabinet(robot, [front], slide())
    found = add_drawer_interior(scanned, robot, make_images(cabinet(robot, [front, tray()], slide()), robot))
    one, two = (render_state(twin, robot, scanned.scan_state, CAMERA).rgb for twin in (scanned, found))
    assert np.mean(np.abs(one - two).max(-1) > 0.05) < 0.002


def test_a_front_without_a_tray_gets_none(robot):
    scanned = cabinet(robot, [box(*FRONT, [0.7, 0.2, 0.2])], slide())
    assert add_drawer_interior(scanned, robot, make_images(scanned, robot)) is scanned


def test_doors_get_no_tray(robot):
    hinge = Joint(
        type="revolute", axis=np.array([0.0, 0, 1]), origin=np.array([0.5, 0.3, 0.1]), lower=0, upper=TRAVEL
    )
    twin = cabinet(robot, [box(*FRONT, [0.7, 0.2, 0.2])], hinge)
    assert add_drawer_interior(twin, robot, make_images(twin, robot)) is twin


def sliding(axis: list[float]) -> Joint:
    return replace(slide(), axis=np.array(axis, np.float64))


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [-1.0, 0, 0]])
def test_a_panel_that_slides_along_its_body_gets_no_tray(robot, axis):
    """What it uncovers would look like a tray that it takes along."""
    panel = box([0.5, 0.285, 0.06], [0.65, 0.3, 0.24], [0.7, 0.2, 0.2])
    scanned = cabinet(robot, [panel], sliding(axis))
    assert (
        add_drawer_interior(
            scanned, robot, make_images(cabinet(robot, [panel, tray()], sliding(axis)), robot)
        )
        is scanned
    )


def test_a_drawer_that_closes_gets_no_tray(robot):
    """The tray that the scan saw lies before the body, not behind where the front goes."""
    front = box([0.5, 0.085, 0.06], [0.8, 0.1, 0.24], [0.7, 0.2, 0.2])
    scanned = cabinet(robot, [front], sliding([0.0, 1, 0]))
    with_it = cabinet(robot, [front, tray()], sliding([0.0, 1, 0]))
    assert add_drawer_interior(scanned, robot, make_images(with_it, robot)) is scanned


def test_a_film_that_never_shows_it_open_gives_no_tray(robot):
    front = box(*FRONT, [0.7, 0.2, 0.2])
    view = make_images(cabinet(robot, [front, tray()], slide()), robot)
    scanned = cabinet(robot, [front], slide())
    short = replace(view, images_srgb=view.images_srgb[:2], states=view.states[:2])
    assert add_drawer_interior(scanned, robot, short) is scanned
