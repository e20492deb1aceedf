"""Automatic masks, affinity features and their queries on scenes with known answers."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from aomgen.conventions import MOVING, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import silent
from aomgen.core.recording import Prompt
from aomgen.errors import MalformedFileError, ReconstructionError
from aomgen.io.artifact import npz_bytes
from aomgen.io.reuse import StoredFileWarning
from aomgen.paper.affinity_features import (
    AffinityParams,
    gate_features,
    mask_size,
    measure_masks,
    pair_evidence,
    relative_sizes,
    train_affinity,
)
from aomgen.paper.affinity_parts import (
    affinity_evidence,
    best_masks,
    best_threshold,
    grid_points,
    load_masks,
    query_part,
    save_masks,
    segment_views,
    spread_views,
)
from aomgen.parts.label import smooth_posterior
from aomgen.parts.prompted_images import PromptedImage, segment_prompts
from aomgen.parts.scan_views import ScanView
from aomgen.segmentation.interface import PointMasks, masks_of_logits, wrap_masks
from aomgen.splatting.rasterizer import render

TRAINING = AffinityParams(views=6, channels=8, iterations=40, pixels=200, width=96)

# The scene below is drawn in units of this, [m], so that its Gaussians touch on the grid of `pieces`.
SCALE = 0.3


def block(low, high, gray, step=0.04):
    axes = [np.arange(a, b, step) + step / 2 for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return points, np.full((len(points), 1, 3), gray)


def scene():
    """A body with a lid on it (together the object) and a block beside it: labels 1, 2 and 0."""
    sets = [
        (*block([-0.3, -0.2, 0], [0.3, 0.2, 0.24], 0.3), 1),
        (*block([-0.3, -0.2, 0.24], [0.3, 0.2, 0.4], 0.9), 2),
        (*block([0.5, -0.2, 0], [0.8, 0.2, 0.3], 0.6), 0),
    ]
    means = np.concatenate([points for points, _, _ in sets])
    colors = np.concatenate([color for _, color, _ in sets])
    labels = np.concatenate([np.full(len(points), value) for points, _, value in sets])
    count = len(means)
    return Gaussians(
        means=(SCALE * means).astype(np.float32), quats=np.tile([1.0, 0, 0, 0], (count, 1)).astype(np.float32),
        scales=np.full((count, 3), SCALE * 0.022, np.float32), opacities=np.full(count, 0.95, np.float32),
        sh=((colors - 0.5) / 0.2820948).astype(np.float32),
    ), labels  # fmt: skip


def scan_views(gaussians):
    views = []
    for index, angle in enumerate(np.linspace(0, 2 * np.pi, 6, endpoint=False)):
        eye = [0.2 + 1.8 * np.cos(angle), 1.8 * np.sin(angle), 1.3]
        camera = Camera(
            fx=130.0, fy=130.0, cx=64.0, cy=48.0, width=128, height=96, T_world_cam=look_at(SCALE * np.array(eye), SCALE * np.array([0.2, 0, 0.1]))
        )  # fmt: skip
        image = (render(gaussians, camera).rgb * 255).astype(np.uint8)
        views.append(
            ScanView(name=f"{index}.jpg", camera=camera, image_srgb=image, robot=np.zeros((96, 128), bool))
        )
    return views


def true_masks(gaussians, labels, camera):
    drawn = render(gaussians, camera, with_ids=True)
    seen = np.where(drawn.alpha > 0.5, labels[drawn.max_id], -1)
    return np.stack([seen >= 1, seen == 2, seen == 1, seen == 0])


class TrueSegmenter:
    """Answers from the known labels; a point gets the smallest thing under it and what that is part of."""

    def __init__(self, gaussians, labels, views):
        self._masks = {view.name: true_masks(gaussians, labels, view.camera) for view in views}
        self.prepared = []

    def prepare(self, name, image_srgb):
        self.prepared.append(name)
        whole, lid, body, beside = self._masks[name]

        class Image:
            def mask(self, part, box_px, points):
                return lid if part == "moving" else whole

            def at_points(self, points_px):
                columns, rows = np.floor(np.asarray(points_px)).astype(int).T
                hit = [
                    m
                    for r, c in zip(rows, columns, strict=True)
                    for m in (whole, lid, body, beside)
                    if m[r, c]
                ]
                return wrap_masks(hit, whole.shape)

        return Image()


def prompts(gaussians, labels, camera):
    """Boxes that touch what the segmenter answers with."""
    whole, lid, _, _ = true_masks(gaussians, labels, camera)
    found = []
    for part, mask in (("static", whole), ("moving", lid)):
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        box = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64)
        found.append(Prompt(part=part, image="1.jpg", points=np.zeros((0, 3)), box=box))
    return tuple(found)


def scanned(gaussians, labels, folder, progress=silent):
    """A segmented scan, answers to its prompts and the segmenter, which counts what it prepares."""
    views = scan_views(gaussians)
    segmenter = TrueSegmenter(gaussians, labels, views)
    prompted = segment_prompts(views, prompts(gaussians, labels, views[1].camera), segmenter)
    masks = segment_views(gaussians, views, prompted, segmenter, progress, TRAINING.views, folder)
    return views, masks, prompted, segmenter


@pytest.mark.slow
def test_parts_of_a_known_scene_are_found():
    gaussians, labels = scene()
    views, masks, prompted, _ = scanned(gaussians, labels, None)
    rng = np.random.default_rng(0)
    found = affinity_evidence(gaussians, views, masks, prompted, silent, TRAINING, rng)
    colors = np.clip(0.5 + 0.2820948 * gaussians.sh[:, 0], 0, 1)
    posterior = smooth_posterior(gaussians.means, colors, found.log_likelihoods)
    parts = np.array([0, STATIC, MOVING])[np.argmax(posterior, 1)]
    seen = np.zeros(len(gaussians), bool)
    for view in views:
        ids = np.asarray(render(gaussians, view.camera, with_ids=True).max_id)
        seen[ids[ids >= 0]] = True
    assert np.mean(parts[seen] == np.array([0, STATIC, MOVING])[labels[seen]]) > 0.95
    assert found.method == "saga"


def test_a_scan_that_was_cut_short_goes_on_where_it_was(tmp_path):
    gaussians, labels = scene()

    def stop(share, text):
        if share > 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scanned(gaussians, labels, tmp_path, stop)
    first = {path.stem for path in tmp_path.iterdir()}
    views, masks, _, again = scanned(gaussians, labels, tmp_path)
    assert len(first) == 3
    # The prompted image is always prepared, its prompts are asked anew.
    assert {name[:-4] for name in again.prepared} & first == {"1"}
    assert np.array_equal(masks["1.jpg"][1], true_masks(gaussians, labels, views[1].camera)[1])
    *_, last = scanned(gaussians, labels, tmp_path)
    assert last.prepared == ["1.jpg"]
    damaged = max(path for path in tmp_path.iterdir() if path.stem != "1")
    intact = damaged.read_bytes()
    damaged.write_bytes(intact[: len(intact) // 2])
    with pytest.warns(StoredFileWarning, match=f"{damaged.name}.*computed again") as warned:
        *_, repaired = scanned(gaussians, labels, tmp_path)
    assert len(warned) == 1
    assert set(repaired.prepared) == {"1.jpg", f"{damaged.stem}.jpg"}
    assert damaged.read_bytes() == intact


def test_training_needs_two_masks():
    gaussians, labels = scene()
    view = scan_views(gaussians)[0]
    one = measure_masks(gaussians, view.camera, true_masks(gaussians, labels, view.camera)[:1], 96)
    with pytest.raises(ReconstructionError, match="1 masks were found, expected 2"):
        train_affinity(gaussians, [one], silent, TRAINING, np.random.default_rng(0))


def test_the_same_seed_gives_the_same_features():
    gaussians, labels = scene()
    view = scan_views(gaussians)[0]
    sized = measure_masks(gaussians, view.camera, true_masks(gaussians, labels, view.camera), 96)
    params = replace(TRAINING, iterations=3)
    runs = [train_affinity(gaussians, [sized], silent, params, np.random.default_rng(0)) for _ in range(2)]
    assert np.array_equal(runs[0](0.1), runs[1](0.1))


def test_masks_are_as_large_as_what_they_show_from_near_and_far():
    gaussians, labels = scene()
    sizes = []
    for distance in (1.5, 3.0):
        camera = Camera(
            fx=200.0, fy=200.0, cx=80.0, cy=60.0, width=160, height=120,
            T_world_cam=look_at([0.0, -SCALE * distance, 0.05], [0, 0, 0.05]),
        )  # fmt: skip
        sizes.append(
            measure_masks(gaussians, camera, true_masks(gaussians, labels, camera)[:1], 160).sizes_m[0]
        )
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)


def test_what_shines_through_from_far_behind_hardly_changes_the_size():
    gaussians, labels = scene()
    camera = scan_views(gaussians)[0].camera
    mask = true_masks(gaussians, labels, camera)[:1]
    size = measure_masks(gaussians, camera, mask, 96).sizes_m[0]
    # The block before a far wall, and a third less solid.
    ray = camera.T_world_cam[:3, 2]
    far = np.stack(np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-3, 3, 40)), -1).reshape(-1, 2)
    wall = camera.center + 3 * ray + far @ camera.T_world_cam[:3, :2].T
    both = Gaussians(
        means=np.concatenate([gaussians.means, wall]).astype(np.float32),
        quats=np.tile([1.0, 0, 0, 0], (len(gaussians) + len(wall), 1)).astype(np.float32),
        scales=np.concatenate([gaussians.scales, np.full((len(wall), 3), 0.1)]).astype(np.float32),
        opacities=np.concatenate([0.3 * gaussians.opacities, np.full(len(wall), 0.95)]).astype(np.float32),
        sh=np.concatenate([gaussians.sh, np.zeros((len(wall), 1, 3))]).astype(np.float32),
    )
    assert measure_masks(both, camera, mask, 96).sizes_m[0] == pytest.approx(size, rel=0.25)


def test_a_rim_of_background_hardly_changes_the_size():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.1, 0.1, (1000, 3))
    rim = points.copy()
    rim[:30, 2] += 5
    assert mask_size(rim) == pytest.approx(mask_size(points), rel=0.1)


@pytest.mark.parametrize("factor", [0.01, 3.0, 50.0])
def test_relative_sizes_do_not_depend_on_the_scenes_extent(factor):
    known = np.array([0.1, 0.2, 0.5, 0.5, 2.0])
    asked = np.array([0.05, 0.15, 0.5, 1.0, 9.0])
    assert np.allclose(relative_sizes(asked, known), relative_sizes(factor * asked, factor * known))


def test_pairs_at_a_size():
    # Pixels: 0 window, 1 frame, 2 body, 3 beside. Masks: window, door, object.
    masks = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 0]], bool)
    sizes = np.array([0.1, 0.2, 0.5])
    together, apart, perhaps = pair_evidence(masks, sizes, 0.2)
    assert together[0, 1]
    assert apart[0, 2]
    assert apart[1, 2]
    assert not perhaps.any() or not perhaps[0, 2]
    together, apart, _ = pair_evidence(masks, sizes, 0.5)
    assert together[0, 2]
    assert apart[2, 3]
    # Without a mask of the door, window and frame perhaps belong together at the door's size.
    together, apart, perhaps = pair_evidence(masks[[0, 2]], sizes[[0, 2]], 0.2)
    assert perhaps[0, 1]
    assert not apart[0, 1]
    for item in (together, apart, perhaps):
        assert np.array_equal(item, item.T)
    assert not (together & apart).any()
    assert not (perhaps & (together | apart)).any()


def test_the_cut_lies_between_thing_and_rest():
    similarities = np.array([0.95, 0.9, 0.92, 0.1, 0.2, -0.3], np.float32)
    inside = np.array([1.0, 1, 1, 0, 0, 0])
    cut, iou = best_threshold(similarities, inside, 1 - inside)
    assert iou == pytest.approx(1)
    assert 0.2 < cut < 0.95


def test_a_part_is_told_from_the_rest_of_its_thing():
    gaussians, labels = scene()
    rng = np.random.default_rng(0)
    # What the features of the object have in common, what tells lid from body, and what says nothing.
    features = np.stack(
        [np.ones(len(labels)), np.where(labels == 2, 0.3, -0.3), rng.normal(size=len(labels))], 1
    ).astype(np.float32)
    features_at = partial(gate_features, features, np.zeros((2, 3)), np.array([0.1, 1.0]))
    view = scan_views(gaussians)[1]
    lid, box = true_masks(gaussians, labels, view.camera)[1], np.array([0.0, 0, 128, 96])
    image = TrueSegmenter(gaussians, labels, [view]).prepare(view.name, view.image_srgb)
    prompt = PromptedImage(view=view, prepared=image, part=MOVING, box=box, masks=(lid,))
    _, iou_alone = query_part(gaussians, features_at, [prompt], 96)
    margins, iou = query_part(gaussians, features_at, [prompt], 96, labels >= 1)
    assert iou_alone < 0.8
    assert iou > 0.9
    assert np.mean((margins > 0) == (labels == 2)) > 0.98
    assert np.ptp(margins[labels == 0]) == 0


def test_similarity_does_not_depend_on_the_length_of_features():
    rng = np.random.default_rng(1)
    features = rng.normal(size=(20, 8)).astype(np.float32)
    lengths = rng.uniform(0.1, 5, (20, 1)).astype(np.float32)
    gates, known = np.stack([np.ones(8), np.zeros(8)]), np.array([0.1, 1.0])
    one, other = (gate_features(f, gates, known, 0.3) for f in (features, features * lengths))
    assert np.allclose(one, other, atol=1e-5)


def test_grid_points_spare_what_is_known():
    skip = np.zeros((60, 80), bool)
    skip[:, :40] = True
    points = grid_points((60, 80), 4, skip)
    assert len(points) == 8
    assert points[:, 0].min() > 40


def test_good_masks_are_kept_once_and_best_first():
    disc = np.zeros((64, 64), bool)
    disc[10:40, 10:40] = True
    almost, speck, other = disc.copy(), np.zeros_like(disc), np.zeros_like(disc)
    almost[10:12] = False
    speck[0, 0] = True
    other[45:60, 45:60] = True
    answers = PointMasks(
        masks=np.stack([almost, disc, speck, np.ones_like(disc), other, other]),
        quality=np.array([0.9, 0.95, 1, 1, 0.85, 0.3], np.float32),
        stability=np.array([0.9, 0.95, 1, 1, 0.9, 1], np.float32),
    )
    assert np.array_equal(best_masks(answers, np.zeros((64, 64), bool)), np.stack([disc, other]))


def test_nothing_found_is_no_mask():
    found = best_masks(masks_of_logits([], [], (20, 30)), np.zeros((20, 30), bool))
    assert found.shape == (0, 20, 30)


def test_stored_masks_come_back(tmp_path):
    masks = np.random.default_rng(0).random((3, 17, 21)) > 0.5
    save_masks(tmp_path / "a.npz", masks)
    assert np.array_equal(load_masks(tmp_path / "a.npz"), masks)
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(MalformedFileError, match="not a readable npz"):
        load_masks(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_bytes(npz_bytes({"packed": np.zeros(3)}))
    with pytest.raises(MalformedFileError, match="does not hold masks"):
        load_masks(tmp_path / "b.npz")


def test_views_are_spread():
    gaussians, _ = scene()
    views = scan_views(gaussians)
    assert [view.name for view in spread_views(views, ["0.jpg"], 2)] == ["0.jpg", "3.jpg"]
    assert len(spread_views(views, [], 9)) == 6
