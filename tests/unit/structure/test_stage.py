"""A scan through a bent lens is replaced by undistorted images, masks and prompts."""

from dataclasses import replace

import numpy as np

from aomgen.capture.read import read_capture
from aomgen.core.lens import Lens
from aomgen.core.progress import silent
from aomgen.io.atomic import write_bytes
from aomgen.io.images import encode_png, read_image
from aomgen.structure.stage import MASKS_FOLDER, undistort_scan


def test_a_bent_scan_becomes_straight(capture_copy, tmp_path):
    capture = read_capture(capture_copy)
    images = {path.name: path for path in capture.scan_images[:2]}
    height, width = read_image(capture.scan_images[0]).shape[:2]
    bent = Lens(fx=600, fy=600, cx=width / 2, cy=height / 2, width=width, height=height, k1=-0.2)
    stem = capture.scan_images[0].stem
    write_bytes(tmp_path / "hand" / f"{stem}.png", encode_png(np.full((height, width), 2, np.uint8)))
    write_bytes(tmp_path / "small" / f"{stem}.png", encode_png(np.zeros((4, 4), np.uint8)))
    folders = {"hand": tmp_path / "hand", "small": tmp_path / "small"}
    out = tmp_path / "structure"
    scan = undistort_scan(images, replace(capture, mask_folders=folders), bent, out, silent)
    assert [(out / file).is_file() for file in scan.images] == [True, True]
    # Masks of another size do not belong to these images.
    assert scan.masks == {"hand": f"{MASKS_FOLDER}/hand"}
    pairs = [(old, new) for old, new in zip(capture.prompts, scan.prompts, strict=True) if len(old.points)]
    assert pairs
    for old, new in pairs:
        assert np.allclose(new.points[:, :2], bent.undistort(old.points[:, :2]))
        assert np.array_equal(new.points[:, 2], old.points[:, 2])
