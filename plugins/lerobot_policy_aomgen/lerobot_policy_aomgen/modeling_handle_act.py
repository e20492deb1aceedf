"""Policy `handle_act`: a finder locates keypoints in images, and a network predicts end effector poses from them."""

import json
from collections.abc import Mapping
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.keypoints import KEYPOINTS
from lerobot_policy_aomgen.action_network import (
    ActionNetwork,
    align_signs,
    compare_poses,
    decode_poses,
    encode_poses,
    join_inputs,
)
from lerobot_policy_aomgen.blending import ChunkBlender
from lerobot_policy_aomgen.configuration_handle_act import HandleACTConfig
from lerobot_policy_aomgen.detection import create_finders, detect_points, open_finders
from lerobot_policy_aomgen.finder_noise import TABLE_SHAPE, add_errors, tabulate_errors
from lerobot_policy_aomgen.geometry import (
    Geometry,
    disturb_poses,
    place_cameras,
    pose_end_effector,
    pose_views,
)
from lerobot_policy_aomgen.lifting import lift_points, project_points
from lerobot_policy_aomgen.tracking import PointTracker, combine_looks

# Largest number of estimates of the keypoints that training combines. In an episode, the keypoints are estimated at every
# predicted chunk until the object is grasped.
MAX_LOOKS = 8


class HandleACTPolicy(PreTrainedPolicy):
    """Policy that is described in `HandleACTConfig`.

    Attributes:
        points_world: Last estimate of the keypoints (P, 3), world frame, [m]; None before the first one.
    """

    config_class = HandleACTConfig
    name = "handle_act"

    def __init__(self, config: HandleACTConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config = config
        if config.geometry:
            (self.finder,), measured = create_finders(config), None
        else:
            (self.finder,), (measured,) = open_finders(config, [config.finder])
        self.finder.requires_grad_(False)
        self._geometry: Geometry = json.loads(config.geometry)
        self._cameras = list(self._geometry["K"])
        empty = torch.zeros(len(self._cameras), *TABLE_SHAPE)
        self.register_buffer("errors", tabulate_errors(measured, self._cameras) if measured else empty)
        self.network = ActionNetwork(config.chunk_size, config.hidden_dim, config.n_layers)
        self.reset()

    def get_optim_params(self) -> list[torch.nn.Parameter]:
        return list(self.network.parameters())

    def train(self, mode: bool = True) -> "HandleACTPolicy":
        super().train(mode)
        self.finder.eval()
        return self

    def place_cameras(self, cameras: Mapping[str, Camera]) -> None:
        """Replace the cameras of the policy."""
        place_cameras(self._geometry, cameras)

    def reset(self) -> None:
        """Discard the last chunk and the estimates of the keypoints, before a new episode."""
        self._blender = ChunkBlender(self.config.n_action_steps)
        self._tracker = PointTracker()
        self._last: Tensor | None = None
        self.points_world: Tensor | None = None

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Compute the mean error of the predicted chunks, without poses beyond the end of an episode.

        Autocast is disabled, because positions in bfloat16 have errors of millimeters.
        """
        with torch.autocast(batch[ACTION].device.type, enabled=False):
            loss = self._compute_loss(batch)
        return loss, {"l1_loss": loss.item()}

    def _compute_loss(self, batch: dict[str, Tensor]) -> Tensor:
        joints, truth = batch[OBS_STATE][..., :-1], batch[OBS_ENV_STATE].unflatten(-1, (len(KEYPOINTS), 3))
        count = int(torch.randint(1, MAX_LOOKS + 1, ()))
        looks = [self._find_as_measured(joints[:, 1], truth[:, 1]) for _ in range(count)]
        points, sigmas = combine_looks(*map(torch.stack, zip(*looks, strict=True)))
        # The estimates at the start of the episode and at the current frame have the same error, as in `PointTracker`.
        first = truth[:, 0] + points - truth[:, 1]
        T_world_ee = pose_end_effector(self._geometry, joints[:, 1])
        T_world_ee = disturb_poses(T_world_ee, self.config.pose_noise_m, self.config.pose_noise_rad)
        inputs = join_inputs(T_world_ee, points, sigmas, first[:, 0], batch[OBS_STATE][:, 1, -1])
        errors = compare_poses(self.network(inputs), encode_poses(T_world_ee, batch[ACTION]))
        inside = ~batch["action_is_pad"]
        return (errors * inside).sum() / inside.sum()

    def _find_as_measured(self, joints: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
        """Simulate the estimates of the finder for true points (B, P, 3).

        Returns:
            Points (B, P, 3) and their standard deviations (B, P), [m].
        """
        views = pose_views(self._geometry, self._cameras, pose_end_effector(self._geometry, joints))
        pixels, depths = project_points(views, truth)
        return lift_points(views, *add_errors(self.errors, views, pixels, depths))

    @torch.no_grad()
    def find_points(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Estimate the keypoints (B, P, 3), world frame, and their standard deviations (B, P), [m], from the images."""
        return lift_points(*detect_points(self.finder, self._geometry, batch))

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Predict the next actions (B, chunk_size, 8): position, [m], quaternion wxyz, world frame, and gripper value."""
        self.eval()
        state = batch[OBS_STATE]
        T_world_ee = pose_end_effector(self._geometry, state[:, :-1])
        points, sigmas = self._tracker.update(*self.find_points(batch), T_world_ee, state[:, -1])
        self.points_world = points[0]
        first = self._tracker.rest_world[:, 0]
        poses = self.network(join_inputs(T_world_ee, points, sigmas, first, state[:, -1]))
        actions = align_signs(decode_poses(T_world_ee, poses), self._last)
        self._last = actions[:, 0]
        return actions

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return the next action (B, 8); a new chunk is predicted after `n_action_steps` actions."""
        return self._blender.next_action(lambda: self.predict_action_chunk(batch))
