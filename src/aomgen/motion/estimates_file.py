"""`estimates.json`: all estimates of a run about the recording, for evaluation against ground truth."""

from pathlib import Path
from typing import Any, Final

from aomgen.core.motion import MotionEstimate
from aomgen.results import Results

# Entries of a refused motion.
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

ESTIMATES = "estimates.json"
# Files in the run's folder about a refused demonstration: its motion score, and the page about it.
REFUSED_MOTION, REFUSED_FILE = "refused_motion", "refused.html"


def forget_refusal(out: Path) -> None:
    """Remove the files that an earlier, refused run left in a folder."""
    for name in (f"{REFUSED_MOTION}.json", f"{REFUSED_MOTION}.npz", REFUSED_FILE):
        (out / name).unlink(missing_ok=True)


def describe_estimates(
    results: Results, motion: MotionEstimate | None, refusals: list[dict[str, str]]
) -> dict[str, Any]:
    """Describe the content of estimates.json, world frame and SI units, as the capture format defines it.

    Args:
        results: Results of a run that is finished up to its alignment.
        motion: The recovered motion, or None when it was refused.
        refusals: {quantity, reason} of every refused estimate.
    """
    capture, cameras = results.pinhole_capture, results.scan_cameras
    scan = {
        path.name: cameras[path.name].T_world_cam.tolist() if path.name in cameras else None
        for path in capture.scan_images
    }
    fixed = results.alignment.cameras
    return {
        "format": 1,
        "capture": capture.name,
        "S_world_recon": results.alignment.S_world_recon.tolist(),
        "scan": scan,
        "demo_cameras": {name: item.camera.T_world_cam.tolist() for name, item in fixed.items()},
        "refusals": refusals,
        **(NO_MOTION if motion is None else motion_estimates(motion)),
    }


def motion_estimates(motion: MotionEstimate) -> dict[str, Any]:
    """Return the entries of `estimates.json` about a recovered motion."""
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
