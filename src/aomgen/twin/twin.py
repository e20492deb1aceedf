"""The twin: a robot and an articulated object with Gaussians attached to their bodies.

A state determines the body poses, Gaussians move with their bodies, and images are rendered from the Gaussians. For many
images from a fixed camera, static Gaussians are rendered once, and moving ones remain in the frames of their bodies.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.conventions import BACKGROUND
from aomgen.core.camera import Camera
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate
from aomgen.core.joint import Joint
from aomgen.core.light import DirectionalLight, Light
from aomgen.core.values import Array, Matrix4, freeze_arrays, require_indices
from aomgen.robots.robot import RobotModel
from aomgen.splatting.session import Motion, RenderSession
from aomgen.twin.relighting import Relighting, Relit

WORLD: Final = "world"
OBJECT: Final = "object"
PART: Final = "part"
# Margin around moving bodies when the scene behind them is compared with an image, [px]; the contours in rendering and image
# differ by about this distance.
CONTOUR_PX: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinState:
    """Configuration of robot and object.

    Attributes:
        joints: Arm joints (J,), [rad] or [m].
        gripper: Gripper, 0 open .. 1 closed.
        theta: Joint value of the object, [rad] or [m].
        T_world_object: Pose of the object (4, 4).
    """

    joints: Annotated[Array, "_"]
    gripper: float
    theta: float
    T_world_object: Matrix4

    __post_init__ = freeze_arrays


def interpolate_state(trajectory: SceneTrajectory, time_s: float) -> TwinState:
    """Interpolate the state at a time, [s]; it is constant before the first and after the last sample."""
    now = trajectory.at([time_s])
    return TwinState(
        joints=now.joints[0],
        gripper=float(now.gripper[0]),
        theta=float(now.thetas[0]),
        T_world_object=trajectory.T_world_object,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PosedImages:
    """Images from one camera pose with the same exposure.

    Attributes:
        camera: Camera of all of them, world frame.
        images_srgb: Images (H, W, 3), uint8.
        states: State of the twin in each image.
    """

    camera: Camera
    images_srgb: tuple[NDArray[np.uint8], ...]
    states: tuple[TwinState, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinModel:
    """A scene with N Gaussians on B bodies that can be moved.

    Attributes:
        robot: Name of the robot's model.
        gaussians: Gaussians, each in the frame of its body.
        bodies: Index into `body_names` (N,).
        labels: Part labels (N,), see `conventions.PART_LABELS`.
        body_names: "world", the robot's bodies, "object" (static part), "part" (moving part).
        joint: The object's joint, object frame; "part" coincides with "object" at value 0.
        T_world_object: Pose of the object in the scan (4, 4).
        scan_state: State during the scan.
        relit: Surfaces that are relit in every frame; None if all colors are those of the scan.
        directional_light: Light that casts the shadows of moving bodies on the table; the colors of the table are then
            without these shadows. None if shadows remain as scanned.
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
        require_indices(self.bodies, len(self.body_names))
        if self.relit is not None:
            require_indices(self.relit.indices, len(self.gaussians))

    def body(self, name: str) -> int:
        """Return the index of a body."""
        return self.body_names.index(name)

    @property
    def relit_bodies(self) -> NDArray[np.int32]:
        """Body of every relit Gaussian (M,)."""
        return self.bodies[self.relit.indices] if self.relit is not None else np.zeros(0, np.int32)

    def find_light(self, name: str) -> Light:
        """Return the light of a relit body.

        Raises:
            ValueError: The body is not relit; a programming error.
        """
        rows = np.flatnonzero(self.relit_bodies == self.body(name))
        if self.relit is None or not len(rows):
            raise ValueError(f"the twin's body {name} is not relit")
        return self.relit.lights[self.relit.light_of[rows[0]]]

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Mask (N,) of the Gaussians that are not fixed to the world."""
        return self.bodies != 0

    def extend(
        self, gaussians: Gaussians, bodies: ArrayLike, labels: ArrayLike, **changes: Any
    ) -> "TwinModel":
        """Append Gaussians to the twin.

        Args:
            gaussians: N Gaussians in the frames of their bodies.
            bodies: Body of each Gaussian (N,), or one for all.
            labels: Part label of each Gaussian (N,), or one for all.
            **changes: Other fields of the twin that are replaced.
        """
        count = len(gaussians)
        return replace(
            self,
            gaussians=concatenate([self.gaussians, gaussians]),
            bodies=np.append(self.bodies, np.broadcast_to(bodies, count)),
            labels=np.append(self.labels, np.broadcast_to(labels, count)),
            **changes,
        )

    @property
    def of_scene(self) -> NDArray[np.bool_]:
        """Mask (N,) of the static Gaussians that belong neither to the robot nor to the object."""
        return (self.labels == BACKGROUND) & (self.bodies == 0)

    @property
    def scene(self) -> Gaussians:
        """Gaussians of the scene (see `of_scene`), world frame."""
        return self.gaussians.select(self.of_scene)

    def select(self, which: NDArray[np.bool_]) -> "TwinModel":
        """Return the twin with those Gaussians that a boolean mask (N,) selects."""
        return replace(
            self,
            gaussians=self.gaussians.select(which),
            bodies=self.bodies[which],
            labels=self.labels[which],
            relit=None if self.relit is None else self.relit.select(which),
        )


def trajectory_body_poses(
    twin: TwinModel,
    robot: RobotModel,
    joints: ArrayLike,
    gripper: ArrayLike,
    thetas: ArrayLike,
    T_world_object: ArrayLike,
) -> Array:
    """Compute the body poses (T, B, 4, 4) of a trajectory of T samples.

    Args:
        twin: Twin with B bodies.
        robot: Robot of the twin.
        joints: Arm joints (T, J), [rad] or [m].
        gripper: Gripper (T,), 0 open .. 1 closed.
        thetas: Joint values of the object (T,), [rad] or [m].
        T_world_object: Pose of the object (4, 4).
    """
    joints, thetas = np.asarray(joints, np.float64), np.asarray(thetas, np.float64)
    Ts = np.tile(np.eye(4), (len(joints), len(twin.body_names), 1, 1))
    Ts[:, 1 : 1 + len(robot.body_names)] = robot.link_poses(joints, np.asarray(gripper, np.float64))
    Ts[:, twin.body(OBJECT)] = T_world_object
    Ts[:, twin.body(PART)] = np.asarray(T_world_object, np.float64) @ twin.joint.motion(thetas)
    return Ts


def body_poses(twin: TwinModel, robot: RobotModel, state: TwinState) -> Array:
    """Compute the body poses (B, 4, 4) in one state."""
    return trajectory_body_poses(
        twin, robot, state.joints[None], [state.gripper], [state.theta], state.T_world_object
    )[0]


def pose_twin(twin: TwinModel, robot: RobotModel, state: TwinState) -> Gaussians:
    """Transform all Gaussians to the world frame in one state, in the order of the twin."""
    return pose_bodies(twin, body_poses(twin, robot, state))


def pose_bodies(twin: TwinModel, Ts_world_body: Array) -> Gaussians:
    """Transform all Gaussians to the world frame for body poses (B, 4, 4), and update the colors of relit ones."""
    world = move_bodies(twin.gaussians, twin.bodies, Ts_world_body)
    if twin.relit is None:
        return world
    sh = np.array(world.sh)
    colors = twin.relit.colors_srgb(twin.relit_bodies, Ts_world_body[None])[0]
    sh[twin.relit.indices, 0] = (colors - 0.5) / SH_C0
    return world.with_sh(sh)


def move_bodies(gaussians: Gaussians, bodies: NDArray[np.int32], Ts: Array) -> Gaussians:
    """Transform N Gaussians by the transforms (B, 4, 4) of their bodies (N,), and keep their order; body 0 is the world."""
    order = np.argsort(bodies, kind="stable")
    pieces = []
    for body in np.unique(bodies):
        members = gaussians.select(np.flatnonzero(bodies == body))
        pieces.append(members if body == 0 else members.transform(Ts[body]))
    return concatenate(pieces).select(np.argsort(order))


def standing_bodies(twin: TwinModel, robot: RobotModel) -> NDArray[np.bool_]:
    """Return the mask (B,) of the bodies that no joint moves: the world, the robot's base and the object's static part."""
    rest = twin.scan_state
    turned = replace(rest, joints=rest.joints + 1.0)
    near = np.isclose(body_poses(twin, robot, rest), body_poses(twin, robot, turned))
    return near.all((1, 2)) & (np.arange(len(near)) != twin.body(PART))


def body_list(robot: RobotModel) -> tuple[str, ...]:
    """Return the names of a twin's bodies for a robot."""
    return (WORLD, *robot.body_names, OBJECT, PART)


