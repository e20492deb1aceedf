"""`python -m benchmarks imports`: a capture that is written in other formats and imported, against the capture itself."""

import hashlib
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.capture.read import read_capture
from aomgen.core.progress import silent
from aomgen.core.project import Project
from aomgen.core.recording import JointLog
from aomgen.importers.import_demo import ImportOptions, import_demo
from aomgen.importers.scan_import import import_scan
from aomgen.io.artifact import read_json
from aomgen.io.images import image_size, read_image
from aomgen.io.video import read_video
from aomgen.motion.estimates_file import ESTIMATES
from aomgen.pipeline.manifest import read_manifest, write_manifest
from aomgen.pipeline.runner import results_of, share_stages
from aomgen.pipeline.stages import STAGES, capture_digest
from benchmarks.accuracy import score_estimates
from benchmarks.truth import Truth, read_truth

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from foreign_recordings import (
    EPOCH_S,
    RTDE_START_S,
    BagWriter,
    Demonstration,
    read_annex_b,
    write_lerobot_v3,
    write_rtde,
)
from foreign_scans import KnownScan, write_colmap, write_transforms
from heic_file import heic_bytes

LAST_STAGE: Final = "motion"
NATIVE: Final = "native"
# Metrics of `score_estimates` that are compared, with the names under which they are printed.
METRICS: Final = {
    "joint.axis_deg": "axis_deg",
    "joint.origin_mm": "origin_mm",
    "alignment.end_effector_mm": "end_effector_mm",
    "clock_offset_ms_error": "clock_ms",
}
# Decimal digits of poses and intrinsics that every format keeps.
KEPT_DIGITS: Final = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """Recording of a capture for the writers of other formats.

    Attributes:
        capture: Folder of the original.
        video: Its one video, with the joint values at the times of the frames.
        log: All rows of the log, on the clock of the video.
        scan: Images and poses of the native run.
    """

    capture: Path
    video: Demonstration
    log: JointLog
    scan: KnownScan


# Import one format into a copy of the capture that lacks this part; the clock offset of the imported log, [s].
Import = Callable[[Recorded, Path, Path], float]


