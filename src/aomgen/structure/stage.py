"""Cameras and sparse points of the scan, fixed cameras in the same model. [paper 4.1]"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.core.lens import Lens, undistort_labels, undistorter
from aomgen.core.progress import Progress, part
from aomgen.core.recording import Recording
from aomgen.core.structure import PinholeScan, Structure
from aomgen.io.artifact import save_artifact
from aomgen.io.atomic import write_bytes
from aomgen.io.images import encode_jpeg, encode_png, read_image, read_labels
from aomgen.io.video import Video
from aomgen.results import Results
from aomgen.structure.fixed_cameras import DemoView
from aomgen.structure.prompt_visibility import undistort_prompts
from aomgen.structure.reconstruct import Photographs, StructureParams, reconstruct_structure
from aomgen.structure.video_frames import extract_frames

# Number of frames that are sufficient for the temporal median.
MEDIAN_FRAMES = 48
IMAGES_FOLDER = "straight"
MASKS_FOLDER = "straight_masks"
# JPEG quality at which the second compression of a photograph is invisible.
JPEG_QUALITY = 98


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Reconstruct the scan; undistort its images if their camera is not a pinhole camera."""
    capture = results.recorded
    images = {path.name: path for path in capture.scan_images}
    if capture.scan_video is not None:
        prompted = {prompt.image for prompt in capture.prompts}
        images = extract_frames(capture.scan_video, prompted, folder, part(progress, 0.0, 0.2))
        progress = part(progress, 0.2, 1.0)
    photographs = Photographs(
        images=images,
        intrinsics=capture.scan_intrinsics,
        demo=_demo_views(capture, results.recorded_videos),
        prompts=capture.prompts,
        Ts_scan_cam=capture.scan_poses.Ts_scan_cam if capture.scan_poses else {},
    )
    found = reconstruct_structure(
        photographs, results.params("structure", StructureParams()), part(progress, 0.0, 0.97)
    )
    pinhole = _pinhole_scan(found, capture, images, folder, part(progress, 0.97, 1.0))
    save_artifact(folder, "structure", replace(found, pinhole=pinhole))
    return {
        "registered": len(found.cameras_recon),
        "of": len(images),
        "reprojection_error_px": round(found.reprojection_error_px, 3),
        "points": len(found.points_recon),
        "warnings": list_pose_warnings(found),
    }


def list_pose_warnings(found: Structure) -> list[str]:
    """Return sentences about poses that came with the scan and are not used."""
    given = found.figures.get("given_poses")
    return list(given["warnings"]) if isinstance(given, dict) else []


def _demo_views(capture: Recording, videos: dict[str, Video]) -> dict[str, DemoView]:
    return {
        camera.name: DemoView(
            first_srgb=videos[camera.name].frames_srgb[0],
            median_srgb=_median_frame(videos[camera.name]),
            intrinsics=camera.intrinsics,
        )
        for camera in capture.cameras
    }


def _median_frame(video: Video) -> NDArray[np.uint8]:
    step = max(1, len(video.times_s) // MEDIAN_FRAMES)
    return np.median(video.frames_srgb[::step], axis=0).astype(np.uint8)


def _pinhole_scan(
    found: Structure, capture: Recording, images: dict[str, Path], folder: Path, progress: Progress
) -> PinholeScan | None:
    if found.scan_lens is not None:
        return undistort_scan(images, capture, found.scan_lens, folder, progress)
    if capture.scan_video is None:
        return None
    files = tuple(path.relative_to(folder).as_posix() for path in images.values())
    return PinholeScan(images=files, masks=None, prompts=capture.prompts)


def undistort_scan(
    images: dict[str, Path], capture: Recording, lens: Lens, folder: Path, progress: Progress
) -> PinholeScan:
    """Write undistorted copies of scan images and their masks below `folder`, names kept.

    Masks of other images or of another size are left out.

    Raises:
        InputError: An image or mask cannot be read.
        StorageError: Writing to the disk failed.
    """
    files = write_undistorted(images, lens, folder, progress)
    stems = {Path(name).stem for name in images}
    written = {}
    for masks, source in sorted(capture.mask_folders.items()):
        for path in sorted(source.glob("*.png")):
            labels = read_labels(path)
            if path.stem in stems and labels.shape == (lens.height, lens.width):
                labels = undistort_labels(labels, lens)
                write_bytes(folder / MASKS_FOLDER / masks / path.name, encode_png(labels))
                written[masks] = f"{MASKS_FOLDER}/{masks}"
    return PinholeScan(
        images=files,
        masks=written,
        prompts=undistort_prompts(capture.prompts, lens),
    )


def write_undistorted(
    images: dict[str, Path], lens: Lens, folder: Path, progress: Progress
) -> tuple[str, ...]:
    """Write undistorted copies of images below `folder`; return their paths relative to it, in the order of the images.

    Raises:
        InputError: An image cannot be read.
        StorageError: Writing to the disk failed.
    """
    undistort = undistorter(lens)
    for index, (name, path) in enumerate(sorted(images.items())):
        progress(index / len(images), "undistorting images")
        image = undistort(read_image(path))
        lossy = path.suffix.lower() in (".jpg", ".jpeg")
        data = encode_jpeg(image, JPEG_QUALITY) if lossy else encode_png(image)
        write_bytes(folder / IMAGES_FOLDER / name, data)
    return tuple(f"{IMAGES_FOLDER}/{name}" for name in images)
