"""What later stages get of a capture: stills of a pinhole camera, wherever they come from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.read import read_capture
from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.core.recording import frame_name
from aomgen.core.structure import Structure
from aomgen.errors import MissingFileError
from aomgen.io.atomic import write_json
from aomgen.pipeline.working import working_capture
from aomgen.structure.stage import save_structure
from aomgen.structure.undistortion import IMAGES_FOLDER, MASKS_FOLDER
from aomgen.structure.video_frames import FRAMES_FOLDER, LISTING

BENT = Lens(fx=600, fy=600, cx=320, cy=240, width=640, height=480, k1=-0.2)


def store(folder: Path, *, scan_lens: Lens | None = None, demo_lenses: dict[str, Lens] | None = None) -> Path:
    camera = Camera(fx=600, fy=600, cx=320, cy=240, width=640, height=480, T_world_cam=np.eye(4))
    structure = Structure(
        cameras_recon={"0000.jpg": camera},
        demo_cameras_recon={},
        dropped={},
        points_recon=np.zeros((1, 3)),
        colors_srgb=np.zeros((1, 3), np.uint8),
        observations=np.zeros((1, 2), np.int32),
        reprojection_error_px=0.5,
        scan_lens=scan_lens,
        demo_lenses=demo_lenses or {},
    )
    save_structure(structure, folder)
    return folder


def test_of_an_ordinary_capture_nothing_changes(capture_copy, tmp_path):
    capture = read_capture(capture_copy)
    assert working_capture(capture, store(tmp_path / "structure")) == capture


def test_a_bent_scan_is_replaced_by_its_straight_copy(capture_copy, tmp_path):
    capture = read_capture(capture_copy)
    folders = {name: tmp_path / name for name in ("sam", "by_hand")}
    capture = replace(capture, mask_folders=folders)
    structure = store(tmp_path / "structure", scan_lens=BENT)
    (structure / MASKS_FOLDER / "sam").mkdir(parents=True)
    working = working_capture(capture, structure)
    assert [path.parent for path in working.scan_images] == [structure / IMAGES_FOLDER] * len(
        capture.scan_images
    )
    assert [p.name for p in working.scan_images] == [p.name for p in capture.scan_images]
    # Masks that the structure stage did not straighten do not fit the straight images.
    assert working.mask_folders == {"sam": structure / MASKS_FOLDER / "sam"}
    pairs = [(old, new) for old, new in zip(capture.prompts, working.prompts, strict=True) if len(old.points)]
    assert pairs
    for old, new in pairs:
        assert np.allclose(new.points[:, :2], BENT.straightened(old.points[:, :2]))
        assert np.array_equal(new.points[:, 2], old.points[:, 2])


def test_fixed_cameras_get_their_own_lens(capture_copy, tmp_path):
    capture = read_capture(capture_copy)
    front = capture.cameras[0]
    capture = replace(capture, cameras=(front, replace(front, name="side")))
    working = working_capture(capture, store(tmp_path / "structure", demo_lenses={"side": BENT}))
    assert [camera.lens for camera in working.cameras] == [None, BENT]
    assert working.scan_images == capture.scan_images
    assert working.prompts == capture.prompts


@pytest.mark.parametrize("lens", [None, BENT])
def test_a_scan_video_is_replaced_by_its_frames(capture_copy, tmp_path, lens):
    capture = replace(read_capture(capture_copy), scan_images=(), scan_video=capture_copy / "scan.mp4")
    structure = store(tmp_path / "structure", scan_lens=lens)
    write_json(structure / LISTING, {"frames": [3, 17, 120], "of": 200, "looked_at": 50})
    working = working_capture(capture, structure)
    folder = structure / (FRAMES_FOLDER if lens is None else IMAGES_FOLDER)
    assert working.scan_images == tuple(folder / frame_name(index) for index in (3, 17, 120))


def test_an_unfinished_structure_stage_is_named(capture_copy, tmp_path):
    with pytest.raises(MissingFileError, match=r"structure\.json"):
        working_capture(read_capture(capture_copy), tmp_path)


def test_frames_that_were_never_chosen_are_named(capture_copy, tmp_path):
    capture = replace(read_capture(capture_copy), scan_images=(), scan_video=capture_copy / "scan.mp4")
    with pytest.raises(MissingFileError, match=r"frames\.json"):
        working_capture(capture, store(tmp_path / "structure"))
