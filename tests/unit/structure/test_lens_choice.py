"""Distortion is found where it is, and nowhere else."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.lens import Lens
from aomgen.core.recording import Intrinsics, Prompt
from aomgen.errors import ReconstructionError
from aomgen.structure.fixed_cameras import (
    Links,
    choose_view_lens,
    resect,
)
from aomgen.structure.lens_choice import (
    choose_lens,
    compare,
    lean_on_stated,
    lens_misfit_px,
    require_lens_fits,
)
from aomgen.structure.prompt_visibility import undistort_prompts
from aomgen.structure.sparse_model import adjust

SIZE = {"width": 640, "height": 480}
OPTICS = {"fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0}
NOISE_PX = 0.5


def _model(k1: float, seed: int, stated: float = 600.0, waves_px: float = 0.0) -> pycolmap.Reconstruction:
    """Noisy views of a cloud that fills the image, adjusted as if they were a pinhole's."""
    rng = np.random.default_rng(seed)
    lens = Lens(**OPTICS, **SIZE, k1=k1)
    points = rng.uniform([-1.5, -1.5, 0], [1.5, 1.5, 1.2], (500, 3))
    model = pycolmap.Reconstruction()
    params = [stated, stated, OPTICS["cx"], OPTICS["cy"]]
    model.add_camera_with_trivial_rig(pycolmap.Camera(model="PINHOLE", params=params, camera_id=1, **SIZE))
    tracks = [pycolmap.Track() for _ in points]
    for number in range(1, 17):
        angle = 0.35 * number
        T_world_cam = look_at(
            [2.6 * np.cos(angle), 2.6 * np.sin(angle), 1.4 + 0.3 * (number % 3)], [0, 0, 0.3]
        )
        T_cam_world = np.linalg.inv(T_world_cam)
        points_cam = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        pixels = lens.pixels(points_cam[:, :2] / points_cam[:, 2:])
        seen = np.flatnonzero((points_cam[:, 2] > 0.3) & ((pixels > 0) & (pixels < [640, 480])).all(1))
        pixels = pixels + waves_px * np.sin(pixels[:, ::-1] / 40)
        noisy = pixels[seen] + rng.normal(0, NOISE_PX, (len(seen), 2))
        image = pycolmap.Image(name=f"{number:02d}", keypoints=noisy, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T_cam_world[:3]))
        for row, point in enumerate(seen):
            tracks[point].add_element(number, row)
    for point, track in zip(points, tracks, strict=True):
        if track.length() >= 3:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    adjust(model)
    return model


STATED = Intrinsics(**OPTICS)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("stated", "kept"), [(STATED, "stated"), (None, "focal")])
def test_a_pinhole_stays_a_pinhole(seed, stated, kept):
    choice = choose_lens(_model(0.0, seed), stated, seed=seed)
    assert choice.model == kept
    assert not choice.lens.bends
    assert abs(choice.lens.fx - 600) < 3


@pytest.mark.parametrize("k1", [-0.2, -0.02, 0.1])
def test_a_bent_lens_is_found(k1):
    choice = choose_lens(_model(k1, 4), STATED, seed=0)
    assert choice.lens.bends
    assert abs(choice.lens.k1 - k1) < 0.01
    assert abs(choice.lens.fx - 600) < 3


def test_a_focal_length_stated_wrong_follows_the_images():
    model = _model(-0.03, 4, stated=612.0)
    choice = choose_lens(model, Intrinsics(fx=612.0, fy=612.0, cx=320.0, cy=240.0), seed=0)
    assert choice.model == "radial"
    assert abs(choice.lens.fx - 600) < 3


def test_a_calibrated_focal_length_is_hardly_moved():
    known = Intrinsics(fx=612.0, fy=612.0, cx=320.0, cy=240.0, calibrated=True)
    free = Lens(**OPTICS, **SIZE)
    assert abs(lean_on_stated(free, known, 0.01).fx - 612) < 0.2
    assert abs(lean_on_stated(free, replace(known, calibrated=False), 0.001).fx - 600) < 0.2


def test_a_lens_that_no_model_fits_is_refused():
    model = _model(-0.1, 4, waves_px=4.0)
    choose_lens(model, STATED, seed=0)
    with pytest.raises(ReconstructionError, match="no lens model explains"):
        require_lens_fits(lens_misfit_px(model), "scan")


def test_a_lens_that_a_model_fits_is_accepted():
    model = _model(-0.1, 4)
    choose_lens(model, STATED, seed=0)
    require_lens_fits(lens_misfit_px(model), "scan")


