"""Estimation of keypoints during an episode: from several images before the grasp, then from the pose of the gripper."""

import torch
from torch import Tensor

from aomgen.core.keypoints import MOVING_POINTS

# Gripper value above which the gripper is assumed to hold the handle; 0 is open, 1 is closed without an object between the
# fingers.
CLOSED = 0.5


class PointTracker:
    """Estimates of keypoints for a batch of B episodes, world frame, [m].

    Attributes:
        rest_world: Keypoints (B, P, 3) before the grasp; None before the first update.
    """

    def __init__(self) -> None:
        self.rest_world: Tensor | None = None
        self._looks: list[tuple[Tensor, Tensor]] = []

    def update(
        self, points: Tensor, sigmas: Tensor, T_world_ee: Tensor, gripper: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Add a measurement of the points, and estimate them from all measurements.

        Measurements after the gripper has closed are ignored. From then on, the points of the handle move with the end effector
        while the gripper is closed, and those of the axis do not move.

        Args:
            points: Measured keypoints (B, P, 3).
            sigmas: Standard deviations of the measurements (B, P).
            T_world_ee: Poses of the end effector (B, 4, 4).
            gripper: Gripper values (B,), from 0 (open) to 1 (closed).

        Returns:
            Estimated keypoints (B, P, 3) and their standard deviations (B, P).
        """
        closed = gripper > CLOSED
        if self.rest_world is None:
            self._touched = self._held = torch.zeros_like(closed)
            self._handle_ee = self._handle_world = torch.zeros_like(points[:, :MOVING_POINTS])
        ignored = (closed | self._touched)[:, None] & bool(self._looks)
        self._looks.append((points, torch.where(ignored, torch.inf, sigmas)))
        self.rest_world, spreads = combine_looks(*map(torch.stack, zip(*self._looks, strict=True)))
        rest = self.rest_world[:, :MOVING_POINTS]
        handle = torch.where(self._touched[:, None, None], self._handle_world, rest)
        to_ee = torch.linalg.inv(T_world_ee)
        grasps = (closed & ~self._held)[:, None, None]
        self._handle_ee = torch.where(grasps, _transform(to_ee, handle), self._handle_ee)
        self._handle_world = torch.where(
            closed[:, None, None], _transform(T_world_ee, self._handle_ee), handle
        )
        self._held, self._touched = closed, self._touched | closed
        return torch.cat([self._handle_world, self.rest_world[:, MOVING_POINTS:]], 1), spreads


def combine_looks(points: Tensor, sigmas: Tensor) -> tuple[Tensor, Tensor]:
    """Combine L measurements of points (L, B, P, 3) with standard deviations (L, B, P).

    Returns:
        Medians of the coordinates (B, P, 3) and of the standard deviations (B, P), with the inverse variances as weights.
    """
    values = torch.cat([points, sigmas[..., None]], -1)
    values, order = values.sort(0)
    weights = (sigmas**-2)[..., None].expand_as(values).gather(0, order).cumsum(0)
    middle = (weights < weights[-1] / 2).sum(0, keepdim=True)
    found = values.gather(0, middle)[0]
    return found[..., :3], found[..., 3]


def _transform(T: Tensor, points: Tensor) -> Tensor:
    """Transform points (B, P, 3) by poses (B, 4, 4)."""
    return points @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
