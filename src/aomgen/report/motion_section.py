"""The report's section on the motion: interval, travel, axis, and their uncertainty.

A demonstration from which no motion could be recovered gets its own page, `refused.html`.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING
from aomgen.core.camera import Camera
from aomgen.core.motion import MotionCurve, MotionEstimate
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.io.artifact import load_artifact
from aomgen.io.atomic import write_text
from aomgen.io.images import resize
from aomgen.motion.estimates_file import REFUSED_FILE, REFUSED_MOTION
from aomgen.pipeline.rendering import render_twin
from aomgen.report.html import draw_chart, page, paragraph, picture, section
from aomgen.report.images import (
    OUTLINE,
    Image8,
    axis_space,
    estimate_recorded_states,
    overlay_motion,
    overlay_outline,
    sheet,
)
from aomgen.results import Results

# Half a 95 % interval in standard deviations.
NORMAL_95 = 1.96
# Width of an image in the page, [px].
WIDTH_PX = 420


def motion_section(results: Results) -> list[str]:
    """Return a sentence, images and charts of the motion."""
    return [
        paragraph(motion_sentence(results.motion)),
        picture(joint_sheet(results), "the recovered joint when the motion starts, halfway and when it ends"),
        paragraph(
            "Blue: the axis, and the region that contains it with a probability of 95 %. Red: path of the held point. "
            "Yellow: contact points of the fingers, which move with the part. Pink: outline of the twin's part; it "
            "has to coincide with the real one."
        ),
        *motion_charts(results.motion),
    ]


def joint_sheet(results: Results) -> Image8:
    """Draw the joint into the frames at start, middle and end of the motion, cropped around it."""
    motion, video = results.motion, results.videos[results.demo_camera]
    camera = results.fixed_camera.camera
    moments = [motion.start_s, 0.5 * (motion.start_s + motion.end_s), motion.end_s]
    frames = [int(np.argmin(np.abs(video.times_s - moment))) for moment in moments]
    states = estimate_recorded_states(results, frames)
    held = apply(results.robot.ee_poses(states[0].joints[None])[0], motion.grasp_ee)
    parts = [render_twin(results.twin, results.robot, camera, state)[2] == MOVING for state in states]
    left, top, width, height = _cut(camera, motion, held, np.any(parts, axis=0))
    scale = WIDTH_PX / width
    size = (round(scale * camera.width), round(scale * camera.height))
    rows = slice(round(scale * top), round(scale * (top + height)))
    columns = slice(round(scale * left), round(scale * left) + WIDTH_PX)
    images = []
    for frame, part in zip(frames, parts, strict=True):
        large = resize(video.frames_srgb[frame], *size)
        mask = resize(np.repeat(255 * part[..., None].astype(np.uint8), 3, 2), *size)[..., 0] > 127
        outlined = overlay_outline(large, mask, OUTLINE)
        theta = float(motion.thetas[frame])
        drawn = overlay_motion(outlined, camera.resize(*size), motion, held, theta)
        images.append(drawn[rows, columns])
    return sheet(images, len(images))


def _cut(
    camera: Camera, motion: MotionEstimate, held_world: Array, part: NDArray[np.bool_]
) -> tuple[int, int, int, int]:
    """Compute left, top, width and height, [px], of the crop that shows the part's pixels (H, W), the axis and the path."""
    joint = motion.joint
    path = apply(joint.motion(np.linspace(joint.lower, joint.upper, 9)), held_world)
    pixels, depths = camera.project(np.concatenate([path, axis_space(motion, held_world)[1].reshape(-1, 3)]))
    rows, columns = np.nonzero(part)
    shown = np.concatenate([pixels[depths > 0], np.stack([columns, rows], 1)])
    limits = np.array([camera.width, camera.height])
    low, high = np.clip([shown.min(0), shown.max(0)], 0, limits)
    # The crop is square, so that three of them fit in a row, and has a margin that shows the gripper.
    side = min(1.3 * float((high - low).max()), float(limits.min()))
    corner = np.clip((low + high) / 2 - side / 2, 0, limits - side)
    left, top = (int(value) for value in corner)
    return left, top, int(side), int(side)


