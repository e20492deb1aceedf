"""Scores of `estimates.json` against ground truth, with the definitions of the capture format.

A quantity that was refused (null) although the truth contains it scores None and is listed under
`refused`; it counts as a failure.
"""

from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from aomgen.core.transforms import angle_between, apply, invert, rotvec_from_matrix, similarity_parts
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from benchmarks.truth import Truth

# A camera centre with a larger error after robust alignment counts as misregistered.
MISREGISTERED_M = 0.05
CONTACT_WINDOW_S = 0.3
CONTACT_MIN_N = 1.0


def score_estimates(
    estimates: dict[str, Any], truth: Truth, robot: RobotModel, times_s: Array, camera: str
) -> dict[str, Any]:
    """Compute every metric that needs no rendering.

    Args:
        estimates: Content of estimates.json.
        truth: Ground truth of the capture.
        robot: The robot of the capture.
        times_s: Frame times (T,) of the camera's demonstration video.
        camera: Name of the demonstration camera that theta is scored on.

    Returns:
        Metrics by dotted name; None where the estimate was refused.
    """
    figures: dict[str, Any] = {}
    figures.update(_alignment(estimates, truth, robot))
    figures.update(_demo_camera(estimates, truth, camera))
    offset = estimates["clock_offset_s"]
    figures["clock_offset_ms_error"] = None if offset is None else 1e3 * abs(offset - truth.clock_offset_s)
    figures.update(score_motion(estimates, truth, times_s, camera))
    unasked = set() if _touches(truth, times_s) else {"contact_mm"}
    figures["refused"] = sorted(k for k, value in figures.items() if value is None and k not in unasked)
    return figures


def score_motion(estimates: dict[str, Any], truth: Truth, times_s: Array, camera: str) -> dict[str, Any]:
    """Compute the metrics of `score_estimates` on the part's motion: interval, contact, joint, values.

    Args:
        estimates: Its `start_s`, `end_s`, `contacts`, `joint` and `theta` are read.
        truth, times_s, camera: See `score_estimates`.
    """
    figures: dict[str, Any] = {}
    for name, frame in (("start", truth.start_frame), ("end", truth.end_frame)):
        value = estimates[f"{name}_s"]
        figures[f"keyframes.{name}_error_s"] = None if value is None else abs(value - times_s[frame])
    figures["contact_mm"] = _contact(estimates, truth, times_s)
    figures.update(_joint(estimates, truth))
    figures.update(_theta(estimates, truth, times_s, camera))
    return figures


def _alignment(estimates: dict[str, Any], truth: Truth, robot: RobotModel) -> dict[str, Any]:
    names = sorted(name for name, T in estimates["scan"].items() if T is not None and name in truth.scan)
    if estimates["S_world_recon"] is None or len(names) < 3:
        keys = ("end_effector_mm", "end_effector_mm_worst", "rotation_deg", "scale_pct")
        return {f"alignment.{key}": None for key in keys} | {
            "cameras.median_mm": None,
            "cameras.misregistered": [],
        }
    estimated = np.array([np.array(estimates["scan"][name])[:3, 3] for name in names])
    true = np.array([truth.scan[name][:3, 3] for name in names])
    # Estimated centres are S_est applied to the reconstruction, so the similarity from true to
    # estimated centres is E = S_est inv(S_true) itself.
    E, inliers = robust_similarity(true, estimated)
    scale, R, _ = similarity_parts(E)
    pinch = robot.ee_poses(truth.qpos)[:, :3, 3]
    errors_mm = 1e3 * np.linalg.norm(apply(E, pinch) - pinch, axis=1)
    return {
        "alignment.end_effector_mm": float(np.median(errors_mm)),
        "alignment.end_effector_mm_worst": float(errors_mm.max()),
        "alignment.rotation_deg": float(np.degrees(np.linalg.norm(rotvec_from_matrix(R)))),
        "alignment.scale_pct": 100 * abs(scale - 1),
        "cameras.median_mm": float(1e3 * np.median(np.linalg.norm(estimated - true, axis=1))),
        "cameras.misregistered": [name for name, good in zip(names, inliers, strict=True) if not good],
        "cameras.registered": len(names),
    }


def best_similarity(source: Array, target: Array) -> Array:
    """Fit the least-squares similarity S (4, 4) with `target ~ S(source)`, points (N, 3), N >= 3."""
    found = pycolmap.estimate_sim3d(source, target)
    if found is None:
        raise ValueError("the points lie on a line")
    return np.vstack([found.matrix(), [0, 0, 0, 1]])