@dataclass(frozen=True, slots=True, kw_only=True)
class StaticLayer:
    """View of a camera without moving bodies.

    Attributes:
        session: Session that renders moving Gaussians into the view.
        depth: Median depth (H, W), [m], infinite for empty pixels.
    """

    session: RenderSession
    depth: NDArray[np.float32]

    @property
    def camera(self) -> Camera:
        """Camera of the view."""
        return self.session.camera


def static_layer(twin: TwinModel, camera: Camera, threads: int | None = None) -> StaticLayer:
    """Render the view of a camera without moving bodies.

    Args:
        twin: Twin with static and moving bodies.
        camera: Camera, world frame.
        threads: See `RenderSession`.
    """
    session = RenderSession(twin.gaussians.select(~twin.moves), camera, threads=threads)
    drawn = session.draw(twin.gaussians.select(np.zeros(0, np.int64)), with_ids=True)
    median = np.asarray(drawn.median_depth)
    depth = np.where(median > 0, median, drawn.depth)
    return StaticLayer(session=session, depth=np.where(drawn.alpha > 0.1, depth, np.inf).astype(np.float32))


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingLayer:
    """Moving Gaussians of a twin, prepared for many frames.

    Attributes:
        gaussians: N Gaussians in body frames; the M relit ones are last, in the order of `relighting`.
        bodies: Body of each Gaussian (N,).
        labels: Part label of each Gaussian (N,).
        relighting: Relighting of the relit Gaussians; None if there are none.
    """

    gaussians: Gaussians
    bodies: NDArray[np.int32]
    labels: NDArray[np.uint8]
    relighting: Relighting | None

    def motion(self, Ts_world_body: ArrayLike) -> Motion:
        """Return the motion and the colors of the Gaussians for body poses (T, B, 4, 4)."""
        Ts = np.asarray(Ts_world_body, np.float64)
        colors = None if self.relighting is None else self.relighting.colors_srgb(Ts)
        return Motion(parts=self.bodies, Ts_world_part=Ts, colors=colors)


def moving_layer(moving: TwinModel) -> MovingLayer:
    """Prepare a twin that contains only moving Gaussians."""
    lit, relighting = np.zeros(0, np.int64), None
    if moving.relit is not None and len(moving.relit.indices):
        relighting = Relighting(moving.relit, moving.relit_bodies)
        lit = moving.relit.indices[relighting.order]
    plain = np.setdiff1d(np.arange(len(moving.bodies)), lit)
    order = np.concatenate([plain[np.argsort(moving.bodies[plain], kind="stable")], lit])
    return MovingLayer(
        gaussians=moving.gaussians.select(order),
        bodies=moving.bodies[order],
        labels=moving.labels[order],
        relighting=relighting,
    )
