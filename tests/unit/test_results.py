"""What later stages get of a capture: stills of a pinhole camera, wherever they come from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.lens import Lens
from aomgen.core.project import Project
from aomgen.core.structure import PinholeScan, Structure
from aomgen.errors import MissingFileError
from aomgen.io.artifact import save_artifact
from aomgen.results import Results
from small_alignment import ALIGNMENT

BENT = Lens(fx=600, fy=600, cx=320, cy=240, width=640, height=480, k1=-0.2)
STRUCTURE = Structure(
    cameras_recon={},
    demo_cameras_recon={},
    dropped={},
    points_recon=np.zeros((1, 3)),
    colors_srgb=np.zeros((1, 3), np.uint8),
    observations=np.zeros((1, 2), np.int32),
    reprojection_error_px=0.5,
)


@pytest.fixture
def results(capture_copy: Path, tmp_path: Path) -> Results:
    folders = {name: tmp_path / name for name in ("structure", "alignment")}
    for folder in folders.values():
        folder.mkdir()
    return Results(project=Project(capture=capture_copy, out=tmp_path), out=tmp_path, folders=folders)


def test_of_an_ordinary_capture_nothing_changes(results):
    save_artifact(results.folders["structure"], "structure", STRUCTURE)
    assert results.pinhole_capture == results.recorded
    assert results.videos is results.recorded_videos


def test_a_bent_scan_is_replaced_by_its_undistorted_copy(results):
    folder = results.folders["structure"]
    prompts = results.recorded.prompts[:1]
    scan = PinholeScan(images=("straight/0000.jpg",), masks={"sam": "straight_masks/sam"}, prompts=prompts)
    save_artifact(folder, "structure", replace(STRUCTURE, pinhole=scan))
    found = results.pinhole_capture
    assert results.scan_images == {"0000.jpg": folder / "straight/0000.jpg"}
    assert found.mask_folders == {"sam": folder / "straight_masks/sam"}
    assert [prompt.image for prompt in found.prompts] == [prompts[0].image]
    assert np.array_equal(found.prompts[0].box, prompts[0].box)


def test_frames_of_a_video_keep_the_recorded_masks(results):
    scan = PinholeScan(images=("frames/scan_000003.png",), masks=None, prompts=results.recorded.prompts)
    save_artifact(results.folders["structure"], "structure", replace(STRUCTURE, pinhole=scan))
    assert list(results.scan_images) == ["scan_000003.png"]
    assert results.pinhole_capture.mask_folders == results.recorded.mask_folders


def test_fixed_cameras_get_their_own_lens(results):
    name = results.demo_camera
    save_artifact(results.folders["structure"], "structure", replace(STRUCTURE, demo_lenses={name: BENT}))
    assert [camera.lens for camera in results.pinhole_capture.cameras] == [BENT]
    assert results.pinhole_capture.scan_images == results.recorded.scan_images


def test_joint_zeros_are_added_to_log_and_scan(results):
    zeros = np.linspace(-0.01, 0.01, results.recorded.joint_log.joints.shape[1])
    save_artifact(results.folders["structure"], "structure", STRUCTURE)
    alignment = replace(ALIGNMENT, joint_zeros_rad=zeros, joint_zero_sds_rad=np.ones(len(zeros)))
    save_artifact(results.folders["alignment"], "alignment", alignment)
    assert np.allclose(results.capture.joint_log.joints - results.recorded.joint_log.joints, zeros)
    assert np.allclose(results.configuration.joints - results.recorded.robot.scan_joints, zeros)


def test_a_value_of_an_unfinished_stage_is_named_and_read_once_it_is_there(results):
    with pytest.raises(MissingFileError, match=r"structure\.json"):
        _ = results.pinhole_capture
    save_artifact(results.folders["structure"], "structure", STRUCTURE)
    assert results.structure is results.structure
