"""Reading a capture folder: everything is validated before any work starts."""

from pathlib import Path

import numpy as np

from aomgen.capture.joint_csv import read_joint_log
from aomgen.capture.manifest import (
    CameraSection,
    CaptureManifest,
    HandSection,
    PromptSection,
    ScanSection,
    read_manifest,
)
from aomgen.core.joint_log import JointLog
from aomgen.core.lens import Lens
from aomgen.core.recording import Capture, DemoCamera, Intrinsics, Prompt, frame_name
from aomgen.core.robot_choice import HandChoice, RobotChoice
from aomgen.errors import (
    CalibrationError,
    IncompleteCaptureError,
    InputError,
    MalformedFileError,
    MissingFileError,
)
from aomgen.io.images import image_size
from aomgen.io.paths import resolve_inside
from aomgen.io.robot_xml import read_robot_xml
from aomgen.io.video import probe_video

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
MIN_SCAN_IMAGES = 12
# Two seconds of video; a walk around the scene takes ten times as long.
MIN_SCAN_FRAMES = 60
# The log's first rows are averaged over this time to beat encoder noise while the arm rests.
REST_S = 0.1
# A principal point further than this from the middle (share of the size) is another image's.
MAX_PRINCIPAL_SHIFT = 0.2


def read_capture(folder: Path) -> Capture:
    """Read and check one capture folder; videos are named here and decoded by `check_video`.

    Raises:
        InputError: Of the kind that fits, naming the file, the place and the remedy.
    """
    if not folder.is_dir():
        raise MissingFileError(folder, "is not a folder", "give the folder that holds capture.toml")
    path = folder / "capture.toml"
    manifest = read_manifest(path)
    scan = resolve_inside(folder, manifest.scan.images, named_by=path)
    video = scan if scan.is_file() else None
    images = () if video else _scan_images(scan)
    size, names = _video_frames(video) if video else (_common_size(images), {item.name for item in images})
    log = read_joint_log(
        resolve_inside(folder, manifest.demo.joints, named_by=path),
        manifest.robot.joints,
        manifest.robot.gripper,
    )
    scan_intrinsics = _intrinsics(manifest.scan, f"{path}: scan")
    if scan_intrinsics:
        check_intrinsics(scan_intrinsics, size, f"{path}: scan.intrinsics")
    masks = folder / "masks"
    # A hidden folder is one that is still being written.
    visible = [item for item in sorted(masks.glob("[!.]*")) if item.is_dir()]
    mask_folders = {item.name: item for item in visible}
    return Capture(
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
        clock_offset_s=manifest.demo.clock_offset_s,
        prompts=_prompts(manifest.prompts, names, size, path, has_masks=bool(mask_folders)),
        mask_folders=mask_folders,
    )


def check_intrinsics(intrinsics: Intrinsics, size: tuple[int, int], where: str) -> None:
    """Refuse intrinsics that belong to another image size.

    Raises:
        CalibrationError: Principal point far off the middle, focal length outside 0.2..8 widths,
            fx and fy differing by more than 20 %, or a distortion that folds the image back.
    """
    width, height = size
    shift = max(abs(intrinsics.cx / width - 0.5), abs(intrinsics.cy / height - 0.5))
    if not shift <= MAX_PRINCIPAL_SHIFT:
        raise CalibrationError(
            where,
            f"principal point ({intrinsics.cx:g}, {intrinsics.cy:g}) does not fit {width} x {height} images",
            "scale the intrinsics to the image size",
        )
    if not (0.2 * width <= intrinsics.fx <= 8 * width and 0.8 <= intrinsics.fx / intrinsics.fy <= 1.25):
        raise CalibrationError(
            where,
            f"focal lengths ({intrinsics.fx:g}, {intrinsics.fy:g}) do not fit {width} x {height} images",
            "scale the intrinsics to the image size",
        )
    if intrinsics.distortion is not None:
        k1, k2, p1, p2 = intrinsics.distortion
        lens = Lens(
            fx=intrinsics.fx,
            fy=intrinsics.fy,
            cx=intrinsics.cx,
            cy=intrinsics.cy,
            width=width,
            height=height,
            k1=k1,
            k2=k2,
            p1=p1,
            p2=p2,
        )
        if not lens.valid:
            raise CalibrationError(
                where,
                f"distortion {list(intrinsics.distortion)} folds the image's border back",
                "want k1, k2, p1, p2 of OpenCV's model",
            )


