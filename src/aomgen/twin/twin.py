"""The twin: a robot and an articulated object whose bodies carry Gaussians.

A state gives body poses, body poses move Gaussians, Gaussians give images.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.core.joint import Joint
from aomgen.core.sh import rotate_sh
from aomgen.core.transforms import apply, quat_from_matrix, quat_multiply
from aomgen.core.values import Array, Matrix4, freeze_arrays, require_indices
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import Rendering, render
from aomgen.twin.directional_shadow import (
    MOVES,
    SCENE,
    STANDS,
    DirectionalLight,
    compute_shadow_factors,
    draw_lit,
)
from aomgen.twin.relighting import LitSurface, Relit, surfaces_of

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

    joints: Annotated[Array, "_"]
    gripper: float
    theta: float
    T_world_object: Matrix4

    __post_init__ = freeze_arrays


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
        directional_light: What throws the shadow of moving bodies on the surface they work over, whose own colors
            are those in light; None when shadows are as they were scanned.
    """

    robot: str
    gaussians: Annotated[Gaussians, "N"]
    bodies: Annotated[NDArray[np.int32], "N"]
    labels: Annotated[NDArray[np.uint8], "N"]
    body_names: tuple[str, ...]
    joint: Joint
    T_world_object: Matrix4
    scan_state: TwinState
    relit: Relit | None = None
    directional_light: DirectionalLight | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self)
        freeze_arrays(self)
        require_indices(self.bodies, len(self.body_names))
        if self.relit is not None:
            require_indices(self.relit.indices, len(self.gaussians))

    def body(self, name: str) -> int:
        """Index of a body."""
        return self.body_names.index(name)

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Which Gaussians (N,) are not fixed to the world."""
        return self.bodies != 0

    def select(self, which: NDArray[np.bool_]) -> "Twin":
        """The twin with a part of its Gaussians, boolean mask (N,)."""
        return replace(
            self,
            gaussians=self.gaussians.select(which),
            bodies=self.bodies[which],
            labels=self.labels[which],
            relit=None if self.relit is None else self.relit.select(which),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """A twin prepared for posing again and again: Gaussians sorted by body.

    Attributes:
        gaussians: N, in body frames.
        order: (N,) index of each in the twin.
        spans: (body, first, past the last) of every body that carries something.
        surfaces: What is lit anew, each with its places (M,) among the sorted Gaussians.
    """

    gaussians: Gaussians
    order: NDArray[np.int64]
    spans: tuple[tuple[int, int, int], ...]
    surfaces: tuple[tuple[LitSurface, NDArray[np.int64]], ...]

    def pose(self, Ts_world_body: Array) -> Gaussians:
        """The Gaussians in the world frame, in this rig's order, for body poses (B, 4, 4).

        Gaussians turn with their bodies, their harmonics too; relit surfaces are lit anew.
        """
        source = self.gaussians
        means, quats, sh = np.array(source.means), np.array(source.quats), np.array(source.sh)
        for body, start, end in self.spans:
            T, span = Ts_world_body[body], slice(start, end)
            if np.array_equal(T, np.eye(4)):
                continue
            means[span] = apply(T, source.means[span])
            quats[span] = quat_multiply(quat_from_matrix(T[:3, :3]), source.quats[span])
            if sh.shape[1] > 1:
                sh[span] = rotate_sh(sh[span], T[:3, :3])
        for surface, places in self.surfaces:
            colors = surface.colors_srgb(Ts_world_body[surface.body, :3, :3])
            sh[places, 0] = (colors - 0.5) / SH_C0
        return gaussians_of(means=means, quats=quats, scales=source.scales, opacities=source.opacities, sh=sh)


def rig(twin: Twin) -> Rig:
    """Prepare a twin for posing."""
    order = np.argsort(twin.bodies, kind="stable")
    edges = np.searchsorted(twin.bodies[order], np.arange(len(twin.body_names) + 1))
    spans = tuple((body, a, b) for body, (a, b) in enumerate(pairwise(edges.tolist())) if b > a)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    indices = twin.relit.indices if twin.relit is not None else np.zeros(0, np.int64)
    return Rig(
        gaussians=twin.gaussians.select(order),
        order=order,
        spans=spans,
        surfaces=tuple(
            (surface, place[indices[surface.rows]]) for surface in surfaces_of(twin.relit, twin.bodies)
        ),
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
    """All Gaussians in the world frame, in the twin's order, for body poses (B, 4, 4)."""
    rigged = rig(twin)
    back = np.empty(len(rigged.order), np.int64)
    back[rigged.order] = np.arange(len(rigged.order))
    return rigged.pose(Ts_world_body).select(back)


def render_state(
    twin: Twin, robot: RobotModel, state: TwinState, camera: Camera, **options: Any
) -> Rendering:
    """Draw a state with its shadows; `options` go to `splatting.rasterizer.render`."""
    world = posed(twin, robot, state)
    if twin.directional_light is None:
        return render(world, camera, **options)
    drawn, surface, taken = draw_lit(
        twin.directional_light, world, shadow_roles(twin, robot), camera, **options
    )
    return replace(drawn, rgb=drawn.rgb * compute_shadow_factors(twin.directional_light, surface * taken))


def shadow_roles(twin: Twin, robot: RobotModel) -> NDArray[np.uint8]:
    """What each Gaussian (N,) does for shadows, see `directional_shadow`.

    The object's static part and the robot's base stand where they were scanned, with their shadows.
    """
    rest = twin.scan_state
    turned = replace(rest, joints=rest.joints + 1.0)
    stand = np.isclose(body_poses(twin, robot, rest), body_poses(twin, robot, turned)).all((1, 2))
    roles = np.where(stand, STANDS, MOVES).astype(np.uint8)
    roles[0], roles[twin.body(PART)] = SCENE, MOVES
    return roles[twin.bodies]


def body_list(robot: RobotModel) -> tuple[str, ...]:
    """Names of a twin's bodies for a robot."""
    return (WORLD, *robot.body_names, OBJECT, PART)
