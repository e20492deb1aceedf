"""Writing of the images of a scan, upright and resampled to one pinhole camera."""

import shutil
from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import chain, count
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.scan_images import IMAGE_SUFFIXES
from aomgen.capture.scan_poses import SCAN_POSES_FILE, describe_scan_poses
from aomgen.core.progress import Progress
from aomgen.core.recording import Intrinsics, ScanPoses
from aomgen.errors import CalibrationError, SeveralCamerasError
from aomgen.importers.photos import read_header, read_photo
from aomgen.importers.pinhole_images import choose_pinhole, make_resampler, rescale_camera
from aomgen.importers.scan_source import ScanImage, ScanSource
from aomgen.io.atomic import write_json
from aomgen.io.images import encode_jpeg, encode_png, exif_orientation, open_image, resize

# Quality at which a second compression of an image is not visible.
JPEG_QUALITY: Final = 98


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenScan:
    """Images written into a capture.

    Attributes:
        names: File names, in the order of the source.
        width, height: Size of the images, [px].
        intrinsics: Intrinsics of their pinhole camera; None if unknown.
        resampled: Number of images whose distortion was removed by resampling.
        poses: Poses from the source; None if there are none.
        warnings: Sentences about changes.
    """

    names: tuple[str, ...]
    width: int
    height: int
    intrinsics: Intrinsics | None
    resampled: int
    poses: ScanPoses | None
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Description of how a source image is converted to a scan image.

    Attributes:
        upright: Whether EXIF's orientation is applied.
        quarter_turn: Whether the image is rotated by 90 degrees afterwards, so that all images have one size.
        width, height: Size after these rotations, [px].
        image: Source image, whose camera model is that of this size.
    """

    upright: bool
    quarter_turn: bool
    width: int
    height: int
    image: ScanImage


def write_scan(
    source: ScanSource, folder: Path, long_side: int, where: Path, progress: Progress
) -> WrittenScan:
    """Write images, and `scan_poses.json` if there are poses, into a folder.

    Every image is decoded to detect damage. An image that needs no change is copied byte by byte.

    Args:
        folder: Folder for the files; it has to be discarded after an error.
        long_side: Largest side of an image, [px]; larger images are reduced. 0 keeps their size.
        where: The source, for errors.

    Raises:
        InputError: An image cannot be decoded, or images are not from one camera.
        StorageError, OSError: Writing to the disk failed.
    """
    layouts = [_lay_out(image) for image in source.images]
    layouts, warnings = _agree_on_size(layouts, where)
    width, height = layouts[0].width, layouts[0].height
    share = min(1.0, long_side / max(width, height)) if long_side else 1.0
    width, height = max(1, round(share * width)), max(1, round(share * height))
    cameras = [layout.image.camera for layout in layouts]
    scaled = [camera and rescale_camera(camera, width, height) for camera in cameras]
    known = {
        layout.image.name: camera
        for layout, camera in zip(layouts, scaled, strict=True)
        if camera is not None
    }
    if known and len(known) < len(layouts):
        warnings += (f"{len(layouts) - len(known)} of {len(layouts)} images have no intrinsics",)
    target = choose_pinhole(known, where) if known else None
    names, resampled = [], 0
    for index, (layout, camera) in enumerate(zip(layouts, scaled, strict=True)):
        progress(index / len(layouts), "writing images")
        resample = make_resampler(target, camera) if target and camera else None
        pixels = _decode(layout)
        if pixels.shape[:2] != (height, width):
            pixels = resize(pixels, width, height)
        if resample:
            pixels, resampled = resample(pixels), resampled + 1
        unchanged = share == 1.0 and resample is None and not layout.quarter_turn
        names.append(_write(layout, pixels, folder, set(names), copy=unchanged))
    poses = _rename_poses(source, names)
    if poses:
        write_json(folder / SCAN_POSES_FILE, describe_scan_poses(poses))
    return WrittenScan(
        names=tuple(names),
        width=width,
        height=height,
        intrinsics=target and Intrinsics(fx=target.fx, fy=target.fy, cx=target.cx, cy=target.cy),
        resampled=resampled,
        poses=poses,
        warnings=source.warnings + warnings,
    )


def _lay_out(image: ScanImage) -> Layout:
    """Decide whether EXIF's orientation applies, by the image size of the camera model; without a model, it applies."""
    upright, _ = read_header(image.path)
    camera = image.camera
    if camera is None:
        return Layout(upright=True, quarter_turn=False, width=upright[0], height=upright[1], image=image)
    stored = upright
    if image.path.suffix.lower() in IMAGE_SUFFIXES:
        with open_image(image.path) as opened:
            stored = opened.size
    # Other programs ignore an orientation that does not change the size.
    keeps = stored == upright and image.T_scan_cam is None
    for size, is_upright in ((stored, keeps), (upright, True)):
        # The image may be a reduced or enlarged copy of the image of the camera model.
        if abs(size[0] * camera.height - size[1] * camera.width) <= 1.01 * max(camera.width, camera.height):
            return Layout(
                upright=is_upright,
                quarter_turn=False,
                width=size[0],
                height=size[1],
                image=replace(image, camera=rescale_camera(camera, *size)),
            )
    raise CalibrationError(
        image.path,
        f"is {stored[0]} x {stored[1]}, its camera {camera.width} x {camera.height}: another shape",
        "use the images that were reconstructed",
    )


