"""Policy `handle_plan`: a finder locates keypoints in the first images, and AOMGen's planner plans the motion."""

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.keypoints import find_keypoints
from aomgen.core.plan import EpisodePlan, Rejection
from aomgen.core.transforms import apply
from aomgen.episodes.keypoint_planner import KeypointPlanner
from aomgen.evaluation.policies import choose_planned_action
from aomgen.evaluation.suite import open_results
from lerobot_policy_aomgen.configuration_handle_plan import HandlePlanConfig
from lerobot_policy_aomgen.detection import begin_finder, continue_finder, detect_points
from lerobot_policy_aomgen.finder import Finder
from lerobot_policy_aomgen.geometry import Geometry, place_cameras
from lerobot_policy_aomgen.lifting import Views, lift_points

LOG = logging.getLogger(__name__)


class HandlePlanPolicy(PreTrainedPolicy):
    """Policy that is described in `HandlePlanConfig`.

    If no plan is found, the arm rests, and the reason is logged as a warning.

    Attributes:
        points_world: Keypoints (P, 3) of the object as it was planned for, world frame, [m]; None before the first action.
    """

    config_class = HandlePlanConfig
    name = "handle_plan"

    def __init__(self, config: HandlePlanConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config = config
        self.finder: Finder = (continue_finder(config) if config.geometry else begin_finder(config))[0]
        self._geometry: Geometry = json.loads(config.geometry)
        self._planner = KeypointPlanner(open_results(Path(config.library)))
        self.reset()

    def get_optim_params(self) -> list[torch.nn.Parameter]:
        return []

    def place_cameras(self, cameras: Mapping[str, Camera]) -> None:
        """Replace the cameras of the policy."""
        place_cameras(self._geometry, cameras)

    def reset(self) -> None:
        """Discard the plans, before a new episode."""
        self._chunk: Tensor | None = None
        self._step = 0
        self.points_world: Tensor | None = None

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Refuse a training.

        Raises:
            NotImplementedError: Always; the policy has no parameters that demonstrations could train.
        """
        raise NotImplementedError("handle_plan is not trained with demonstrations")

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Plan the whole motion (B, N, J + 1): targets of the joints, [rad] or [m], and of the gripper."""
        self.eval()
        views, pixels, sds_px = detect_points(self.finder, self._geometry, batch)
        points, _ = lift_points(views, pixels, sds_px)
        motions = list[np.ndarray]()
        for number, state in enumerate(_array(batch[OBS_STATE])):
            located = (_array(values[number]) for values in (pixels, sds_px, points))
            plan = self._planner.plan(_list_cameras(views, number), *located, state[:-1])
            if isinstance(plan, Rejection):
                LOG.warning("no plan for the located object: %s", plan.detail)
                self.points_world = points[number]
                motions.append(state[None])
            else:
                placed = apply(plan.T_world_object, find_keypoints(plan.fitted.asset))
                self.points_world = torch.from_numpy(placed)
                motions.append(_list_actions(plan))
        length = max(map(len, motions))
        motions = [np.concatenate([rows, np.repeat(rows[-1:], length - len(rows), 0)]) for rows in motions]
        return torch.from_numpy(np.stack(motions)).to(points)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return the next action (B, J + 1); the last one of a plan is repeated."""
        if self._chunk is None:
            self._chunk = self.predict_action_chunk(batch)
        action = self._chunk[:, min(self._step, self._chunk.shape[1] - 1)]
        self._step += 1
        return action


def _list_cameras(views: Views, number: int) -> list[Camera]:
    """List the cameras of one element of a batch."""
    width, height = views.size
    return [
        Camera(fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2], width=width, height=height, T_world_cam=T)
        for K, T in zip(_array(views.K), _array(views.T_world_cam[number]), strict=True)
    ]


def _list_actions(plan: EpisodePlan) -> np.ndarray:
    return np.stack([choose_planned_action(plan, frame, "joint") for frame in range(len(plan))])


def _array(values: Tensor) -> np.ndarray:
    return values.double().cpu().numpy()
