"""Policy `handle_plan`: finders locate keypoints in images, and AOMGen's planner plans the motion."""

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
from aomgen.evaluation.instructions import match_instruction
from aomgen.evaluation.known_objects import open_known_objects
from aomgen.evaluation.suite import open_results
from lerobot_policy_aomgen.configuration_handle_plan import HandlePlanConfig
from lerobot_policy_aomgen.detection import create_finders, detect_points, open_finders
from lerobot_policy_aomgen.geometry import Geometry, place_cameras
from lerobot_policy_aomgen.lifting import Views, lift_points
from lerobot_policy_aomgen.planned_motion import PlannedMotion

LOG = logging.getLogger(__name__)


class HandlePlanPolicy(PreTrainedPolicy):
    """Policy that is described in `HandlePlanConfig`.

    If the instruction selects no run, or no plan is found, the arm rests, and the reason is logged as a warning.

    Attributes:
        points_world: Keypoints (P, 3) of the last object of the batch as it was planned for, world frame, [m]; None before the
            first action.
    """

    config_class = HandlePlanConfig
    name = "handle_plan"

    def __init__(self, config: HandlePlanConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config = config
        finders = create_finders(config) if config.geometry else open_finders(config, config.finders)[0]
        self.finders = torch.nn.ModuleList(finders)
        self._geometry: Geometry = json.loads(config.geometry)
        runs = [open_results(Path(library)) for library in config.libraries]
        self._instructions = [run.recorded.instruction for run in runs]
        known = [open_known_objects(run, config.known) for run in runs]
        self._planners = [
            KeypointPlanner(run, found.fitted, found.usual_grasp)
            for run, found in zip(runs, known, strict=True)
        ]
        self.reset()

    def get_optim_params(self) -> list[torch.nn.Parameter]:
        return []

    def place_cameras(self, cameras: Mapping[str, Camera]) -> None:
        """Replace the cameras of the policy."""
        place_cameras(self._geometry, cameras)

    def reset(self) -> None:
        """Discard the plans, before a new episode."""
        self._motions: list[PlannedMotion | None] | None = None
        self._step = 0
        self.points_world: Tensor | None = None

    @property
    def uses_images(self) -> bool:
        """Return whether the next observation needs images; only the first one does."""
        return self._motions is None

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Refuse a training.

        Raises:
            NotImplementedError: Always; the policy has no parameters that demonstrations could train.
        """
        raise NotImplementedError("handle_plan is not trained with demonstrations")

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Plan the whole motion (B, N, J + 1): targets of the joints, [rad] or [m], and of the gripper."""
        states = _array(batch[OBS_STATE])
        motions = [
            state[None] if motion is None else motion.list_actions()
            for motion, state in zip(self._plan_all(batch), states, strict=True)
        ]
        length = max(map(len, motions))
        motions = [np.concatenate([rows, np.repeat(rows[-1:], length - len(rows), 0)]) for rows in motions]
        return torch.from_numpy(np.stack(motions)).to(batch[OBS_STATE])

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return the next action (B, J + 1); the last one of a plan is repeated."""
        states = _array(batch[OBS_STATE])
        if self._motions is None:
            self._motions, self._rest = self._plan_all(batch), states
        elif self._step % self.config.n_action_steps == 0:
            for motion, state in zip(self._motions, states, strict=True):
                if motion is not None:
                    motion.correct(state[:-1])
        self._step += 1
        actions = [
            rest if motion is None else motion.next_action()
            for motion, rest in zip(self._motions, self._rest, strict=True)
        ]
        return torch.from_numpy(np.stack(actions)).to(batch[OBS_STATE])

    def _plan_all(self, batch: dict[str, Tensor]) -> list[PlannedMotion | None]:
        """Locate the objects of a batch and plan their motions; None where no plan is found."""
        self.eval()
        count = len(batch[OBS_STATE])
        plans = [
            self._plan(
                task, {name: batch[name][number : number + 1] for name in self.config.input_features or {}}
            )
            for number, task in enumerate(batch.get("task", [""] * count))
        ]
        for plan in plans:
            if isinstance(plan, Rejection):
                LOG.warning("no plan for the located object: %s", plan.detail)
        return [None if isinstance(plan, Rejection) else PlannedMotion(plan) for plan in plans]

    def _plan(self, task: str, batch: dict[str, Tensor]) -> EpisodePlan | Rejection:
        """Plan the motion that an instruction demands, in a batch of one element."""
        chosen = match_instruction(task, self._instructions)
        if chosen is None:
            what = f"the instruction {task!r} selects none of {self._instructions}"
            return Rejection(reason="no_object", detail=what)
        views, pixels, sds_px = detect_points(self.finders[chosen], self._geometry, batch)
        self.points_world = lift_points(views, pixels, sds_px)[0][0]
        located = (_array(values[0]) for values in (pixels, sds_px, self.points_world[None]))
        plan = self._planners[chosen].plan(_list_cameras(views), *located, _array(batch[OBS_STATE])[0, :-1])
        if isinstance(plan, EpisodePlan):
            placed = apply(plan.T_world_object, find_keypoints(plan.fitted.asset))
            self.points_world = torch.from_numpy(placed)
        return plan


def _list_cameras(views: Views) -> list[Camera]:
    """List the cameras of the first element of a batch."""
    width, height = views.size
    return [
        Camera(fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2], width=width, height=height, T_world_cam=T)
        for K, T in zip(_array(views.K), _array(views.T_world_cam[0]), strict=True)
    ]


def _array(values: Tensor) -> np.ndarray:
    return values.double().cpu().numpy()
