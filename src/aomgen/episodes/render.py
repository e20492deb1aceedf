"""Images of an episode from fixed cameras, by the twin."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import RigidParts
from aomgen.splatting.session import draw_sessions
from aomgen.twin.shadow import (
    FAR,
    MOVES,
    STANDS,
    DirectionalLight,
    cast_shadow,
    intersect_surface,
    silhouette,
)
from aomgen.twin.twin import (
    OBJECT,
    PART,
    StaticLayer,
    Twin,
    moving_layer,
    shadow_roles,
    static_layer,
    trajectory_body_poses,
)

# Joint values for which the shadow is computed; between them it is interpolated.
SHADOW_STATES: Final = 5
# Frames that are drawn at once; bounds the memory of their colors and shades.
BATCH: Final = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """What moves in the images, T frames.

    Attributes:
        joints: Of the arm, [rad].
        gripper: 0..1.
        thetas: Joint value of the object, [rad] or [m].
        T_world_object: Object pose.
    """

    joints: Annotated[Array, "T _"]
    gripper: Annotated[Array, "T"]
    thetas: Annotated[Array, "T"]
    T_world_object: Matrix4

    __post_init__ = freeze_arrays


def static_layers(
    twin: Twin, cameras: Mapping[str, Camera], threads: int | None = None
) -> dict[str, StaticLayer]:
    """What each camera sees of the scene that never moves; the same for all episodes of a scene."""
    return {name: static_layer(twin, camera, threads) for name, camera in cameras.items()}


def render_frames(
    twin: Twin,
    robot: RobotModel,
    trajectory: Trajectory,
    layers: Mapping[str, StaticLayer],
    T_world_plane: Array | None = None,
    threads: int | None = None,
) -> dict[str, NDArray[np.uint8]]:
    """Draw an episode: frames (T, H, W, 3) uint8 of each camera.

    Args:
        twin: With the object that stands in it.
        layers: From `static_layers`, of the same twin.
        T_world_plane: The surface that the object's shadow falls on; None for no shadow.
        threads: As in `splatting.rasterizer.render`.
    """
    Ts = trajectory_body_poses(
        twin, robot, trajectory.joints, trajectory.gripper, trajectory.thetas, trajectory.T_world_object
    )
    moving = moving_layer(twin)
    shades = {} if T_world_plane is None else _shades(twin, trajectory, layers, T_world_plane)
    arm = (
        None
        if twin.directional_light is None
        else _ArmShadow(twin, robot, twin.directional_light, (Ts[0], not shades), layers)
    )
    batches: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in layers}
    knots = _knots(trajectory.thetas)
    for start in range(0, len(Ts), BATCH):
        thetas = trajectory.thetas[start : start + BATCH]
        darkened = [
            np.stack([_between(shades[name], knots, theta) for theta in thetas]) if name in shades else None
            for name in layers
        ]
        if arm is not None:
            cast = arm.shades(Ts[start : start + BATCH])
            # One light is taken only once.
            darkened = [
                own if other is None else np.minimum(own, other)
                for own, other in zip(cast, darkened, strict=True)
            ]
        sessions = [layer.session for layer in layers.values()]
        motion = moving.motion(Ts[start : start + BATCH])
        drawn = draw_sessions(sessions, moving.gaussians, motion, darkened, threads)
        for name, images in zip(layers, drawn, strict=True):
            batches[name].append(images)
    return {name: np.concatenate(images) for name, images in batches.items()}


class _ArmShadow:
    """The shadow that the robot throws on the surface it works over, from frame to frame.

    Args:
        twin: With a directional light.
        robot: Its robot.
        light: The twin's.
        placed: Body poses (B, 4, 4) of what stands, and whether the object's part throws its shadow too.
        layers: Cameras.
    """

    def __init__(
        self,
        twin: Twin,
        robot: RobotModel,
        light: DirectionalLight,
        placed: tuple[Array, bool],
        layers: Mapping[str, StaticLayer],
    ) -> None:
        Ts_world_body, with_part = placed
        roles = shadow_roles(twin, robot)
        moving, stands = (roles == MOVES) & (with_part | (twin.bodies != twin.body(PART))), roles == STANDS
        self._light, self._arm, self._bodies = light, twin.gaussians.select(moving), twin.bodies[moving]
        parts = RigidParts(indices=twin.bodies[stands], Ts_world_part=Ts_world_body)
        fixed = silhouette(twin.gaussians.select(stands), light.direction, parts)
        self._places = []
        for layer in layers.values():
            depth = np.minimum(layer.depth, FAR).astype(np.float64)
            points, belongs = intersect_surface(light.T_world_plane, layer.camera, depth)
            seen = belongs > 0
            self._places.append((points[seen], belongs[seen] * (1 - fixed.at(points[seen])), seen))

    def shades(self, Ts_world_body: Array) -> list[NDArray[np.float32]]:
        """Factors (T, H, W) on each camera's static image for body poses (T, B, 4, 4)."""
        shade = 1 - float(self._light.shade.mean())
        images = [np.ones((len(Ts_world_body), *seen.shape), np.float32) for _, _, seen in self._places]
        for t, Ts in enumerate(Ts_world_body):
            parts = RigidParts(indices=self._bodies, Ts_world_part=Ts)
            cast = silhouette(self._arm, self._light.direction, parts)
            for image, (points, share, seen) in zip(images, self._places, strict=True):
                image[t][seen] = 1 - shade * share * cast.at(points)
        return images


def _knots(thetas: Array) -> Array:
    return np.linspace(thetas.min(), max(thetas.max(), thetas.min() + 1e-6), SHADOW_STATES)


def _shades(
    twin: Twin, trajectory: Trajectory, layers: Mapping[str, StaticLayer], T_world_plane: Array
) -> dict[str, NDArray[np.float32]]:
    """Factors (SHADOW_STATES, H, W) on each camera's static image, one for each knot."""
    owners, relit = twin.relit_bodies, twin.relit
    members = {name: np.flatnonzero(owners == twin.body(name)) for name in (OBJECT, PART)}
    if relit is None or not len(members[OBJECT]):
        return {}
    light = relit.lights[relit.light_of[members[OBJECT][0]]]
    solid = {name: twin.gaussians.select(relit.indices[rows]) for name, rows in members.items()}
    T_object = trajectory.T_world_object
    places = {
        name: layer.camera.center + layer.camera.directions() * np.minimum(layer.depth, 100.0)[..., None]
        for name, layer in layers.items()
    }
    Ts_part = T_object @ twin.joint.motion(_knots(trajectory.thetas))
    shadows = cast_shadow(
        solid[OBJECT].transformed(T_object),
        [solid[PART].transformed(T) for T in Ts_part],
        T_world_plane,
        light,
    )
    return {
        name: np.stack([shadow.at(seen, layers[name].camera.center) for shadow in shadows])
        for name, seen in places.items()
    }


def _between(images: NDArray[np.float32], knots: Array, theta: float) -> NDArray[np.float32]:
    """Image at a joint value, linear between the knots' images."""
    place = float(np.interp(theta, knots, np.arange(len(knots))))
    first = min(int(place), len(knots) - 2)
    share = np.float32(place - first)
    return (1 - share) * images[first] + share * images[first + 1]
