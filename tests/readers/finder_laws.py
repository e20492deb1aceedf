"""Laws of the finder, run by test_policy.py in .venv-policy: prints what failed, nothing else."""

import io
import json
import tarfile
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from lerobot_policy_aomgen import finder_training
from lerobot_policy_aomgen.finder import (
    SIDE,
    UNSEEN,
    Finder,
    FinderSettings,
    crop_images,
    load_finder,
    read_heat_maps,
    save_finder,
)
from lerobot_policy_aomgen.finder_errors import lateral_mm, make_table, measure_errors
from lerobot_policy_aomgen.finder_images import read_images
from lerobot_policy_aomgen.finder_training import compute_loss, draw_batch, train_finder
from lerobot_policy_aomgen.lifting import Views, lift_points, project_points
from PIL import Image

from aomgen.core.keypoints import KEYPOINTS
from aomgen.errors import ConfigError, MalformedFileError
from aomgen.exports.image_dataset import DATASET_FILE

SIZE, FOCAL_PX, DEPTH_M = 128, 160.0, 1.4


def check(holds: object, law: str) -> None:
    if not bool(holds):
        print(f"failed: {law}")


def write_images(folder: Path, count: int) -> None:
    """Bright bars on noise, with the ends of another bar beside them."""
    rng, K = np.random.default_rng(0), [[FOCAL_PX, 0, SIZE / 2], [0, FOCAL_PX, SIZE / 2], [0, 0, 1]]
    folder.mkdir()
    (folder / DATASET_FILE).write_text(json.dumps({"keypoints": KEYPOINTS}))
    with tarfile.open(folder / "shard-000000.tar", "w") as tar:
        for number in range(count):
            image = rng.integers(0, 60, (SIZE, SIZE, 3)).astype(np.uint8)
            u, v = rng.integers(40, SIZE - 40, 2)
            image[v - 10 : v + 10, u - 2 : u + 2] = 255, 200, 60
            image[v - 10 : v + 10, u + 18 : u + 22] = 60, 120, 255
            offsets = [(0, 0), (0, -10), (0, 10), (20, -10), (20, 10)]
            pixels = np.array(offsets) + (u, v)
            world = np.column_stack([(pixels - SIZE / 2) / FOCAL_PX * DEPTH_M, np.full(5, DEPTH_M)])
            # One that is behind the camera.
            world[4] *= -1 if number == 0 else 1
            label = {"camera": "front", "asset": "bar", "K": K, "T_world_cam": np.eye(4).tolist()}
            label |= {"points_world": world.tolist(), "visible": [1, 1, 1, 1, 0]}
            encoded = io.BytesIO()
            Image.fromarray(image).save(encoded, "jpeg", quality=95)
            for kind, data in (("jpg", encoded.getvalue()), ("json", json.dumps(label).encode())):
                member = tarfile.TarInfo(f"{number:06d}.{kind}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))


# A part of an image is sampled where it is, at any size.
dot = torch.zeros(1, 3, SIZE, SIZE)
dot[:, :, 40:44, 80:84] = 255.0
for center, span in (((64.0, 64.0), 128.0), ((76.0, 50.0), 48.0), ((64.0, 64.0), 230.0)):
    cropped = crop_images(dot, torch.tensor([center]), torch.full((1, 2), span))
    light = cropped[0, 0] - cropped.min()
    at = (torch.arange(SIDE) + 0.5) / SIDE
    found = torch.stack([light.sum(0) @ at, light.sum(1) @ at]) / light.sum()
    want = (torch.tensor([82.0, 42.0]) - torch.tensor(center)) / span + 0.5
    check(torch.allclose(found, want, atol=0.01), f"a crop of {span:g} px keeps positions")

# Heat maps are read at the centers of their cells, and say what they do not know.
logits = torch.zeros(1, 2, 24, 24)
logits[0, 0, 6, 18] = 100.0
points, spreads = read_heat_maps(logits)
check(torch.allclose(points[0, 0], torch.tensor([18.5, 6.5]) / 24), "a heat map's peak is where it is")
check(spreads[0, 0] < 0.01 and spreads[0, 1] > 0.99 * UNSEEN, "a heat map without a peak is uncertain")

# Points are lifted from two views; a third one that does not see them changes nothing.
rng = torch.Generator().manual_seed(0)
truth = 0.3 * torch.rand(4, 5, 3, generator=rng)
poses = torch.eye(4).repeat(4, 3, 1, 1)
poses[:, 0, :3, 3] = torch.tensor([0.0, 0.0, -1.2])
turn = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
poses[:, 1, :3, :3], poses[:, 1, :3, 3] = turn, torch.tensor([1.5, 0.0, 0.1])
poses[:, 2, :3, 3] = torch.tensor([0.1, 0.1, -0.5])
views = Views(
    (SIZE, SIZE), torch.tensor([[FOCAL_PX, 0, 64.0], [0, FOCAL_PX, 64.0], [0, 0, 1]]).repeat(3, 1, 1), poses
)
pixels, depths = project_points(views, truth)
check((depths > 0).all(), "the cameras see the points")
spread = torch.tensor([1.0, 1.0, UNSEEN * SIZE])[:, None].expand(4, 3, 5)
lost = pixels.clone()
lost[:, 2] = 64.0
lifted, sigma = lift_points(views, lost, spread)
check(torch.allclose(lifted, truth, atol=1e-4), "points are lifted to where they are")
check(((sigma > 0.005) & (sigma < 0.03)).all(), "a pixel at 1.3 m is about a centimetre")
shifted = pixels.clone()
shifted[:, 2] += 30.0
near = lift_points(views, shifted, torch.ones_like(spread))[0]
far = lift_points(views, shifted, spread)[0]
check((far - truth).norm(dim=-1).max() < 0.1 * (near - truth).norm(dim=-1).min(), "certain views count more")

with tempfile.TemporaryDirectory() as scratch:
    folder = Path(scratch)
    write_images(folder / "images", 24)
    images = read_images(folder / "images")
    check(len(images) == 24 and len(read_images(folder / "images", 5)) == 5, "all images, or the first")
    both = images + read_images(folder / "images", 5)
    check(len(both) == 29 == len(both.visible), "images of several folders")
    check(np.array_equal(both.points_px[24:], images.points_px[:5], equal_nan=True), "with their points")
    check(np.array_equal(both.decode([24]), images.decode([0])), "in their order")
    try:
        images + replace(images, size=(9, 9))
        print("failed: images of different sizes are refused")
    except ConfigError as error:
        check("9" in str(error), "the sizes are named")
    check(np.isnan(images.points_px[0, 4]).all() and images.inside.sum() == 119, "what is behind is outside")
    levels = images.decode(np.arange(1, 24))
    rows, cells = np.arange(23)[:, None], images.points_px[1:, :1].astype(int)
    check((levels[rows, cells[..., 1], cells[..., 0], 0] > 200).all(), "labels lie on what they name")

    settings = FinderSettings(pretrained=False, crops_px=(64,))
    batch, targets = draw_batch(images, settings, np.random.default_rng(1))
    whole = targets[:16][((targets[:16] > 0.1) & (targets[:16] < 0.9)).all(-1).all(-1)]
    check(len(whole) > 8, "whole images contain their points")
    inside = ((targets > 0.02) & (targets < 0.98)).all(-1)[:, 0]
    at = (SIDE * targets[:, 0]).long().clamp(0, SIDE - 1)
    red = batch[torch.arange(32), 0, at[:, 1], at[:, 0]] - batch[:, 0].mean((1, 2))
    check((red[inside] > 0.3).all(), "crops keep points on what they name")

    finder_training.SAVE_EVERY, finder_training.BATCH = 2, 4
    losses = dict[int, float]()
    once = train_finder(images, settings, 4, 0, folder / "once", losses.__setitem__)

    class Killed(Exception):
        pass

    def die(step: int, loss: float) -> None:
        if step == 3:
            raise Killed

    try:
        train_finder(images, settings, 4, 0, folder / "twice", die)
    except Killed:
        seen = dict[int, float]()
        again = train_finder(images, settings, 4, 0, folder / "twice", seen.__setitem__)
        check(list(seen) == [3, 4] and seen[4] == losses[4], "a killed training continues")
        same = [torch.equal(a, b) for a, b in zip(once.parameters(), again.parameters(), strict=True)]
        check(all(same), "a training that was killed ends as one that was not")
    try:
        train_finder(images, settings, 4, 1, folder / "once", seen.__setitem__)
        print("failed: a checkpoint of another training is refused")
    except MalformedFileError as error:
        check("belongs to" in str(error), "the difference is named")

    # Points outside do not pull the heat maps anywhere.
    blind = torch.full_like(targets, 2.0)
    once.heat.weight.data.zero_()
    once.heat.bias.data.zero_()
    few = slice(12, 20)
    unsure, sure = (compute_loss(once, batch[few], points[few]) for points in (blind, targets))
    check(unsure < sure, "uniform maps know nothing")

    errors = measure_errors(again, images)
    check(np.isnan(lateral_mm(errors, images)[0, 4]), "a point outside has no error")
    middle = FOCAL_PX * errors.offsets[1:, 0].numpy() + images.points_px[1:, 0]
    again.settings = FinderSettings(pretrained=False, crops_px=())
    pixels = torch.from_numpy(levels).permute(0, 3, 1, 2).float() / 255
    first, spreads = again.find(pixels)
    again.settings = settings
    second, certain = again.find(pixels)
    check(np.allclose(second[:, 0].numpy(), middle, atol=1e-3), "errors are found minus true points")
    check((certain <= spreads).all(), "a second look counts where it is more certain")
    check(((first > 0) & (first < SIZE)).all(), "points of the first look lie in the image")
    table = make_table(errors, images)
    check(table["grasp"]["number"] == 24 and table["axis_1"]["number"] == 23, "the table counts known points")

    save_finder(folder / "finder.safetensors", again, errors)
    loaded, kept = load_finder(folder / "finder.safetensors")
    check(torch.equal(loaded.find(pixels)[0], second), "a stored finder finds the same")
    check(np.allclose(kept.offsets, errors.offsets, equal_nan=True), "its errors are stored with it")
    (folder / "finder.safetensors").write_bytes(b"no weights")
    try:
        load_finder(folder / "finder.safetensors")
        print("failed: damaged finders are refused")
    except MalformedFileError:
        pass
check(
    sum(p.numel() for p in Finder(FinderSettings()).parameters()) <= 1_000_000, "at most 1 million parameters"
)
