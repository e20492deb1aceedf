"""Scans that cannot be used are refused in one sentence, and nothing is left behind."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.scan_poses import SCAN_POSES_FILE, read_scan_poses
from aomgen.core.progress import silent
from aomgen.errors import (
    AomgenError,
    CalibrationError,
    ConfigError,
    IncompleteCaptureError,
    MalformedFileError,
    MissingFileError,
    NonFiniteError,
    ScanPoseError,
    StorageError,
    UnknownCameraModelError,
    UnsafePathError,
)
from aomgen.importers.scan_import import import_scan
from foreign_scans import (
    KnownScan,
    write_colmap,
    write_photos,
    write_polycam,
    write_record3d,
    write_transforms,
)


def refuse(source: Path, capture: Path, kind: type[AomgenError], *words: str) -> AomgenError:
    """The error of an import, which leaves nothing at the capture nor beside it."""
    before = sorted(capture.parent.iterdir())
    with pytest.raises(kind) as caught:
        import_scan(source, capture, 0, silent)
    assert sorted(capture.parent.iterdir()) == before
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message
    return caught.value


def change_json(path: Path, change: Callable[[dict], object]) -> None:
    data = json.loads(path.read_text("utf-8"))
    change(data)
    path.write_text(json.dumps(data), "utf-8")


def frames(change: Callable[[list], object]) -> Callable[[dict], object]:
    return lambda data: change(data["frames"])


def set_pose(index: int, value: object) -> Callable[[dict], object]:
    return frames(lambda items: items[index].update(transform_matrix=value))


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
SHEAR = [[1, 0.3, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
TRANSFORMS = {
    "mirrored pose": (set_pose(3, MIRROR), ScanPoseError, "mirrors space"),
    "sheared pose": (set_pose(3, SHEAR), ScanPoseError, "is not a rotation"),
    "short pose": (set_pose(3, [[1.0, 0.0]]), MalformedFileError, "4 x 4"),
    "missing image": (
        frames(
            lambda items: [item.update(file_path=f"images/none{i}.jpg") for i, item in enumerate(items[5:])]
        ),
        MissingFileError,
        "none0.jpg",
    ),
    "image outside": (
        frames(lambda items: items[3].update(file_path="../../x.jpg")),
        UnsafePathError,
        "outside",
    ),
    "image twice": (
        frames(lambda items: items[3].update(file_path=items[4]["file_path"])),
        MalformedFileError,
        "2 times",
    ),
    "unknown model": (
        lambda data: data.update(camera_model="EQUIRECTANGULAR"),
        UnknownCameraModelError,
        "EQUIRECTANGULAR",
    ),
    "no focal length": (lambda data: data.update(fl_x=0), NonFiniteError, "intrinsics"),
    "other shape": (lambda data: data.update(w=480), CalibrationError, "another shape"),
    "no frames": (lambda data: data.update(frames=[]), MalformedFileError, "lists no frames"),
    "frames of another type": (lambda data: data.update(frames=3), MalformedFileError, "frames"),
    "huge size": (lambda data: data.update(w=1e300), MalformedFileError, "pixels"),
}


@pytest.mark.parametrize("case", TRANSFORMS)
def test_transforms(case: str, few: KnownScan, tmp_path: Path) -> None:
    change, kind, words = TRANSFORMS[case]
    source = write_transforms(tmp_path / "source", few)
    change_json(source / "transforms.json", change)
    refuse(source, tmp_path / "capture", kind, words)


def test_errors_carry_their_values(few: KnownScan, tmp_path: Path) -> None:
    source = write_transforms(tmp_path / "source", few)
    change_json(source / "transforms.json", set_pose(3, MIRROR))
    error = refuse(source, tmp_path / "capture", ScanPoseError)
    assert isinstance(error, ScanPoseError)
    assert error.image == few.images[3].name
    assert error.determinant == pytest.approx(-1)
    assert error.exit_code == 3


@pytest.mark.parametrize("number", ["NaN", "1e999"])
def test_pose_that_is_not_finite(number: str, few: KnownScan, tmp_path: Path) -> None:
    source = write_transforms(tmp_path / "source", few)
    change_json(source / "transforms.json", set_pose(3, np.full((4, 4), 7.25).tolist()))
    path = source / "transforms.json"
    path.write_text(path.read_text("utf-8").replace("7.25", number), "utf-8")
    kind = MalformedFileError if number == "NaN" else NonFiniteError
    refuse(source, tmp_path / "capture", kind)


def test_frames_without_pose_are_named(few: KnownScan, tmp_path: Path) -> None:
    source = write_transforms(tmp_path / "source", few)
    change_json(source / "transforms.json", frames(lambda items: items[3].pop("transform_matrix")))
    _, done, _ = import_scan(source, tmp_path / "capture", 0, silent)
    assert "1 of 12 images have no pose" in done.warnings[0]
    assert few.images[3].name in done.warnings[0]
    assert done.poses is not None
    assert len(done.poses.Ts_scan_cam) == 11


def test_missing_images_are_left_out(few: KnownScan, tmp_path: Path) -> None:
    scan = KnownScan((*few.images, few.images[0]), (*few.poses, few.poses[0]), 640, 480, few.intrinsics)
    source = write_transforms(tmp_path / "source", scan)
    change_json(
        source / "transforms.json", frames(lambda items: items[12].update(file_path="images/none.jpg"))
    )
    _, done, _ = import_scan(source, tmp_path / "capture", 0, silent)
    assert len(done.names) == 12
    assert done.warnings == ("1 of 13 images are missing (images/none.jpg)",)


def test_keyframe_without_camera_has_no_pose(few: KnownScan, tmp_path: Path) -> None:
    source = write_polycam(tmp_path / "source", few)
    (source / "keyframes" / "corrected_cameras" / f"{few.images[3].stem}.json").unlink()
    _, done, _ = import_scan(source, tmp_path / "capture", 0, silent)
    assert few.images[3].name in done.warnings[0]


def test_camera_file_without_a_number(few: KnownScan, tmp_path: Path) -> None:
    source = write_polycam(tmp_path / "source", few)
    file = source / "keyframes" / "corrected_cameras" / f"{few.images[3].stem}.json"
    change_json(file, lambda data: data.update(t_12=None))
    refuse(source, tmp_path / "capture", MalformedFileError, file.name, "'t_12'")


def test_frames_and_poses_of_different_number(few: KnownScan, tmp_path: Path) -> None:
    source = write_record3d(tmp_path / "source", few)
    change_json(source / "metadata.json", lambda data: data["poses"].pop())
    refuse(source, tmp_path / "capture", IncompleteCaptureError, "11 poses for 12 frames")


def test_quaternion_without_length(few: KnownScan, tmp_path: Path) -> None:
    source = write_record3d(tmp_path / "source", few)
    change_json(source / "metadata.json", lambda data: data["poses"].__setitem__(3, [0, 0, 0, 0, 1, 2, 3]))
    refuse(source, tmp_path / "capture", NonFiniteError, "pose 3")


@pytest.mark.parametrize(
    ("old", "new", "kind"),
    [
        ("PINHOLE", "BIRDHOLE", UnknownCameraModelError),
        ("640 480", "640", MalformedFileError),
        ("600.25", "nan", NonFiniteError),
        ("600.25", "x", MalformedFileError),
    ],
)
def test_cameras_of_colmap(
    old: str, new: str, kind: type[AomgenError], few: KnownScan, tmp_path: Path
) -> None:
    source = write_colmap(tmp_path / "source", few, text=True)
    path = source / "sparse" / "0" / "cameras.txt"
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new), "utf-8")
    error = refuse(source, tmp_path / "capture", kind, "cameras.txt")
    if isinstance(error, UnknownCameraModelError):
        assert error.model == "BIRDHOLE"
        assert "OPENCV" in error.known


def test_image_of_colmap_is_missing(few: KnownScan, tmp_path: Path) -> None:
    source = write_colmap(tmp_path / "source", few, text=False)
    (source / "images" / few.images[3].name).unlink()
    refuse(source, tmp_path / "capture", MissingFileError, few.images[3].name)


def test_source_that_is_missing_or_one_file(few: KnownScan, tmp_path: Path) -> None:
    refuse(tmp_path / "none", tmp_path / "capture", MissingFileError, "give a folder of photos")
    refuse(few.images[0], tmp_path / "capture", MalformedFileError, "one file of a scan")


def test_read_only_target(few: KnownScan, tmp_path: Path, monkeypatch) -> None:
    source = write_photos(tmp_path / "source", few)

    def refuse_folder(path: Path, *args, **options) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("aomgen.io.atomic._new_folder", refuse_folder)
    error = refuse(source, tmp_path / "capture", StorageError, "Permission denied")
    assert error.exit_code == 6


def test_existing_scan_is_kept(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    scan = write_photos(tmp_path / "capture" / "scan", few)
    refuse(source, tmp_path / "capture", ConfigError, "exists already")
    assert len(list(scan.iterdir())) == 12


def test_capture_with_other_tables_keeps_them(few: KnownScan, tmp_path: Path) -> None:
    source = write_transforms(tmp_path / "source", few)
    capture = tmp_path / "capture"
    capture.mkdir()
    text = 'format = 1\nname = "a"  # mine\r\n\n[scan]\nimages = "old"\n# a note\n\n[robot]\nmodel = "ur5e_2f85"\n'
    (capture / "capture.toml").write_bytes(text.encode())
    _, _, is_new = import_scan(source, capture, 0, silent)
    have = (capture / "capture.toml").read_bytes().decode()
    assert not is_new
    scan = 'images = "scan"\nintrinsics = [600.25, 599.5, 320.125, 239.75]\n'
    assert have == text.replace('images = "old"\n', scan)


def test_table_that_is_no_lines_is_refused(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    capture = tmp_path / "capture"
    capture.mkdir()
    (capture / "capture.toml").write_text('scan = { images = "old" }\n', "utf-8")
    refuse(source, capture, ConfigError, "capture.toml")
    assert [path.name for path in capture.iterdir()] == ["capture.toml"]


def write_poses(folder: Path, data: object) -> Path:
    path = folder / SCAN_POSES_FILE
    path.write_text(json.dumps(data), "utf-8")
    return path


def test_poses_of_a_capture_are_checked(tmp_path: Path) -> None:
    identity = np.eye(4).tolist()
    path = write_poses(tmp_path, {"format": 1, "metric": True, "T_scan_cam": {"a.jpg": identity}})
    assert read_scan_poses(path).metric
    for data, kind in (
        ({"format": 1, "T_scan_cam": {"a.jpg": MIRROR}}, ScanPoseError),
        ({"format": 1, "T_scan_cam": {"a.jpg": SHEAR}}, ScanPoseError),
        ({"format": 2, "T_scan_cam": {}}, MalformedFileError),
        ({"format": 1, "poses": {}, "T_scan_cam": {}}, MalformedFileError),
        ([], MalformedFileError),
    ):
        with pytest.raises(kind):
            read_scan_poses(write_poses(tmp_path, data))
