"""The twin: a robot and an articulated object whose bodies carry Gaussians.

A state gives body poses, body poses move Gaussians, Gaussians give images.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate
from aomgen.core.joint import Joint
from aomgen.core.light import Light, shaded_srgb
from aomgen.core.values import Array, freeze
from aomgen.physics.robot import RobotModel
from aomgen.splatting.rasterizer import Rendering, render

WORLD: Final = "world"
OBJECT: Final = "object"
PART: Final = "part"


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinState:
    """One configuration.

    Attributes:
        joints: Arm joints (J,), [rad].
        gripper: 0 open .. 1 closed.
        theta: Object joint value, [rad] or [m].
        T_world_object: Object pose (4, 4).
    """

    joints: Array
    gripper: float
    theta: float
    T_world_object: Array

    def __post_init__(self) -> None:
        freeze(self, "joints", self.joints, (None,))
        freeze(self, "T_world_object", self.T_world_object, (4, 4))


@dataclass(frozen=True, slots=True, kw_only=True)
class Relit:
    """Surfaces whose color follows the light as they turn.

    Attributes:
        indices: Which Gaussians of the twin (M,).
        albedo_linear: (M, 3), 0..1.
        transfer: (M, 9), in the body's frame; see `core.light`.
        light: What they are lit by, world frame.
    """

    indices: NDArray[np.int64]
    albedo_linear: NDArray[np.float32]
    transfer: NDArray[np.float32]
    light: Light

    def __post_init__(self) -> None:
        count = len(self.indices)
        freeze(self, "indices", self.indices, (count,), np.int64)
        freeze(self, "albedo_linear", self.albedo_linear, (count, 3), np.float32)
        freeze(self, "transfer", self.transfer, (count, 9), np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Twin:
    """A scene that can be posed; N Gaussians, B bodies.

    Attributes:
        robot: Model that `physics.robot.load_robot` knows.
        gaussians: Each in its body's frame.
        bodies: (N,) index into `body_names`.
        labels: (N,) part label, see `conventions.PART_LABELS`.
        body_names: "world", the robot's bodies, "object" (static part), "part" (moving part).
        joint: The object's joint, object frame; "part" coincides with "object" at value 0.
        T_world_object: Object pose (4, 4) in the scan.
        scan_state: The state that was scanned.
        relit: Surfaces that are lit per frame; None when all colors come from the scan.
    """

    robot: str
    gaussians: Gaussians
    bodies: NDArray[np.int32]
    labels: NDArray[np.uint8]
    body_names: tuple[str, ...]
    joint: Joint
    T_world_object: Array
    scan_state: TwinState
    relit: Relit | None = None

    def __post_init__(self) -> None:
        freeze(self, "bodies", self.bodies, (len(self.gaussians),), np.int32)
        freeze(self, "labels", self.labels, (len(self.gaussians),), np.uint8)
        freeze(self, "T_world_object", self.T_world_object, (4, 4))

    def body(self, name: str) -> int:
        """Index of a body."""
        return self.body_names.index(name)

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Which Gaussians (N,) are not fixed to the world."""
        return self.bodies != 0

    def select(self, which: NDArray[np.bool_]) -> "Twin":
        """The twin with a part of its Gaussians, boolean mask (N,)."""
        relit = self.relit
        if relit is not None:
            kept = which[relit.indices]
            relit = Relit(
                indices=(np.cumsum(which) - 1)[relit.indices[kept]],
                albedo_linear=relit.albedo_linear[kept],
                transfer=relit.transfer[kept],
                light=relit.light,
            )
        return replace(
            self,
            gaussians=self.gaussians.select(which),
            bodies=self.bodies[which],
            labels=self.labels[which],
            relit=relit,
        )


def trajectory_body_poses(
    twin: Twin,
    robot: RobotModel,
    joints: ArrayLike,
    gripper: ArrayLike,
    thetas: ArrayLike,
    T_world_object: ArrayLike,
) -> Array:
    """Body poses (T, B, 4, 4) along a trajectory.

    Args:
        twin: The twin.
        robot: Its robot.
        joints: Arm joints (T, J), [rad].
        gripper: (T,), 0..1.
        thetas: Object joint values (T,), [rad] or [m].
        T_world_object: Object pose (4, 4).
    """
    joints, thetas = np.asarray(joints, np.float64), np.asarray(thetas, np.float64)
    Ts = np.tile(np.eye(4), (len(joints), len(twin.body_names), 1, 1))
    Ts[:, 1 : 1 + len(robot.body_names)] = robot.link_poses(joints, np.asarray(gripper, np.float64))
    Ts[:, twin.body(OBJECT)] = T_world_object
    Ts[:, twin.body(PART)] = np.asarray(T_world_object, np.float64) @ twin.joint.motion(thetas)
    return Ts


def body_poses(twin: Twin, robot: RobotModel, state: TwinState) -> Array:
    """Body poses (B, 4, 4) in one state."""
    return trajectory_body_poses(
        twin, robot, state.joints[None], [state.gripper], [state.theta], state.T_world_object
    )[0]


def posed(twin: Twin, robot: RobotModel, state: TwinState) -> Gaussians:
    """All Gaussians in the world frame, in the twin's order."""
    return posed_by(twin, body_poses(twin, robot, state))


def posed_by(twin: Twin, Ts_world_body: Array) -> Gaussians:
    """All Gaussians in the world frame, in the twin's order, for body poses (B, 4, 4).

    Gaussians turn with their bodies, their harmonics too; relit surfaces are lit anew.
    """
    source = _lit(twin, Ts_world_body)
    order = np.argsort(twin.bodies, kind="stable")
    edges = np.searchsorted(twin.bodies[order], np.arange(len(twin.body_names) + 1))
    pieces: list[Gaussians] = []
    for body, (start, end) in enumerate(pairwise(edges)):
        if end > start:
            members = source.select(order[start:end])
            still = np.array_equal(Ts_world_body[body], np.eye(4))
            pieces.append(members if still else members.transformed(Ts_world_body[body]))
    if not pieces:
        return source
    back = np.empty(len(order), np.int64)
    back[order] = np.arange(len(order))
    return concatenate(pieces).select(back)


def render_state(
    twin: Twin, robot: RobotModel, state: TwinState, camera: Camera, **options: Any
) -> Rendering:
    """Draw a state; `options` go to `splatting.rasterizer.render`."""
    return render(posed(twin, robot, state), camera, **options)


def _lit(twin: Twin, Ts_world_body: Array) -> Gaussians:
    """The Gaussians in body frames, relit surfaces colored for these body poses."""
    relit = twin.relit
    if relit is None or not len(relit.indices):
        return twin.gaussians
    sh = np.array(twin.gaussians.sh)
    owners = twin.bodies[relit.indices]
    for body in np.unique(owners):
        mine = owners == body
        local = relit.light.seen_from(Ts_world_body[body][:3, :3])
        colors = shaded_srgb(relit.albedo_linear[mine], relit.transfer[mine], local)
        sh[relit.indices[mine], 0] = (colors - 0.5) / SH_C0
        sh[relit.indices[mine], 1:] = 0
    source = twin.gaussians
    return source.with_sh(sh)


def body_list(robot: RobotModel) -> tuple[str, ...]:
    """Names of a twin's bodies for a robot."""
    return (WORLD, *robot.body_names, OBJECT, PART)


def joined_gaussians(sets: Sequence[Gaussians]) -> Gaussians:
    """Gaussians of several sets; empty sets are allowed."""
    filled = [item for item in sets if len(item)]
    return concatenate(filled) if filled else sets[0]
