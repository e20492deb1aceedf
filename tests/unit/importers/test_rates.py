"""The error that the rate of a log alone causes; docs/import.md states the figures."""

from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.read import read_capture
from aomgen.core.recording import JointLog
from aomgen.robots.robot import RobotModel


@pytest.mark.parametrize(
    ("rate_hz", "rms_mm", "worst_mm"), [(5, 1.5, 3.6), (10, 0.4, 1.1), (15, 0.25, 0.6), (30, 0.1, 0.3)]
)
def test_interpolation_of_the_bundled_log(
    sample: Path, robot: RobotModel, rate_hz: int, rms_mm: float, worst_mm: float
):
    log = read_capture(sample).joint_log
    # The noise of the encoders is averaged over five rows, so that interpolation is the only error.
    rows = [np.convolve(column, np.full(5, 0.2), "valid") for column in log.joints.T]
    whole = JointLog(
        times_s=log.times_s[2:-2],
        joints=np.stack(rows, -1),
        gripper=log.gripper[2:-2],
        joint_names=log.joint_names,
    )
    frames_s = whole.times_s[0] + 0.5 + 0.1 * np.arange(95)
    true = robot.ee_poses(whole.at(frames_s)[0])[:, :3, 3]
    errors_mm = []
    for phase in np.arange(4) / 4:
        times_s = np.arange(whole.times_s[0] + phase / rate_hz, whole.times_s[-1], 1 / rate_hz)
        joints, gripper = whole.at(times_s)
        sparse = JointLog(times_s=times_s, joints=joints, gripper=gripper, joint_names=log.joint_names)
        found = robot.ee_poses(sparse.at(frames_s)[0])[:, :3, 3]
        errors_mm.append(1000 * np.linalg.norm(found - true, axis=1))
    assert np.sqrt(np.mean(np.square(errors_mm))) <= rms_mm
    assert np.max(errors_mm) <= worst_mm