def run_imports(
    capture: Path, folder: Path, run_project: Callable[..., None], report: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Score a capture natively and after the import of every format.

    A run whose images, poses and frames are those of an earlier one takes its stages structure and Gaussians.

    Args:
        capture: With `truth/`, one demonstration camera, and intrinsics of the scan.
        folder: Keeps captures and runs; continued when it exists.
        run_project: Runs a project up to a stage.
        report: Receives the progress.

    Returns:
        The metrics of the native run, and of every format those minus the native ones.
    """
    truth = read_truth(capture)
    native = folder / NATIVE
    found = _run(capture, native, {}, run_project, truth)
    rows = [{"format": NATIVE} | found]
    reusable = {digest_scene(capture): native}
    recorded = _record(capture, native, truth)
    for name, bring in FORMATS.items():
        report(name)
        source, imported = folder / f"{name} source", folder / f"{name} capture"
        if imported.exists():
            shutil.rmtree(imported)
        shutil.rmtree(source, ignore_errors=True)
        shutil.copytree(capture, imported, ignore=shutil.ignore_patterns("truth"))
        offset_s = bring(recorded, source, imported)
        known = replace(truth, clock_offset_s=truth.clock_offset_s if np.isnan(offset_s) else offset_s)
        scored = _run(imported, folder / name, reusable, run_project, known)
        reusable.setdefault(digest_scene(imported), folder / name)
        rows.append({"format": name} | {metric: scored[metric] - found[metric] for metric in found})
    return rows


def _run(
    capture: Path, out: Path, reusable: dict[str, Path], run_project: Callable[..., None], truth: Truth
) -> dict[str, float]:
    """Run a capture, and score its estimates against the truth."""
    equal = reusable.get(digest_scene(capture))
    if equal is not None and not out.exists():
        take_scene(equal, out, capture_digest(read_capture(capture)))
    project = Project(capture=capture.resolve(), out=out.resolve())
    run_project(project, until=LAST_STAGE)
    results = results_of(project, STAGES)
    name = results.demo_camera
    scored = score_estimates(
        read_json(out / ESTIMATES), truth, results.robot, results.videos[name].times_s, name
    )
    return {short: scored[metric] for metric, short in METRICS.items()}


def digest_scene(capture: Path) -> str:
    """Digest of what the stages structure and Gaussians read of a capture, as it is decoded."""
    recording = read_capture(capture)
    digest = hashlib.sha256()
    poses = recording.scan_poses.Ts_scan_cam if recording.scan_poses else {}
    for path in recording.scan_images:
        digest.update(path.name.encode())
        digest.update(read_image(path).tobytes())
        digest.update((np.round(poses.get(path.name, np.zeros((4, 4))), KEPT_DIGITS) + 0.0).tobytes())
    for camera in recording.cameras:
        digest.update(read_video(camera.video).frames_srgb.tobytes())
        digest.update(repr((camera.name, camera.intrinsics)).encode())
    digest.update(repr(recording.scan_intrinsics).encode())
    return digest.hexdigest()


def take_scene(finished: Path, out: Path, digest: str) -> None:
    """Take the stages structure and Gaussians of a run over into one of an equal capture."""
    stages = STAGES[:2]
    share_stages((finished / stage.folder for stage in stages), out)
    for stage in stages:
        folder = out / stage.folder
        manifest = read_manifest(folder)
        if manifest is None:
            raise ValueError(f"{folder} is not finished")
        version, inputs, parameters = manifest.identity
        identity = (version, inputs | {"capture": digest}, parameters)
        write_manifest(folder, stage.name, identity, manifest.figures, manifest.warnings)


def _record(capture: Path, native: Path, truth: Truth) -> Recorded:
    recording = read_capture(capture)
    (camera,), log = recording.cameras, recording.joint_log
    video = read_video(camera.video)
    joints, gripper = log.at(video.times_s + truth.clock_offset_s)
    cameras = results_of(Project(capture=capture, out=native), STAGES).structure.cameras_recon
    if recording.scan_intrinsics is None:
        raise ValueError(f"{capture} states no intrinsics of its scan")
    given = recording.scan_intrinsics
    images = tuple(path for path in recording.scan_images if path.name in cameras)
    width, height = image_size(images[0])
    return Recorded(
        capture=capture,
        video=Demonstration(video.times_s, joints, gripper, video.frames_srgb, camera.video),
        log=replace(log, times_s=log.times_s - truth.clock_offset_s),
        scan=KnownScan(
            images=images,
            poses=tuple(cameras[path.name].T_world_cam for path in images),
            width=width,
            height=height,
            intrinsics=(given.fx, given.fy, given.cx, given.cy),
        ),
    )


def _import_lerobot(recorded: Recorded, source: Path, capture: Path) -> float:
    """State at the rate of the video, on its clock."""
    write_lerobot_v3(source, recorded.video)
    import_demo(source, capture, 1, ImportOptions(replace=True))
    return 0.0


def _import_mcap(recorded: Recorded, source: Path, capture: Path) -> float:
    """Joint states at the rate of the driver, video as H.264, both with stamps of one clock."""
    log = recorded.log
    messages: list[tuple[float, bytes | int]] = [(time_s, row) for row, time_s in enumerate(log.times_s)]
    messages += zip(recorded.video.times_s.tolist(), read_annex_b(recorded.video.video), strict=True)
    with BagWriter(source, "mcap") as bag:
        for time_s, message in sorted(messages, key=lambda item: item[0]):
            if isinstance(message, bytes):
                bag.write_h264("/front/video", time_s, message)
            else:
                values = [*log.joints[message], log.gripper[message]]
                bag.write_joints("/joint_states", time_s, [*log.joint_names, "gripper"], values)
    import_demo(source, capture, 0, ImportOptions(replace=True))
    return EPOCH_S


def _import_rtde(recorded: Recorded, source: Path, capture: Path) -> float:
    """All rows on the clock of the controller, with a video file."""
    log, video = recorded.log, recorded.video
    source.mkdir()
    path = write_rtde(
        source / "record.csv",
        Demonstration(log.times_s, log.joints, log.gripper, video.frames, video.video),
    )
    options = ImportOptions(
        gripper_column="output_int_register_24", cameras=(f"front={video.video}",), replace=True
    )
    import_demo(path, capture, 0, options)
    return RTDE_START_S


def _import_transforms(recorded: Recorded, source: Path, capture: Path) -> float:
    return _import_scan(write_transforms(source, recorded.scan), capture)


def _import_colmap(recorded: Recorded, source: Path, capture: Path) -> float:
    return _import_scan(write_colmap(source, recorded.scan, text=False), capture)


def _import_heic(recorded: Recorded, source: Path, capture: Path) -> float:
    """Photos that are compressed again and state no focal length."""
    source.mkdir()
    for path in recorded.scan.images:
        (source / f"{path.stem}.heic").write_bytes(heic_bytes(read_image(path)))
    return _import_scan(source, capture)


def _import_scan(source: Path, capture: Path) -> float:
    shutil.rmtree(capture / "scan")
    import_scan(source, capture, 0, silent)
    return float("nan")


FORMATS: Final[dict[str, Import]] = {
    "LeRobot v3.0": _import_lerobot,
    "MCAP": _import_mcap,
    "RTDE CSV": _import_rtde,
    "transforms.json": _import_transforms,
    "COLMAP binary": _import_colmap,
    "HEIC photos": _import_heic,
}
