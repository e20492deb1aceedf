"""Export of a twin in one state as Gaussians, in any format of `io.gaussian_files`."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

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
        LimitExceededError, StorageError: See `write_gaussians`.
    """
    gaussians = pose_with_shadow(motion.twin, motion.robot, choose_state(motion, joint, time_s))
    is_y_up = path.suffix.lower() in Y_UP_SUFFIXES
    write_gaussians(path, gaussians.transform(Y_UP) if is_y_up else gaussians)


def choose_state(motion: SceneMotion, joint: float | None, time_s: float | None) -> TwinState:
    """Return the state at a time or at rest, with another joint value of the object if one is given."""
    if time_s is not None:
        state = interpolate_state(motion.trajectory, time_s)
    elif motion.fitted is None:
        state = motion.twin.scan_state
    else:
        state = interpolate_state(motion.trajectory, float(motion.trajectory.times_s[0]))
    return state if joint is None else replace(state, theta=joint)