def _links(lens: Lens, seed: int, count: int = 250, wrong: int = 40) -> tuple[Links, Camera]:
    rng = np.random.default_rng(seed)
    camera = Camera(**OPTICS, **SIZE, T_world_cam=look_at([2.0, 0.3, 1.2], [0, 0, 0.2]))
    points = rng.uniform([-1, -1, 0], [1, 1, 0.9], (6 * count, 3))
    points_cam = (points - camera.center) @ camera.T_world_cam[:3, :3]
    pixels = lens.pixels(points_cam[:, :2] / points_cam[:, 2:])
    inside = np.flatnonzero(((pixels > 0) & (pixels < [640, 480])).all(1))[:count]
    pixels = pixels[inside] + rng.normal(0, NOISE_PX, (len(inside), 2))
    pixels[:wrong] = rng.uniform([0, 0], [640, 480], (wrong, 2))
    return Links(pixels=pixels, points_recon=points[inside]), camera


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_one_pinhole_view_stays_a_pinhole(seed):
    plain = Lens(**OPTICS, **SIZE)
    links, camera = _links(plain, seed)
    placed = resect(links, plain, focal_known=True, seed=0)
    assert placed is not None
    assert np.linalg.norm(placed.camera_recon.center - camera.center) < 0.01
    assert placed.count >= 200
    assert not placed.inliers[:40].all()
    assert not choose_view_lens(links, placed, STATED, None, seed=0).lens.bends


def test_one_bent_view_is_found_and_placed():
    plain, bent = Lens(**OPTICS, **SIZE), Lens(**OPTICS, **SIZE, k1=-0.15, k2=0.03)
    links, camera = _links(bent, 5)
    placed = resect(links, plain, focal_known=True, seed=0)
    assert placed is not None
    choice = choose_view_lens(links, placed, STATED, None, seed=0)
    assert choice.lens.bends
    assert np.abs(choice.lens.pixels([[0.4, 0.3]]) - bent.pixels([[0.4, 0.3]])).max() < 1.0
    again = resect(links, choice.lens, focal_known=True, seed=0)
    assert again is not None
    assert again.count > placed.count
    assert np.linalg.norm(again.camera_recon.center - camera.center) < 0.01


def _keeps_scan_lens(true: Lens, given: Lens, seed: int) -> bool:
    links, _ = _links(true, seed)
    placed = resect(links, Lens(**OPTICS, **SIZE), focal_known=False, seed=0)
    assert placed is not None
    return choose_view_lens(links, placed, None, given, seed=0).model == "scan"


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_camera_with_the_scans_lens_keeps_it(seed):
    plain = Lens(**OPTICS, **SIZE)
    assert _keeps_scan_lens(plain, plain, seed)


@pytest.mark.parametrize("share", [0.97, 1.02, 1.3])
def test_a_camera_with_another_focal_length_keeps_its_own(share):
    other = Lens(fx=600 * share, fy=600 * share, cx=320, cy=240, **SIZE)
    assert not _keeps_scan_lens(Lens(**OPTICS, **SIZE), other, 5)


def test_two_stills_place_a_camera_better_than_one():
    plain = Lens(**OPTICS, **SIZE)
    one, both = [], []
    for seed in range(8):
        first, camera = _links(plain, seed, count=120)
        second, _ = _links(plain, 100 + seed, count=120)
        together = Links(
            pixels=np.concatenate([first.pixels, second.pixels]),
            points_recon=np.concatenate([first.points_recon, second.points_recon]),
        )
        for links, errors in ((first, one), (together, both)):
            placed = resect(links, plain, focal_known=True, seed=0)
            assert placed is not None
            errors.append(np.linalg.norm(placed.camera_recon.center - camera.center))
    assert np.mean(both) < np.mean(one)


def test_one_lucky_image_is_no_evidence():
    same = [np.full(50, 1.0) for _ in range(10)]
    lucky = [np.full(50, 0.1), *same[1:]]
    gain, significance = compare(same, lucky)
    assert gain > 0.05
    assert significance < 2


def test_prompts_move_with_the_image():
    lens = Lens(**OPTICS, **SIZE, k1=-0.2)
    points = np.array([[320.0, 240.0, 1.0], [1.0, 1.0, 0.0]])
    box = np.array([0.0, 100.0, 200.0, 300.0])
    (moved,) = undistort_prompts((Prompt(part="moving", image="a", points=points, box=box),), lens)
    assert np.allclose(moved.points[0], [320, 240, 1])
    corners = lens.undistort([[200.0, 100.0], [200.0, 300.0]])
    assert moved.box[0] == 0
    assert moved.box[2] >= corners[:, 0].max() - 1e-9
    assert not np.allclose(moved.box[2], 200, atol=2)
    gone = Prompt(part="moving", image="a", points=np.array([[0.0, 0.0, 1.0]]), box=np.zeros(0))
    assert undistort_prompts((gone,), lens) == () or lens.undistort([[0.0, 0.0]]).min() >= 0
