"""Export of a twin in one state as Gaussians, in any format of `io.gaussian_files`."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.errors import ConfigError
from aomgen.exports.scene_motion import SceneMotion
from aomgen.io.gaussian_files import Y_UP_SUFFIXES, write_gaussians
from aomgen.lighting.shadowed_twin import pose_with_shadow
from aomgen.twin.twin import TwinState, interpolate_state

# Rotation from the world (z up) to the axes of formats with y up and z towards the viewer.
Y_UP: Final = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def write_posed_gaussians(
    motion: SceneMotion, path: Path, *, joint: float | None, time_s: float | None
) -> None:
    """Write the twin of a motion in one state; by default as in the scan, or as in the first frame of an episode.

    Args:
        motion: Twin and motion.
        path: Its suffix determines the format; `.spz` and `.glb` are y up, the others z up like the world.
        joint: Value of the object's joint, [rad] or [m]; None keeps that of the state.
        time_s: Time of the motion, [s]; None for the state at rest.

    Raises:
        ConfigError: The joint value or the time is outside of its range.
        LimitExceededError, StorageError: See `write_gaussians`.
    """
    hinge, times_s = motion.twin.joint, motion.trajectory.times_s
    unit = "rad" if hinge.type == "revolute" else "m"
    _require_inside("--joint", joint, hinge.lower, hinge.upper, unit)
    _require_inside("--time", time_s, min(float(times_s[0]), 0.0), float(times_s[-1]), "s")
    gaussians = pose_with_shadow(motion.twin, motion.robot, choose_state(motion, joint, time_s))
    is_y_up = path.suffix.lower() in Y_UP_SUFFIXES
    write_gaussians(path, gaussians.transform(Y_UP) if is_y_up else gaussians)


def _require_inside(option: str, value: float | None, low: float, high: float, unit: str) -> None:
    """Refuse a value outside of a range; NaN is outside."""
    if value is not None and not low <= value <= high:
        raise ConfigError(
            option, f"is {value:g} {unit}", f"choose a value between {low:.3f} and {high:.3f} {unit}"
        )


def choose_state(motion: SceneMotion, joint: float | None, time_s: float | None) -> TwinState:
    """Return the state at a time or at rest, with another joint value of the object if one is given."""
    if time_s is not None:
        state = interpolate_state(motion.trajectory, time_s)
    elif motion.fitted is None:
        state = motion.twin.scan_state
    else:
        state = interpolate_state(motion.trajectory, float(motion.trajectory.times_s[0]))
    return state if joint is None else replace(state, theta=joint)