def motion_charts(motion: MotionEstimate) -> list[str]:
    """Draw the score with start and end, the joint value with its 95 % band, slip and pivot."""
    span = (motion.start_s, motion.end_s)
    factor, unit = (180 / np.pi, "deg") if motion.joint.type == "revolute" else (1e3, "mm")
    values, half = factor * motion.thetas, NORMAL_95 * factor * motion.theta_sd
    theta = draw_chart(
        f"joint value [{unit}]",
        [("recovered", motion.times_s, values)],
        span=span,
        band=(motion.times_s, values - half, values + half),
    )
    grip = draw_chart(
        "end effector against part",
        [
            ("slip [mm]", motion.times_s, 1e3 * motion.slip_m),
            ("pivot [deg]", motion.times_s, np.degrees(motion.pivot_rad)),
        ],
        span=span,
    )
    return [
        *_draw_score(motion.curve, "threshold", span),
        paragraph("The joint value with its 95 % band."),
        theta,
        paragraph("Slip of the end effector along the part, and its rotation relative to the part."),
        grip,
    ]


def motion_sentence(motion: MotionEstimate) -> str:
    """Describe the moved part, the interval and the uncertainty in one sentence."""
    return (
        f"The part moves from {motion.start_s:.2f} s to {motion.end_s:.2f} s, {motion.direction}. It is a "
        f"{motion.joint.type} joint{_certainty(motion)}. The end effector rotated by {motion.ee_turn_ratio:.2f} times "
        f"the rotation of the part, slid up to {1e3 * motion.slip_m.max():.0f} mm along it and rotated up to "
        f"{np.degrees(motion.pivot_rad.max()):.0f} deg relative to it."
    )


def _certainty(motion: MotionEstimate) -> str:
    """Describe the uncertainty of the axis; empty if the method does not estimate it, as that of the paper."""
    if not motion.axis_ci95_rad > 0:
        return ""
    place = (
        f", of its origin +-{1e3 * motion.origin_ci95_m:.0f} mm" if motion.joint.type == "revolute" else ""
    )
    return f"; the 95 % interval of its axis is +-{np.degrees(motion.axis_ci95_rad):.1f} deg{place}"


def write_refusal(out: Path, reason: str) -> Path | None:
    """Draw the motion score of a refused run.

    Args:
        out: The run's folder.
        reason: Message of the error.

    Returns:
        Path of the page; None if the run was refused before or after the stage "motion".
    """
    if not (out / f"{REFUSED_MOTION}.json").is_file():
        return None
    curve = load_artifact(out, REFUSED_MOTION, MotionCurve)
    body = [
        "<h1>No motion was recovered</h1>",
        paragraph(reason),
        section("Evidence", *_draw_evidence(curve)),
    ]
    path = out / REFUSED_FILE
    write_text(path, page("No motion was recovered", body))
    return path


def _draw_score(curve: MotionCurve, threshold: str, span: tuple[float, float] | None) -> list[str]:
    """Draw the motion score over time, with its threshold and the name of the threshold."""
    chart = draw_chart(
        "motion score",
        [("score", curve.times_s, curve.scores), ("smoothed", curve.times_s, curve.smoothed)],
        level=(threshold, curve.threshold),
        span=span,
    )
    words = "Share of the part's pixels that show neither its first nor its last appearance."
    return [paragraph(words), chart]


def _draw_evidence(curve: MotionCurve) -> list[str]:
    """Draw score and gripper of a refused demonstration."""
    gripper = draw_chart(
        "gripper, shares of the largest",
        [
            (name, curve.times_s, values / max(float(np.max(values)), 1e-9))
            for name, values in (
                (f"distance, largest {100 * float(curve.distances_m.max()):.0f} cm", curve.distances_m),
                (f"speed, {curve.speeds_m_s.max():.2f} m/s", curve.speeds_m_s),
                ("gripper closed", curve.gripper),
            )
        ],
    )
    return [
        *_draw_score(curve, "stillness", None),
        paragraph(
            "Distance of the fingers from the part, speed of the end effector, and how far the gripper is closed."
        ),
        gripper,
    ]