def robust_similarity(source: Array, target: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Fit the least-squares similarity to the camera centres that agree with each other.

    The fit starts from the best of many minimal samples, because a misregistered camera may be metres off.
    """
    rng = np.random.default_rng(0)
    best = np.full(len(source), np.inf)
    for _ in range(200):
        pick = rng.choice(len(source), 4, replace=False)
        errors = np.linalg.norm(apply(best_similarity(source[pick], target[pick]), source) - target, axis=1)
        if np.median(errors) < np.median(best):
            best = errors
    inliers = best < max(MISREGISTERED_M, 5 * float(np.median(best)))
    S = best_similarity(source[inliers], target[inliers])
    for _ in range(5):
        errors = np.linalg.norm(apply(S, source) - target, axis=1)
        inliers = errors < MISREGISTERED_M
        S = best_similarity(source[inliers], target[inliers])
    return S, np.asarray(inliers)


def _demo_camera(estimates: dict[str, Any], truth: Truth, camera: str) -> dict[str, Any]:
    T = estimates["demo_cameras"].get(camera)
    if T is None:
        return {"demo_camera.mm": None, "demo_camera.deg": None}
    error = invert(truth.demo_cameras[camera]) @ np.array(T)
    return {
        "demo_camera.mm": float(1e3 * np.linalg.norm(error[:3, 3])),
        "demo_camera.deg": float(np.degrees(np.linalg.norm(rotvec_from_matrix(error[:3, :3])))),
    }


def _touches(truth: Truth, times_s: Array) -> list[dict[str, Any]]:
    """List true contacts that first move the part; empty where the gripper hardly presses."""
    start_s = times_s[truth.start_frame]
    frames = np.flatnonzero((times_s >= start_s) & (times_s <= start_s + CONTACT_WINDOW_S))
    return [item for frame in frames for item in truth.contacts[frame] if item["force"] >= CONTACT_MIN_N]


def _contact(estimates: dict[str, Any], truth: Truth, times_s: Array) -> float | None:
    touches = _touches(truth, times_s)
    if not estimates["contacts"] or not touches:
        return None
    true = np.average(
        [item["point"] for item in touches], axis=0, weights=[item["force"] for item in touches]
    )
    estimated = np.mean([item["point"] for item in estimates["contacts"]], axis=0)
    return float(1e3 * np.linalg.norm(estimated - true))


def _joint(estimates: dict[str, Any], truth: Truth) -> dict[str, Any]:
    joint = estimates["joint"]
    if joint is None:
        return {"joint.type_ok": None, "joint.axis_deg": None, "joint.origin_mm": None}
    figures: dict[str, Any] = {
        "joint.type_ok": joint["type"] == truth.joint.type,
        "joint.axis_deg": float(np.degrees(angle_between(joint["axis"], truth.joint.axis))),
    }
    if truth.joint.type == "revolute":
        # The error is the distance of the true axis point nearest the first
        # contact from the estimated axis line.
        contact = next((frame[0]["point"] for frame in truth.contacts if frame), truth.joint.origin)
        along = (np.array(contact) - truth.joint.origin) @ truth.joint.axis
        point = truth.joint.origin + along * truth.joint.axis
        offset = point - np.array(joint["origin"])
        axis = np.array(joint["axis"])
        figures["joint.origin_mm"] = float(1e3 * np.linalg.norm(offset - (offset @ axis) * axis))
    return figures


def _theta(estimates: dict[str, Any], truth: Truth, times_s: Array, camera: str) -> dict[str, Any]:
    unit, factor = ("deg", 180 / np.pi) if truth.joint.type == "revolute" else ("mm", 1e3)
    theta = estimates["theta"]
    if theta is None:
        return {f"theta.rmse_{unit}": None, f"theta.final_error_{unit}": None}
    true = truth.theta[camera] - truth.theta[camera][0]
    values = np.interp(times_s, theta["times_s"], theta["values"])
    errors = values - values[0] - true
    inside = slice(truth.start_frame, truth.end_frame + 1)
    return {
        f"theta.rmse_{unit}": float(factor * np.sqrt(np.mean(errors[inside] ** 2))),
        f"theta.final_error_{unit}": float(factor * abs(errors[truth.end_frame])),
    }
