"""Reading a capture folder: everything is validated before any work starts."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from aomgen.capture.capture_schema import (
    CameraSection,
    CaptureManifest,
    ScanSection,
    read_manifest,
)
from aomgen.capture.joint_log import REST_S, read_joint_log
from aomgen.capture.prompts import list_proposals, read_prompts
from aomgen.capture.scan_images import common_size, find_images
from aomgen.capture.scan_poses import SCAN_POSES_FILE, read_scan_poses
from aomgen.core.recording import (
    CAPTURE_FILE,
    DemoCamera,
    Intrinsics,
    JointLog,
    Recording,
    RobotChoice,
    frame_name,
)
from aomgen.core.values import Array
from aomgen.errors import (
    CalibrationError,
    IncompleteCaptureError,
    MalformedFileError,
    MissingFileError,
    UnitsError,
)
from aomgen.io.paths import resolve_inside
from aomgen.io.video import probe_video
from aomgen.robots.description import robot_references

# Two seconds of video; a walk around the scene takes ten times as long.
MIN_SCAN_FRAMES = 60
# No camera records a table-top arm from further away; calibrations in millimetres pass it at once.
MAX_CAMERA_DISTANCE_M = 20.0
# A principal point further than this from the middle (share of the size) is another image's.
MAX_PRINCIPAL_SHIFT = 0.2
# A principal point that is this much nearer to the middle of the image turned by a quarter is that image's.
MIN_TURNED_SHARE = 0.3


def read_capture(folder: Path, *, complete: bool = True) -> Recording:
    """Read and check one capture folder; what has to be decoded is left to `capture_check.check_capture`.

    Args:
        complete: Whether every part must have a prompt.

    Raises:
        InputError: A subclass that names the file, the location and the remedy.
    """
    if not folder.is_dir():
        raise MissingFileError(folder, "is not a folder", "give the folder that holds capture.toml")
    path = folder / CAPTURE_FILE
    manifest = read_manifest(path)
    scan = resolve_inside(folder, manifest.scan.images, named_by=path)
    video = scan if scan.is_file() else None
    images = () if video else find_images(scan)
    size, names = measure_scan(images, video)
    log_file = resolve_inside(folder, manifest.demo.joints, named_by=path)
    log, notes = read_joint_log(
        log_file, manifest.robot.joints, manifest.robot.gripper, _gripper_range(manifest, path)
    )
    scan_intrinsics = _intrinsics(manifest.scan, f"{path}: scan")
    if scan_intrinsics:
        check_intrinsics(scan_intrinsics, size, f"{path}: scan.intrinsics")
    poses_file = scan / SCAN_POSES_FILE
    # A hidden folder is one that is still being written.
    mask_folders = {item.name: item for item in sorted((folder / "masks").glob("[!.]*")) if item.is_dir()}
    return Recording(
        folder=folder,
        name=manifest.name,
        category=manifest.category,
        instruction=manifest.instruction,
        robot=_robot(folder, manifest, log, path),
        scan_images=images,
        scan_video=video,
        scan_size=size,
        scan_intrinsics=scan_intrinsics,
        cameras=_cameras(folder, manifest, path),
        joint_log=log,
        joint_log_file=log_file,
        clock_offset_s=manifest.demo.clock_offset_s,
        prompts=read_prompts(manifest.prompts, names, size, path, complete=complete),
        mask_folders=mask_folders,
        notes=(*notes, *list_proposals(manifest.prompts)),
        scan_poses=read_scan_poses(poses_file) if video is None and poses_file.is_file() else None,
    )


def _gripper_range(manifest: CaptureManifest, path: Path) -> tuple[float, ...]:
    stated = tuple(manifest.robot.gripper_range or ())
    if len(set(stated)) == 1:
        raise MalformedFileError(
            path,
            f"robot.gripper_range = {list(stated)} has two equal values",
            "give the values of open and closed",
        )
    return stated


def check_intrinsics(intrinsics: Intrinsics, size: tuple[int, int], where: str) -> None:
    """Refuse intrinsics that belong to another image size.

    Raises:
        CalibrationError: Principal point far off the middle, focal length outside 0.2..8 widths,
            fx and fy differing by more than 20 %, or a distortion that folds the image back.
    """
    width, height = size
    shift = max(abs(intrinsics.cx / width - 0.5), abs(intrinsics.cy / height - 0.5))
    turned = max(abs(intrinsics.cx / height - 0.5), abs(intrinsics.cy / width - 0.5))
    if not shift <= MAX_PRINCIPAL_SHIFT or (width != height and turned < MIN_TURNED_SHARE * shift):
        sideways = turned <= MAX_PRINCIPAL_SHIFT
        raise CalibrationError(
            where,
            f"principal point ({intrinsics.cx:g}, {intrinsics.cy:g}) does not fit {width} x {height} images"
            + (f", but {height} x {width} ones" * sideways),
            "give those of the upright image" if sideways else "scale the intrinsics to the image size",
        )
    if not (0.2 * width <= intrinsics.fx <= 8 * width and 0.8 <= intrinsics.fx / intrinsics.fy <= 1.25):
        raise CalibrationError(
            where,
            f"focal lengths ({intrinsics.fx:g}, {intrinsics.fy:g}) do not fit {width} x {height} images",
            "scale the intrinsics to the image size",
        )
    if not intrinsics.lens(width, height).valid:
        raise CalibrationError(
            where,
            f"distortion {list(intrinsics.distortion or ())} maps two image points to one direction",
            "give k1, k2, p1, p2 of OpenCV's model",
        )


def measure_scan(images: tuple[Path, ...], video: Path | None) -> tuple[tuple[int, int], set[str]]:
    """Return width and height of a scan's images, or of the frames of its video, [px], and their names.

    Raises:
        InputError: Images of several sizes, a file that cannot be read, or a video that is too short.
    """
    if video is None:
        return common_size(images), {item.name for item in images}
    info = probe_video(video)
    if not info.frames >= MIN_SCAN_FRAMES:
        raise IncompleteCaptureError(
            video,
            f"has {info.frames} frames, at least {MIN_SCAN_FRAMES} are needed",
            "walk around robot and object for 20 to 60 s",
        )
    return (info.width, info.height), {frame_name(index) for index in range(info.frames)}


def _intrinsics(section: ScanSection | CameraSection, where: str) -> Intrinsics | None:
    if section.intrinsics is None:
        for key in ("distortion", "calibrated"):
            if getattr(section, key):
                raise CalibrationError(
                    where, f"has {key} without intrinsics", "give both, as they were calibrated together"
                )
        return None
    fx, fy, cx, cy = section.intrinsics
    known = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, calibrated=section.calibrated)
    if section.distortion is None:
        return known
    k1, k2, p1, p2 = section.distortion
    return replace(known, distortion=(k1, k2, p1, p2))


def _robot(folder: Path, manifest: CaptureManifest, log: JointLog, path: Path) -> RobotChoice:
    robot = manifest.robot
    files = [name for name in (robot.urdf, robot.mjcf) if name]
    if bool(robot.model) + len(files) != 1:
        raise MalformedFileError(
            path, "[robot] must name exactly one of model, urdf, mjcf", "keep one of them"
        )
    rest = log.times_s <= log.times_s[0] + REST_S
    if robot.scan_state == "first_row":
        scan_joints = np.median(log.joints[rest], axis=0)
    else:
        scan_joints = np.array(robot.scan_state)
        if len(scan_joints) != len(robot.joints):
            raise MalformedFileError(
                path,
                f"robot.scan_state has {len(scan_joints)} values for {len(robot.joints)} joints",
                "list one for each joint",
            )
    model_file = resolve_inside(folder, files[0], named_by=path) if files else None
    return RobotChoice(
        model=robot.model,
        model_file=model_file,
        root=folder,
        references=robot_references(model_file, folder) if model_file else (),
        base_frame=robot.base_frame,
        joints=tuple(robot.joints),
        scan_joints=scan_joints,
        scan_gripper=float(np.median(log.gripper[rest])),
    )


def _cameras(folder: Path, manifest: CaptureManifest, path: Path) -> tuple[DemoCamera, ...]:
    cameras = tuple(
        DemoCamera(
            name=section.name,
            video=resolve_inside(folder, section.video, named_by=path),
            intrinsics=_intrinsics(section, f"{path}: demo.cameras.{section.name}"),
            T_world_cam=None if section.T_world_cam is None else np.array(section.T_world_cam),
        )
        for section in manifest.demo.cameras
    )
    names = [camera.name for camera in cameras]
    if len(set(names)) != len(names):
        raise MalformedFileError(
            path,
            f"gives two of demo.cameras the same name ({', '.join(names)})",
            "give each a different name",
        )
    for camera in cameras:
        if camera.T_world_cam is not None:
            _check_calibration(camera.T_world_cam, f"{path}: demo.cameras.{camera.name}.T_world_cam")
    return cameras


def _check_calibration(T_world_cam: Array, where: str) -> None:
    R, bottom = T_world_cam[:3, :3], T_world_cam[3]
    turns = np.allclose(R @ R.T, np.eye(3), atol=1e-4) and np.linalg.det(R) > 0
    if not (turns and np.allclose(bottom, [0, 0, 0, 1])):
        raise CalibrationError(where, "is not a rotation and a translation", "export it again, by rows")
    distance = float(np.linalg.norm(T_world_cam[:3, 3]))
    if not distance <= MAX_CAMERA_DISTANCE_M:
        raise UnitsError(
            where,
            f"puts the camera {distance:.0f} m from the robot, limit {MAX_CAMERA_DISTANCE_M:.0f} m; is the "
            "unit millimeters?",
            "give the translation in meters",
        )
