"""Labels of all Gaussians: by prompts and masks, by the demonstration in turn, and smooth over neighbors."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians, concatenate, gaussians_of
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.parts import Parts, no_cut
from aomgen.core.progress import silent
from aomgen.core.recording import Prompt
from aomgen.core.transforms import apply, transform
from aomgen.errors import BackendError, MalformedFileError, WrongPromptError
from aomgen.io.artifact import load_artifact, save_artifact
from aomgen.io.images import read_labels, write_image
from aomgen.parts import label
from aomgen.parts.label import (
    PromptedScan,
    cut_scan,
    find_parts,
    segment_scan,
    smooth_posterior,
    weigh_evidence,
)
from aomgen.parts.likelihood import LABELS, PartEvidence
from aomgen.parts.prompted_images import segment_prompts
from aomgen.parts.scan_views import ScanView, label_robot, nearest_links
from aomgen.robots.robot import RobotConfiguration, RobotModel
from aomgen.robots.silhouette import SilhouetteRenderer
from aomgen.segmentation.interface import clean
from aomgen.segmentation.segmenter import MasksOnDisk, MobileSam, choose_segmenter
from aomgen.segmentation.weights import find_weights
from aomgen.splatting.rasterizer import render

JOINTS = np.array([0.3, -1.6, 1.9, -0.4, 1.2, 0.1])


@pytest.fixture(scope="module")
def configuration(robot: RobotModel) -> RobotConfiguration:
    return RobotConfiguration(robot=robot, joints=JOINTS, gripper=0.0)


def robot_points(
    configuration: RobotConfiguration, rng: np.random.Generator, count: int
) -> tuple[np.ndarray, np.ndarray]:
    poses = configuration.robot.link_poses(JOINTS[None], 0.0)[0]
    points, owners = [], []
    areas = np.array(
        [face_normals_areas(m.vertices_body, m.faces)[1].sum() for m in configuration.robot.meshes]
    )
    for mesh, share in zip(configuration.robot.meshes, areas / areas.sum(), strict=True):
        chosen, _, _ = sample_surface(mesh.vertices_body, mesh.faces, int(count * share) + 1, rng)
        points.append(apply(poses[mesh.body], chosen))
        owners.append(np.full(len(chosen), mesh.body))
    return np.concatenate(points), np.concatenate(owners)


def test_points_near_a_link_are_bound_to_it(configuration):
    rng = np.random.default_rng(0)
    points, owners = robot_points(configuration, rng, 2000)
    bodies, distances = nearest_links(points + rng.normal(0, 0.001, points.shape), configuration, rng)
    assert np.mean(bodies == owners) > 0.9
    assert np.quantile(distances, 0.95) < 0.006


def test_points_away_from_the_robot_are_bound_to_nothing(configuration):
    points, _ = robot_points(configuration, np.random.default_rng(1), 500)
    bodies, distances = nearest_links(points + [0, 0, 5.0], configuration, np.random.default_rng(1))
    assert np.all(bodies == -1)
    assert np.all(np.isinf(distances))


def grid_box(low: list[float], high: list[float], step: float) -> np.ndarray:
    axes = [np.arange(a, b + 1e-9, step) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    faces = np.any((np.abs(points - low) < 1e-9) | (np.abs(points - high) < step / 2), 1)
    return points[faces]


def toy_scene(configuration: RobotConfiguration) -> tuple[Gaussians, np.ndarray]:
    """A box with a colored door on a table, beside the robot, as round Gaussians."""
    rng = np.random.default_rng(2)
    body = grid_box([0.5, 0.6, 0.0], [0.8, 0.9, 0.25], 0.012)
    door = grid_box([0.5, 0.57, 0.0], [0.8, 0.588, 0.25], 0.009)
    table = grid_box([0.2, 0.3, -0.02], [1.1, 1.2, -0.02], 0.02)
    robot, _ = robot_points(configuration, rng, 14000)
    sets = [(body, STATIC, 0.4), (door, MOVING, 0.8), (table, BACKGROUND, 0.1), (robot, ROBOT, 0.6)]
    means = np.concatenate([points for points, _, _ in sets])
    labels = np.concatenate([np.full(len(points), value) for points, value, _ in sets])
    colors = np.concatenate([np.full((len(points), 1, 3), gray) for points, _, gray in sets])
    count = len(means)
    return Gaussians(
        means=means, quats=np.tile([1.0, 0, 0, 0], (count, 1)), scales=np.full((count, 3), 0.007),
        opacities=np.full(count, 0.9), sh=((colors - 0.5) / 0.2820948).astype(np.float32),
    ), labels  # fmt: skip


def toy_views(
    gaussians: Gaussians, labels: np.ndarray, configuration: RobotConfiguration, folder
) -> list[ScanView]:
    """Views with exact label images on disk."""
    views = []
    with SilhouetteRenderer(configuration.robot, max_width=320, max_height=240) as renderer:
        for index, angle in enumerate(np.linspace(-2.6, 0.2, 8)):
            eye = [0.65 + 1.5 * np.cos(angle), 0.7 + 1.5 * np.sin(angle), 0.9]
            camera = Camera(
                fx=280.0, fy=280.0, cx=160.0, cy=120.0, width=320, height=240,
                T_world_cam=look_at(eye, [0.6, 0.7, 0.1]),
            )  # fmt: skip
            rendering = render(gaussians, camera, with_ids=True)
            seen = np.where(rendering.alpha > 0.5, labels[rendering.max_id], 0).astype(np.uint8)
            write_image(folder / f"{index}.png", seen)
            bodies, _ = renderer.draw(camera, JOINTS, 0.0)
            image = (rendering.rgb * 255).astype(np.uint8)
            views.append(ScanView(name=f"{index}.jpg", camera=camera, image_srgb=image, robot=bodies >= 0))
    return views


def prompt(part: str, image: str) -> Prompt:
    return Prompt(part=part, image=image, points=np.zeros((0, 3)), box=np.array([10.0, 10, 300, 230]))


def tight_prompt(part: str, index: int, folder) -> Prompt:
    mask = read_labels(folder / f"{index}.png") == {"static": STATIC, "moving": MOVING}[part]
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64)
    return Prompt(part=part, image=f"{index}.jpg", points=np.zeros((0, 3)), box=box)


def segmented(gaussians, views, prompts, folder, configuration) -> PromptedScan:
    prompted = segment_prompts(views, prompts, MasksOnDisk(folders={"hand": folder}))
    bodies = label_robot(gaussians, views, configuration, np.random.default_rng(0))
    return segment_scan(gaussians, views, bodies, prompted)


def labelled(scan: PromptedScan) -> Parts:
    return find_parts(scan, weigh_evidence(scan))


@pytest.fixture(scope="module")
def known_scene(configuration, tmp_path_factory) -> tuple[Gaussians, np.ndarray, list[ScanView], Path]:
    """The toy scene with its labels, views and the folder of the label images; built once, read only."""
    folder = tmp_path_factory.mktemp("labels")
    gaussians, labels = toy_scene(configuration)
    return gaussians, labels, toy_views(gaussians, labels, configuration, folder), folder


@pytest.fixture(scope="module")
def boxed(known_scene, configuration) -> tuple[PromptedScan, PartEvidence]:
    """The toy scene with two boxes around each part, and the evidence of its labels; computed once."""
    gaussians, _, views, folder = known_scene
    prompts = tuple(tight_prompt(part, i, folder) for part in ("static", "moving") for i in (2, 4))
    scan = segmented(gaussians, views, prompts, folder, configuration)
    return scan, weigh_evidence(scan)


def test_labels_of_a_known_scene_are_recovered(known_scene, configuration):
    gaussians, labels, views, folder = known_scene
    prompts = tuple(prompt(part, f"{i}.jpg") for part in ("static", "moving") for i in (2, 4))
    parts = labelled(segmented(gaussians, views, prompts, folder, configuration))
    votes = np.zeros(len(gaussians))
    for view in views:
        ids = np.asarray(render(gaussians, view.camera, with_ids=True).max_id)
        votes[ids[ids >= 0]] = 1
    seen = votes > 0
    for value, least in ((ROBOT, 0.95), (STATIC, 0.97), (MOVING, 0.97), (BACKGROUND, 0.97)):
        assert np.mean(parts.labels[seen & (labels == value)] == value) > least, value
    assert np.all((parts.robot_bodies >= 0) == (parts.labels == ROBOT))


def test_what_shows_through_the_object_far_behind_it_is_not_the_object(known_scene, configuration):
    near, labels, views, folder = known_scene
    sky = near.select(np.flatnonzero(labels == STATIC)[:50]).transform(
        transform(np.eye(3), np.array([0.0, 860.0, 0.0]))
    )
    prompts = tuple(tight_prompt(part, 2, folder) for part in ("static", "moving"))
    scan = segmented(concatenate([near, sky]), views, prompts, folder, configuration)
    shown = np.concatenate([labels, np.full(len(sky), STATIC)])
    evidence = PartEvidence(log_likelihoods=np.log(0.02 + 0.96 * (shown[:, None] == LABELS)), method="boxes")
    parts = find_parts(scan, evidence)
    assert (parts.labels[len(near) :] == BACKGROUND).all()
    assert np.mean(parts.labels[: len(near)] == labels) > 0.97


def test_cut_parts_are_stored_with_their_pieces(known_scene, boxed, tmp_path):
    gaussians = known_scene[0]
    parts = find_parts(*cut_scan(*boxed, None))
    assert len(parts.cut.sources) > 0
    assert len(parts.labels) == len(parts.cut.apply(gaussians)) > len(gaussians)
    save_artifact(tmp_path, "parts", parts)
    stored = load_artifact(tmp_path, "parts", Parts).cut
    assert np.array_equal(stored.sources, parts.cut.sources)
    assert np.array_equal(stored.pieces.means, parts.cut.pieces.means)


def test_boxes_around_the_parts_give_a_panel(known_scene, boxed):
    gaussians, labels, views, _ = known_scene
    parts = find_parts(*boxed)
    assert parts.method == "boxes"
    assert parts.box_misfit < 0.1
    drawn = render(gaussians, views[3].camera, with_ids=True)
    ids = np.unique(np.asarray(drawn.max_id)[drawn.alpha > 0.5])
    for value, least in ((STATIC, 0.95), (MOVING, 0.95)):
        agreeing = (
            np.isin(ids, np.flatnonzero(labels == value)),
            np.isin(ids, np.flatnonzero(parts.labels == value)),
        )
        assert (agreeing[0] & agreeing[1]).sum() / (agreeing[0] | agreeing[1]).sum() > least, value


def test_parts_of_different_objects_are_refused(configuration, tmp_path):
    """The static prompts show a crate half a metre from the door."""
    gaussians, labels = toy_scene(configuration)
    crate = gaussians.means[labels == STATIC] + [0.55, 0.1, 0.0]
    both = Gaussians(
        means=np.concatenate([gaussians.means, crate]),
        quats=np.concatenate([gaussians.quats, gaussians.quats[: len(crate)]]),
        scales=np.concatenate([gaussians.scales, gaussians.scales[: len(crate)]]),
        opacities=np.concatenate([gaussians.opacities, gaussians.opacities[: len(crate)]]),
        sh=np.concatenate([gaussians.sh, np.full((len(crate), *gaussians.sh.shape[1:]), 0.5, np.float32)]),
    )
    wrong = np.concatenate([np.where(labels == STATIC, BACKGROUND, labels), np.full(len(crate), STATIC)])
    views = toy_views(both, wrong, configuration, tmp_path)
    shown = [k for k in range(8) if (read_labels(tmp_path / f"{k}.png") == STATIC).sum() > 500][:2]
    prompts = tuple(tight_prompt("static", k, tmp_path) for k in shown)
    prompts += tuple(tight_prompt("moving", k, tmp_path) for k in (2, 4))
    with pytest.raises(WrongPromptError, match=r"away from the moving part.*another object.*around the body"):
        labelled(segmented(both, views, prompts, tmp_path, configuration))


def nothing_found() -> Parts:
    nothing = gaussians_of(
        means=np.zeros((0, 3)), quats=np.zeros((0, 4)), scales=np.zeros((0, 3)), opacities=[], sh=np.zeros((0, 1, 3))
    )  # fmt: skip
    return Parts(
        labels=np.zeros(0, np.uint8), robot_bodies=np.zeros(0, np.int32),
        cut=no_cut(nothing), method="boxes", box_misfit=0.1, static_agreement=0.9, moving_agreement=0.9,
    )  # fmt: skip


def test_parts_that_miss_their_boxes_are_warned_about():
    found = replace(nothing_found(), box_misfit=0.4)
    assert found.warnings() == [
        "the edges of the fitted parts are 10 % of a box away from the prompted boxes, limit 5 %; draw boxes "
        "that touch each "
        "part on all four sides"
    ]
    assert replace(found, box_misfit=0.1).warnings() == []


def test_doubtful_labels_are_warned_about():
    found = replace(nothing_found(), moving_agreement=0.55)
    (sentence,) = found.warnings()
    assert (
        "labels of the moving part are doubtful: they overlap with its masks by 55 %, at least 60 %"
        in sentence
    )


def test_clean_keeps_the_largest_piece_and_fills_its_holes():
    mask = np.zeros((60, 60), bool)
    mask[10:40, 10:40] = True
    mask[20:26, 20:26] = False
    mask[50:54, 50:54] = True
    tidy = clean(mask)
    assert tidy[22, 22]
    assert not tidy[52, 52]


def test_label_images_of_another_size_are_refused(tmp_path):
    write_image(tmp_path / "a.png", np.zeros((10, 10), np.uint8))
    with pytest.raises(MalformedFileError, match="10"):
        MasksOnDisk(folders={"hand": tmp_path}).prepare("a.jpg", np.zeros((20, 20, 3), np.uint8))


def test_missing_or_foreign_weights_name_the_command(tmp_path, monkeypatch):
    monkeypatch.setenv("AOMGEN_WEIGHTS", str(tmp_path))
    with pytest.raises(BackendError, match=r"python -m aomgen\.segmentation\.weights"):
        choose_segmenter({})
    for name in ("encoder.onnx", "sam.onnx"):
        (tmp_path / name).write_bytes(b"something else")
    with pytest.raises(BackendError, match="not the published file"):
        find_weights()


def test_mobile_sam_masks_a_disc_from_a_box():
    try:
        find_weights()
    except BackendError as error:
        pytest.skip(str(error))
    v, u = np.mgrid[:180, :240]
    disc = (u - 130) ** 2 + (v - 90) ** 2 < 40**2
    image = np.where(disc[..., None], [200, 90, 40], [70, 110, 120]).astype(np.uint8)
    prepared = MobileSam().prepare("disc.jpg", image)
    mask = prepared.mask("static", [90, 50, 170, 130], np.zeros((0, 3)))
    assert (mask & disc).sum() / (mask | disc).sum() > 0.9


PROMPTED = np.repeat(np.array([BACKGROUND, STATIC, MOVING], np.uint8), 100)


@dataclass
class Labels:
    labels: np.ndarray


@dataclass
class Scan:
    gaussians: None = None


@pytest.fixture
def world(monkeypatch):
    """Labels follow the log odds where there are some; `world.odds` is what the demonstration shows."""

    class World:
        odds: list[np.ndarray | None]
        rounds = 0

        def shown(self, scene, labels):
            self.rounds += 1
            return self.odds[min(self.rounds, len(self.odds)) - 1]

    made = World()

    def labelled(scan, log_odds):
        if log_odds is None:
            return Labels(PROMPTED)
        return Labels(
            np.where(log_odds > 1, MOVING, np.where(log_odds < -1, STATIC, PROMPTED)).astype(np.uint8)
        )

    # Evidence is what the demonstration showed.
    monkeypatch.setattr(label, "weigh_evidence", lambda scan, log_ratios=None: log_ratios)
    monkeypatch.setattr(label, "cut_scan", lambda scan, evidence, log_ratios: (scan, evidence))
    monkeypatch.setattr(label, "find_parts", labelled)
    return made


def found(world) -> np.ndarray:
    return label.find_moving_parts(Scan(), world.shown, silent).labels  # type: ignore[arg-type]


def test_a_demonstration_that_agrees_is_asked_once(world):
    world.odds = [np.zeros(300)]
    assert np.array_equal(found(world), PROMPTED)
    assert world.rounds == 1


def test_a_handle_that_was_left_out_is_taken_in_and_asked_again(world):
    odds = np.zeros(300)
    odds[180:200] = 3.0
    world.odds = [odds]
    assert np.sum(found(world) == MOVING) == 120
    assert world.rounds == 2


def test_a_part_that_stands_still_stays_as_prompted(world):
    """Whether it moved at all is for the motion stage to say, of labels that the prompts gave."""
    odds = np.zeros(300)
    odds[200:290] = -3.0
    world.odds = [odds]
    assert np.array_equal(found(world), PROMPTED)


def test_labels_that_never_settle_end_all_the_same(world):
    first, second = np.zeros(300), np.zeros(300)
    first[150:200] = 3.0
    world.odds = [first, second, first, second]
    found(world)
    assert world.rounds == label.MAX_ROUNDS


def test_a_demonstration_without_motion_leaves_the_labels(world):
    world.odds = [None]
    assert np.array_equal(found(world), PROMPTED)
    assert world.rounds == 1


GRID = np.stack(np.meshgrid(np.arange(20), np.arange(20), [0.0], indexing="ij"), -1).reshape(-1, 3) * 0.005
LEFT = GRID[:, 0] < 0.05
GRAY = np.full((len(GRID), 3), 0.5)


def test_points_without_evidence_take_the_label_around_them():
    evidence = np.where(LEFT[:, None], [2.0, 0.0], [0.0, 2.0])
    unknown = np.random.default_rng(0).random(len(GRID)) < 0.5
    evidence[unknown] = 0.0
    found = np.argmax(smooth_posterior(GRID, GRAY, evidence), 1)
    assert np.mean(found == np.where(LEFT, 0, 1)) > 0.95


def test_single_points_that_err_are_outvoted_and_sure_ones_are_not():
    evidence = np.tile([1.0, 0.0], (len(GRID), 1))
    evidence[210] = [0.0, 0.5]
    evidence[50] = [0.0, 20.0]
    found = np.argmax(smooth_posterior(GRID, GRAY, evidence), 1)
    assert found[210] == 0
    assert found[50] == 1


def test_an_edge_in_color_parts_labels():
    """Evidence at two columns only: with an edge in color between, labels end there."""
    evidence = np.zeros((len(GRID), 2))
    evidence[GRID[:, 0] < 0.052] = [6.0, 0.0]
    evidence[GRID[:, 0] > 0.083] = [0.0, 6.0]
    edge = np.where((GRID[:, 0] < 0.067)[:, None], 0.1, 0.9) * np.ones(3)
    found = np.argmax(smooth_posterior(GRID, edge, evidence), 1)
    assert np.mean(found == np.where(GRID[:, 0] < 0.067, 0, 1)) > 0.95


def test_posteriors_are_probabilities_whatever_the_order_of_points():
    rng = np.random.default_rng(1)
    evidence = rng.normal(size=(len(GRID), 3))
    posterior = smooth_posterior(GRID + rng.normal(0, 1e-4, GRID.shape), GRAY, evidence)
    assert np.allclose(posterior.sum(1), 1)
    points = GRID + rng.normal(0, 1e-4, GRID.shape)
    order = rng.permutation(len(GRID))
    first, second = (smooth_posterior(points[k], GRAY, evidence[k]) for k in (np.arange(len(GRID)), order))
    assert np.allclose(first[order], second)


def test_one_point_has_no_neighbors():
    assert np.argmax(smooth_posterior(np.zeros((1, 3)), np.zeros((1, 3)), np.array([[0.0, 1.0]]))) == 1
