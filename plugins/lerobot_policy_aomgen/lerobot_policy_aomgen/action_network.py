"""The action network: keypoints in the end effector's frame to a chunk of its next poses."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from aomgen.core.keypoints import KEYPOINTS

# Unit of lengths inside the network, [m]; the tips of unit axes of this length make orientations comparable with positions.
UNIT_M = 0.1
# Unit of standard deviations of points, whose logarithm the network receives, [m].
SIGMA_M = 0.01
# Numbers of a predicted pose: position, the first two columns of its rotation, gripper.
POSE = 10
# Numbers of an input: points, their standard deviations, the first grasp point, the gripper.
INPUT = 4 * len(KEYPOINTS) + 4
# Weight of the gripper's error against a length of UNIT_M.
GRIPPER_WEIGHT = 0.3


class ActionNetwork(nn.Module):
    """Inputs (B, INPUT) to poses (B, N, POSE) in the end effector's frame.

    A linear path parallel to the layers lets a pose follow a point one to one.
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
    """Inputs (B, INPUT) of the network.

    Args:
        T_world_ee: Pose of the end effector (B, 4, 4).
        points, sigmas: Keypoints (B, P, 3) in the world frame and their standard deviations (B, P), [m].
        first: Grasp point (B, 3) when the episode began: the distance from it indicates how far the object is open.
        gripper: Its state (B,), 0 open .. 1 closed.
    """
    relative = torch.cat([points, first[:, None]], 1) - T_world_ee[:, None, :3, 3]
    relative = relative @ T_world_ee[:, :3, :3] / UNIT_M
    return torch.cat([relative.flatten(1), (sigmas / SIGMA_M).log(), gripper[:, None]], 1)


def compare_poses(found: Tensor, wanted: Tensor) -> Tensor:
    """Mean absolute errors (B, N) of poses (B, N, POSE), in units of UNIT_M."""
    weights = torch.ones(POSE, device=found.device)
    weights[-1] = GRIPPER_WEIGHT
    return ((found - wanted).abs() * weights).mean(-1)


def encode_poses(T_world_ee: Tensor, actions: Tensor) -> Tensor:
    """Poses (B, N, POSE) in the end effector's frame from actions (B, N, 8): position, quaternion wxyz, gripper in the world."""
    R = T_world_ee[:, None, :3, :3].transpose(-1, -2)
    positions = (R @ (actions[..., :3] - T_world_ee[:, None, :3, 3])[..., None])[..., 0]
    columns = (R @ rotate_axes(actions[..., 3:7])).transpose(-1, -2)[..., :2, :]
    return torch.cat([positions / UNIT_M, columns.flatten(-2), actions[..., 7:]], -1)


def decode_poses(T_world_ee: Tensor, poses: Tensor) -> Tensor:
    """Actions (B, N, 8) from poses (B, N, POSE), whose columns are made orthonormal; the inverse of `encode_poses`."""
    x = nn.functional.normalize(poses[..., 3:6], dim=-1)
    y = nn.functional.normalize(poses[..., 6:9] - (x * poses[..., 6:9]).sum(-1, keepdim=True) * x, dim=-1)
    R_ee = torch.stack([x, y, torch.linalg.cross(x, y)], -1)
    R = T_world_ee[:, None, :3, :3]
    positions = (R @ (UNIT_M * poses[..., :3, None]))[..., 0] + T_world_ee[:, None, :3, 3]
    return torch.cat([positions, quaternions(R @ R_ee), poses[..., 9:].clamp(0, 1)], -1)


def rotate_axes(quats: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions wxyz (..., 4)."""
    w, x, y, z = nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def quaternions(R: Tensor) -> Tensor:
    """Quaternions wxyz (B, N, 4) of rotation matrices (B, N, 3, 3), of equal sign along each chunk.

    A quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix, which no angle makes singular.
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
    """Actions (B, N, 8) whose quaternions have the sign of the last action's (B, 8), so that blending does not pass zero."""
    if last is None:
        return actions
    same = (actions[:, 0, 3:7] * last[:, 3:7]).sum(-1) >= 0
    flipped = torch.cat([actions[..., :3], -actions[..., 3:7], actions[..., 7:]], -1)
    return torch.where(same[:, None, None], actions, flipped)