def _agree_on_size(layouts: list[Layout], where: Path) -> tuple[list[Layout], tuple[str, ...]]:
    """Rotate upright and sideways photos of one camera to one size; refuse images of other sizes.

    Raises:
        SeveralCamerasError: The sizes differ by more than this rotation.
    """
    groups: dict[tuple[int, int], list[Layout]] = defaultdict(list)
    for layout in layouts:
        groups[layout.width, layout.height].append(layout)
    if len(groups) == 1:
        return layouts, ()
    width, height = max(groups, key=lambda size: len(groups[size]))
    known = [layout.image.camera for layout in layouts if layout.image.camera is not None]
    posed = any(layout.image.T_scan_cam is not None for layout in layouts)
    if (
        set(groups) != {(width, height), (height, width)}
        or posed
        or any(camera.model != "SIMPLE_PINHOLE" for camera in known)
    ):
        described = {
            f"{size[0]} x {size[1]} px": [item.image.path.name for item in group]
            for size, group in groups.items()
        }
        raise SeveralCamerasError(where, described)
    turned = groups[height, width]
    sentence = (
        f"{len(turned)} of {len(layouts)} photos ({turned[0].image.path.name}) were taken with the camera turned; "
        f"they are stored sideways, {width} x {height}"
    )
    return [_turn(layout) if layout.width != width else layout for layout in layouts], (sentence,)


def _turn(layout: Layout) -> Layout:
    camera = layout.image.camera
    if camera is not None:
        focal, cx, cy = camera.params
        camera = replace(camera, width=camera.height, height=camera.width, params=(focal, cy, cx))
    return replace(
        layout,
        quarter_turn=True,
        width=layout.height,
        height=layout.width,
        image=replace(layout.image, camera=camera),
    )


def _decode(layout: Layout) -> NDArray[np.uint8]:
    pixels = read_photo(layout.image.path, upright=layout.upright)
    return np.ascontiguousarray(np.rot90(pixels)) if layout.quarter_turn else pixels


def _write(layout: Layout, pixels: NDArray[np.uint8], folder: Path, taken: set[str], *, copy: bool) -> str:
    """Write one image; return its name with the suffix of the written format."""
    path, name = layout.image.path, Path(layout.image.name)
    suffix = name.suffix.lower()
    if suffix not in IMAGE_SUFFIXES:
        name = name.with_suffix(".jpg")
    copy = copy and path.suffix.lower() == suffix and suffix in IMAGE_SUFFIXES
    if copy:
        with open_image(path) as image:
            copy = exif_orientation(image) == 1
    stem = f"{name.stem}_{suffix.strip('.')}"
    numbered = (f"{stem}_{number}{name.suffix}" for number in count(2))
    name = Path(next(item for item in chain([name.name, stem + name.suffix], numbered) if item not in taken))
    if copy:
        shutil.copyfile(path, folder / name.name)
    else:
        lossless = name.suffix.lower() == ".png"
        data = encode_png(pixels) if lossless else encode_jpeg(pixels, JPEG_QUALITY, halve_colors=False)
        (folder / name.name).write_bytes(data)
    return name.name


def _rename_poses(source: ScanSource, names: list[str]) -> ScanPoses | None:
    poses = {
        name: image.T_scan_cam
        for name, image in zip(names, source.images, strict=True)
        if image.T_scan_cam is not None
    }
    return ScanPoses(Ts_scan_cam=poses, metric=source.metric) if poses else None
