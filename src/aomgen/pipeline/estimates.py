"""`estimates.json`: everything a run estimated about the recording, so that anybody can score it."""

from pathlib import Path
from typing import Any, Final

from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.motion import MotionEstimate
from aomgen.core.recording import Capture
from aomgen.core.values import Array

# What a refused motion leaves of it.
NO_MOTION: Final[dict[str, Any]] = {
    "clock_offset_s": None,
    "clock_offset_sd_s": None,
    "start_s": None,
    "end_s": None,
    "joint": None,
    "direction": None,
    "theta": None,
    "contacts": [],
}

# The motion score of a demonstration that was refused, and the page about it.
REFUSED_MOTION, REFUSED_FILE = "refused_motion.json", "refused.html"


def forget_refusal(out: Path) -> None:
    """Take away what an earlier run of a folder left that was refused."""
    for name in (REFUSED_MOTION, REFUSED_FILE):
        (out / name).unlink(missing_ok=True)


def estimates_of(
    capture: Capture,
    cameras_recon: dict[str, Camera],
    demo_cameras_world: dict[str, Camera],
    S_world_recon: Array,
    motion: MotionEstimate | None,
    refusals: list[dict[str, str]],
) -> dict[str, Any]:
    """Content of estimates.json, world frame and SI units, as the capture format defines it.

    Args:
        capture: The recording.
        cameras_recon: Registered scan images; what is not in it is written as null.
        demo_cameras_world: Fixed cameras.
        S_world_recon: Similarity (4, 4).
        motion: The recovered motion, or None when it was refused.
        refusals: {quantity, reason} of what was refused.
    """
    scan = {
        path.name: camera_in_world(S_world_recon, cameras_recon[path.name]).T_world_cam.tolist()
        if path.name in cameras_recon
        else None
        for path in capture.scan_images
    }
    common = {
        "format": 1,
        "capture": capture.name,
        "S_world_recon": S_world_recon.tolist(),
        "scan": scan,
        "demo_cameras": {name: camera.T_world_cam.tolist() for name, camera in demo_cameras_world.items()},
        "refusals": refusals,
    }
    if motion is None:
        return common | NO_MOTION
    return common | motion_estimates(motion)


def motion_estimates(motion: MotionEstimate) -> dict[str, Any]:
    """What `estimates.json` says of a recovered motion."""
    joint = motion.joint
    return {
        "clock_offset_s": motion.clock_offset_s,
        "clock_offset_sd_s": motion.clock_offset_sd_s,
        "start_s": motion.start_s,
        "end_s": motion.end_s,
        "joint": {
            "type": joint.type,
            "axis": joint.axis.tolist(),
            "origin": joint.origin.tolist(),
            "observed_range": [joint.lower, joint.upper],
            "axis_sd_rad": motion.axis_sd_rad,
            "origin_sd_m": motion.origin_sd_m,
            "axis_ci95_rad": motion.axis_ci95_rad,
            "origin_ci95_m": motion.origin_ci95_m,
        },
        "direction": motion.direction,
        "theta": {
            "times_s": motion.times_s.tolist(),
            "values": motion.thetas.tolist(),
            "sd": motion.theta_sd.tolist(),
        },
        "contacts": [
            {"finger": patch.finger, "point": patch.point.tolist(), "normal": patch.normal.tolist()}
            for patch in motion.contacts
        ],
    }
