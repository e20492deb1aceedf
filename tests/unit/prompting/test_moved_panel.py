import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.transforms import apply, matrix_from_rotvec
from aomgen.errors import NoMotionError, ReconstructionError
from aomgen.io.images import fill_hull
from aomgen.parts.scan_views import ScanView
from aomgen.prompting import moved_panel, panel_edges
from aomgen.prompting.moved_panel import (
    STEPS,
    Front,
    Grip,
    RegionAgreement,
    improve,
    place_corners,
)
from aomgen.prompting.object_body import find_body, find_object_points, make_body
from aomgen.prompting.panel_edges import refine_front
from aomgen.prompting.view_choice import choose_apart, choose_front_views

# A gripper at 0.6 m that approaches along +x; the front is 4 cm behind the grasp, its hinge on the left.
FIRST = np.array([[0.0, 0.0, 1.0, 0.6], [0.0, 1.0, 0.0, 0.1], [-1.0, 0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
TRUE = np.array([0.28, 0.03, 0.1, 0.15, 0.04, 0.05, 0.0])


def camera(eye, target=(0.65, 0.0, 0.3)) -> Camera:
    return Camera(fx=500, fy=500, cx=320, cy=240, width=640, height=480, T_world_cam=look_at(eye, target))


def pulled(metres: float) -> Grip:
    last = FIRST.copy()
    last[0, 3] -= metres
    return Grip(T_world_first=FIRST, T_world_last=last)


def swung(grip: Grip) -> Grip:
    """The grip after the front has turned by 60 degrees about its left side."""
    hinge = place_corners(grip, TRUE)[0]
    turn = np.eye(4)
    turn[:3, :3] = matrix_from_rotvec([0, 0, np.radians(60)])
    turn[:3, 3] = hinge - turn[:3, :3] @ hinge
    return Grip(T_world_first=FIRST, T_world_last=turn @ FIRST)


def region_of(grip: Grip, seen_by: Camera, *, swept: bool) -> np.ndarray:
    corners = place_corners(grip, TRUE)
    placed = apply(grip.carry(0.0), corners)
    pixels = seen_by.project(np.concatenate([placed, corners]) if swept else placed)[0]
    return fill_hull(pixels, seen_by.width, seen_by.height)


def view(name: str, seen_by: Camera, image=None, robot=None) -> ScanView:
    shape = (seen_by.height, seen_by.width)
    return ScanView(
        name=name,
        camera=seen_by,
        image_srgb=np.zeros((*shape, 3), np.uint8) if image is None else image,
        robot=np.zeros(shape, bool) if robot is None else robot,
    )


@pytest.mark.parametrize(("grip", "model"), [(swung(pulled(0.0)), "carried"), (pulled(0.2), "swept")])
def test_a_front_is_recovered_from_the_region_to_which_it_has_come(grip, model):
    side = camera((0.0, -0.9, 0.9))
    region = region_of(grip, side, swept=model == "swept")
    agreement = RegionAgreement(region, np.zeros_like(region), side, grip)
    assert agreement.measure(TRUE, model) > 0.97
    start = TRUE + [0.05, -0.02, 0.04, -0.05, 0.0, 0.0, 0.0]
    assert agreement.score(start, model) < agreement.score(TRUE, model) - 0.1
    score, found = improve(lambda x: agreement.score(x, model), start[None], STEPS)
    assert score > 0.93
    error = np.linalg.norm(place_corners(grip, found) - place_corners(grip, TRUE), axis=1)
    assert error.max() < 0.06


def test_corners_are_in_order_and_the_third_axis_enters_the_object():
    front = Front(corners_world=place_corners(pulled(0.1), TRUE), confidence=1.0)
    along, up, inwards = front.axes
    assert up @ [0, 0, 1] == pytest.approx(1)
    assert inwards @ FIRST[:3, 2] > 0.99
    assert along @ np.cross(inwards, up) == pytest.approx(1)
    assert (front.handle_space[4:] - front.corners_world) @ inwards == pytest.approx(-0.06)


def test_a_front_is_moved_to_its_edges_in_the_scan(monkeypatch):
    monkeypatch.setattr(panel_edges, "DRAWS", 1000)
    monkeypatch.setattr(moved_panel, "STARTS", 2)
    grip, side = pulled(0.2), camera((0.0, -0.9, 0.9))
    agreement = RegionAgreement(region_of(grip, side, swept=True), np.zeros((480, 640), bool), side, grip)
    views = []
    for number, y in enumerate((-0.5, 0.0, 0.5)):
        seen_by = camera((-0.5, y, 0.6))
        image = np.full((480, 640, 3), 200, np.uint8)
        image[fill_hull(seen_by.project(place_corners(grip, TRUE))[0], 640, 480)] = 60
        views.append(view(f"{number}.jpg", seen_by, image))
    behind = view("behind.jpg", camera((1.8, 0.0, 0.6)))
    hidden = view("hidden.jpg", camera((-0.4, 0.0, 0.6)), robot=np.ones((480, 640), bool))
    start = TRUE + [0.015, 0.01, -0.01, 0.015, 0.0, 0.0, 0.0]
    front = refine_front(start, "swept", agreement, [*views, behind, hidden], np.random.default_rng(0))
    error = np.linalg.norm(front.corners_world - place_corners(grip, TRUE), axis=1)
    assert error.max() < 0.008
    assert front.confidence > 0.7
    assert {item.name for item in choose_front_views([*views, behind, hidden], front)} == {
        "0.jpg",
        "1.jpg",
        "2.jpg",
    }
    with pytest.raises(ReconstructionError, match="no scan image shows the moving part"):
        refine_front(start, "swept", agreement, [behind, hidden], np.random.default_rng(0))


class Outlines:
    """A segmenter that segments the same body whatever box it is asked for, if the box reaches it."""

    def __init__(self, body: np.ndarray, cameras: dict[str, Camera]) -> None:
        self.masks = {name: fill_hull(item.project(body)[0], 640, 480) for name, item in cameras.items()}

    def prepare(self, name, image_srgb):
        outline = self.masks[name]

        class Prepared:
            def mask(self, part, box_px, points):
                x0, y0, x1, y1 = np.asarray(box_px, int)
                inside = np.zeros_like(outline)
                inside[y0:y1, x0:x1] = True
                return outline & inside

            def at_points(self, points_px):
                raise AssertionError("a box is asked for")

        return Prepared()


def test_the_body_stands_on_its_support_and_gets_its_depth_from_segments():
    rng = np.random.default_rng(0)
    front = Front(corners_world=place_corners(pulled(0.1), TRUE), confidence=1.0)
    true = make_body(front.corners_world, 0.12, front, 0.3)
    # Points on the body's edges, on the table, and on another object 15 cm behind it.
    steps = np.linspace(0, 1, 12)[:, None]
    body = np.concatenate(
        [true[i] + steps * (true[j] - true[i]) for i, j in ((0, 1), (2, 3), (0, 4), (1, 5), (5, 7), (4, 6))]
    )
    body = body[body[:, 2] > 0.15]
    table = np.column_stack(
        [rng.uniform(0.2, 1.4, 400), rng.uniform(-0.5, 0.5, 400), rng.normal(0.12, 0.002, 400)]
    )
    other = true[:, :] * [1, 1, 0.3] + [0.6, 0, 0.15]
    own, support_z = find_object_points(np.concatenate([body, table, other]), front, rng)
    assert support_z == pytest.approx(0.12, abs=0.005)
    assert own[:, 0].max() < true[:, 0].max() + 0.02
    cameras = {
        "left.jpg": camera((0.9, -1.2, 0.8), (0.8, 0, 0.25)),
        "right.jpg": camera((0.9, 1.2, 0.8), (0.8, 0, 0.25)),
        "front.jpg": camera((-0.6, 0.0, 0.5), (0.8, 0, 0.25)),
    }
    views = [view(name, item) for name, item in cameras.items()]
    found = find_body(own, support_z, front, views, Outlines(true, cameras))
    assert {shown.name for shown, _, _ in found} == {"left.jpg", "right.jpg"}
    assert min(agreement for _, _, agreement in found) > 0.85
    with pytest.raises(ReconstructionError, match="no scan image shows the whole object"):
        find_body(own, support_z, front, [views[2]], Outlines(true, cameras))
    with pytest.raises(ReconstructionError, match="0 points of the scan are below"):
        find_object_points(body[body[:, 2] > 0.3], front, rng)


def test_views_from_different_sides_are_chosen_as_far_as_there_are_any():
    near = [view(f"{k}.jpg", camera((-0.5, 0.1 * k, 0.6))) for k in range(3)]
    far = view("far.jpg", camera((0.6, -1.0, 0.6)))
    target = np.array([0.65, 0.0, 0.3])
    assert [item.name for item in choose_apart([*near, far], target, 2, 30.0)] == ["0.jpg", "far.jpg"]
    assert len(choose_apart(near, target, 2, 30.0)) == 2
    assert choose_apart([], target, 2, 30.0) == []


def test_a_region_that_no_front_explains_is_refused(monkeypatch):
    monkeypatch.setattr(moved_panel, "DRAWS", 40)
    monkeypatch.setattr(moved_panel, "STARTS", 1)
    side, region = camera((0.0, -0.9, 0.9)), np.zeros((480, 640), bool)
    region[40:60, 20:600] = True
    agreement = RegionAgreement(region, np.zeros_like(region), side, pulled(0.2))
    with pytest.raises(NoMotionError, match="no flat front"):
        moved_panel.fit_region(agreement, np.random.default_rng(0))
