"""Prediction error on the recorded video, unseen in training: distance of the predicted end effector."""

from pathlib import Path
from typing import Final

import numpy as np

from aomgen.core.values import Array
from aomgen.evaluation.lerobot_policy import LerobotPolicy
from aomgen.evaluation.suite import Suite
from aomgen.io.episode_folder import list_committed, read_episode
from aomgen.io.images import resize
from aomgen.results import Results

# Prediction horizon, [s].
HORIZON_S: Final = 1.0


def video_error(trained: Path, suite: Suite, results: Results) -> float:
    """Compute the mean error of a policy's predicted end effectors over all frames, [mm]."""
    policy, camera = LerobotPolicy(trained, suite), suite.cameras[results.demo_camera]
    demo, video, steps = results.demonstration, results.videos[results.demo_camera], _steps(results)
    shown = np.abs(video.times_s - demo.times_s[:, None]).argmin(1)
    foreseen = []
    for frame in range(len(demo.times_s) - steps):
        picture = resize(video.frames_srgb[shown[frame]], camera.width, camera.height)
        state = np.append(demo.joints[frame], demo.gripper[frame]).astype(np.float32)
        seen = {"agent_pos": state, "pixels": {results.demo_camera: picture}}
        joints = policy.chunk(seen)[:steps, :-1]
        foreseen.append(results.robot.ee_poses(joints)[:, :3, 3])
    return _mean_error_mm(np.array(foreseen), results)


def mean_trajectory_error(results: Results) -> float:
    """Compute the error of a prediction by the mean demonstration, without observations, [mm]."""
    folders = list_committed(results.folders["episodes"])
    paths = [read_episode(folder).episode.Ts_world_ee[:, :3, 3] for folder in folders]
    frames, steps = len(results.demonstration.times_s), _steps(results)
    # End effectors stay at their last position.
    lasting = [path[np.minimum(np.arange(frames), len(path) - 1)] for path in paths]
    mean = np.mean(lasting, 0)
    return _mean_error_mm(np.array([mean[k + 1 : k + 1 + steps] for k in range(frames - steps)]), results)


def _steps(results: Results) -> int:
    return round(HORIZON_S * results.fps)


def _mean_error_mm(foreseen: Array, results: Results) -> float:
    """Compute the mean error of positions (frames, steps, 3), [m], predicted after every frame."""
    path, steps = results.demonstration.Ts_world_ee[:, :3, 3], foreseen.shape[1]
    recorded = np.array([path[k + 1 : k + 1 + steps] for k in range(len(foreseen))])
    return float(1000 * np.linalg.norm(foreseen - recorded, axis=-1).mean())
