"""Network that predicts a chunk of end effector poses from keypoints, both in the end effector frame."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from aomgen.core.keypoints import KEYPOINTS

# Unit of lengths inside the network, [m]. Errors of orientation are compared with errors of position by the displacement of
# points at this distance.
UNIT_M = 0.1
# Unit of the standard deviations of points, [m]; the network receives their logarithms.
SIGMA_M = 0.01
# Size of a predicted pose: position, the first two columns of its rotation matrix, gripper.
POSE = 10
# Size of an input: points, their standard deviations, the first grasp point, the gripper.
INPUT = 4 * len(KEYPOINTS) + 4
# Weight of the error of the gripper value, relative to that of a length in units of UNIT_M.
GRIPPER_WEIGHT = 0.3


class ActionNetwork(nn.Module):
    """A network that maps inputs (B, INPUT) to poses (B, N, POSE) in the end effector frame.

    A linear layer in parallel with the other layers allows poses to follow points exactly.
    """

    def __init__(self, chunk_size: int, hidden_dim: int, n_layers: int) -> None:
        super().__init__()
        widths = [INPUT, *[hidden_dim] * n_layers]
        layers = list[nn.Module]()
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), nn.GELU()]
        self.layers = nn.Sequential(*layers, nn.Linear(hidden_dim, chunk_size * POSE))
        self.direct = nn.Linear(INPUT, chunk_size * POSE, bias=False)
        nn.init.zeros_(self.direct.weight)

    def forward(self, inputs: Tensor) -> Tensor:
        return (self.layers(inputs) + self.direct(inputs)).unflatten(1, (-1, POSE))


def join_inputs(T_world_ee: Tensor, points: Tensor, sigmas: Tensor, first: Tensor, gripper: Tensor) -> Tensor:
    """Build the inputs (B, INPUT) of the network.

    Args:
        T_world_ee: Poses of the end effector (B, 4, 4).
        points, sigmas: Keypoints (B, P, 3), world frame, and their standard deviations (B, P), [m].
        first: Grasp points (B, 3) at the start of the episode, world frame, [m]; the distance from them indicates how far the
            object has been opened.
        gripper: Gripper values (B,), from 0 (open) to 1 (closed).
    """
    relative = torch.cat([points, first[:, None]], 1) - T_world_ee[:, None, :3, 3]
    relative = relative @ T_world_ee[:, :3, :3] / UNIT_M
    return torch.cat([relative.flatten(1), (sigmas / SIGMA_M).log(), gripper[:, None]], 1)


def compare_poses(found: Tensor, wanted: Tensor) -> Tensor:
    """Compute the mean absolute errors (B, N) of poses (B, N, POSE), in units of UNIT_M."""
    weights = torch.ones(POSE, device=found.device)
    weights[-1] = GRIPPER_WEIGHT
    return ((found - wanted).abs() * weights).mean(-1)


def encode_poses(T_world_ee: Tensor, actions: Tensor) -> Tensor:
    """Convert actions to poses (B, N, POSE) in the end effector frame.

    Args:
        T_world_ee: Poses of the end effector (B, 4, 4).
        actions: Actions (B, N, 8): position, [m], and quaternion wxyz, world frame, and gripper value.
    """
    R = T_world_ee[:, None, :3, :3].transpose(-1, -2)
    positions = (R @ (actions[..., :3] - T_world_ee[:, None, :3, 3])[..., None])[..., 0]
    columns = (R @ rotate_axes(actions[..., 3:7])).transpose(-1, -2)[..., :2, :]
    return torch.cat([positions / UNIT_M, columns.flatten(-2), actions[..., 7:]], -1)


def decode_poses(T_world_ee: Tensor, poses: Tensor) -> Tensor:
    """Convert poses (B, N, POSE), whose rotation columns are orthonormalized, to actions; the inverse of `encode_poses`."""
    x = nn.functional.normalize(poses[..., 3:6], dim=-1)
    y = nn.functional.normalize(poses[..., 6:9] - (x * poses[..., 6:9]).sum(-1, keepdim=True) * x, dim=-1)
    R_ee = torch.stack([x, y, torch.linalg.cross(x, y)], -1)
    R = T_world_ee[:, None, :3, :3]
    positions = (R @ (UNIT_M * poses[..., :3, None]))[..., 0] + T_world_ee[:, None, :3, 3]
    return torch.cat([positions, quaternions(R @ R_ee), poses[..., 9:].clamp(0, 1)], -1)


def rotate_axes(quats: Tensor) -> Tensor:
    """Convert quaternions wxyz (..., 4) to rotation matrices (..., 3, 3)."""
    w, x, y, z = nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def quaternions(R: Tensor) -> Tensor:
    """Convert rotation matrices (B, N, 3, 3) to quaternions wxyz (B, N, 4), with consistent signs in each chunk.

    A quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix; this method has no singularities.
    Source: Bar-Itzhack, New method for extracting the quaternion from a rotation matrix (2000).
    """
    a, b, c = R[..., 0, :].unbind(-1), R[..., 1, :].unbind(-1), R[..., 2, :].unbind(-1)
    rows = [
        [a[0] + b[1] + c[2], c[1] - b[2], a[2] - c[0], b[0] - a[1]],
        [c[1] - b[2], a[0] - b[1] - c[2], a[1] + b[0], a[2] + c[0]],
        [a[2] - c[0], a[1] + b[0], b[1] - a[0] - c[2], b[2] + c[1]],
        [b[0] - a[1], a[2] + c[0], b[2] + c[1], c[2] - a[0] - b[1]],
    ]
    quats = torch.linalg.eigh(torch.stack([torch.stack(row, -1) for row in rows], -2))[1][..., -1]
    return quats * torch.where((quats * quats[:, :1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)


def align_signs(actions: Tensor, last: Tensor | None) -> Tensor:
    """Choose the sign of the quaternions of actions (B, N, 8) according to the last action (B, 8).

    Blended quaternions then do not pass through zero.
    """
    if last is None:
        return actions
    same = (actions[:, 0, 3:7] * last[:, 3:7]).sum(-1) >= 0
    flipped = torch.cat([actions[..., :3], -actions[..., 3:7], actions[..., 7:]], -1)
    return torch.where(same[:, None, None], actions, flipped)