def _scan_images(scan: Path) -> tuple[Path, ...]:
    images = tuple(sorted(item for item in scan.iterdir() if item.suffix.lower() in IMAGE_SUFFIXES))
    if not len(images) >= MIN_SCAN_IMAGES:
        raise IncompleteCaptureError(
            scan,
            f"holds {len(images)} images, at least {MIN_SCAN_IMAGES} are needed",
            "scan from more viewpoints",
        )
    return images


def _common_size(images: tuple[Path, ...]) -> tuple[int, int]:
    first = image_size(images[0])
    for image in images[1:]:
        size = image_size(image)
        if size != first:
            raise CalibrationError(
                image,
                f"is {size[0]} x {size[1]}, but {images[0].name} is {first[0]} x {first[1]}",
                "export all scan images at one size",
            )
    return first


def _video_frames(scan: Path) -> tuple[tuple[int, int], set[str]]:
    """Size of a scan video and the names its frames would have, from its header."""
    info = probe_video(scan)
    if not info.frames >= MIN_SCAN_FRAMES:
        raise IncompleteCaptureError(
            scan,
            f"has {info.frames} frames, at least {MIN_SCAN_FRAMES} are needed",
            "walk around robot and object for 20 to 60 s",
        )
    return (info.width, info.height), {frame_name(index) for index in range(info.frames)}


def _intrinsics(section: ScanSection | CameraSection, where: str) -> Intrinsics | None:
    if section.intrinsics is None:
        if section.distortion is not None:
            raise CalibrationError(
                where, "has distortion without intrinsics", "give both, as they were calibrated together"
            )
        return None
    fx, fy, cx, cy = section.intrinsics
    if section.distortion is None:
        return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy)
    k1, k2, p1, p2 = section.distortion
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, distortion=(k1, k2, p1, p2))


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
                "list one a joint",
            )
    model_file = resolve_inside(folder, files[0], named_by=path) if files else None
    hand = robot.hand
    if len(hand.fingers) == 1:
        raise MalformedFileError(path, "robot.hand.fingers names one body", "name the left and the right one")
    if robot.model and hand != HandSection():
        raise MalformedFileError(path, f"[robot.hand] does not go with model = '{robot.model}'", "remove it")
    return RobotChoice(
        model=robot.model,
        model_file=model_file,
        root=folder,
        references=read_robot_xml(model_file, folder).references if model_file else (),
        base_frame=robot.base_frame,
        joints=tuple(robot.joints),
        hand=HandChoice(
            open=hand.open, closed=hand.closed, fingers=tuple(hand.fingers), ee_site=hand.ee_site
        ),
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
    for camera in cameras:
        if camera.T_world_cam is not None:
            R = camera.T_world_cam[:3, :3]
            if not (np.allclose(R @ R.T, np.eye(3), atol=1e-4) and np.linalg.det(R) > 0):
                raise CalibrationError(
                    path,
                    f"T_world_cam of '{camera.name}' is not a rotation and a translation",
                    "export it again",
                )
    return cameras


def _prompts(
    sections: list[PromptSection],
    names: set[str],
    size: tuple[int, int],
    path: Path,
    *,
    has_masks: bool,
) -> tuple[Prompt, ...]:
    prompts = []
    for section in sections:
        if section.image not in names:
            raise MissingFileError(
                path,
                f"a prompt names '{section.image}', which is not a scan image",
                f"correct the name (known: {min(names)} to {max(names)})",
            )
        if not section.points and section.box is None:
            raise InputError(
                path, f"the prompt on '{section.image}' has neither points nor a box", "click once"
            )
        points = np.array(section.points, np.float64).reshape(-1, 3)
        box = np.array([] if section.box is None else section.box)
        pixels = np.concatenate([points[:, :2], box.reshape(-1, 2)])
        if not (np.all(pixels >= 0) and np.all(pixels <= np.array(size))):
            raise InputError(
                path,
                f"a prompt on '{section.image}' lies outside {size[0]} x {size[1]}",
                "click inside the image",
            )
        prompts.append(Prompt(part=section.part, image=section.image, points=points, box=box))
    missing = {"moving", "static"} - {prompt.part for prompt in prompts}
    if missing and not has_masks:
        raise InputError(
            path,
            f"has no prompt for the {' and the '.join(sorted(missing))} part",
            "add a [[prompts]] entry with a box or a point on one scan image",
        )
    return tuple(prompts)
