"""Random scenes of labelled images: an object's pose, size and look, joint values, the robot's joints, and cameras."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.joint import LIMIT_SHARE
from aomgen.core.plan import FittedAsset, LightChange, OrbitChange, Variation
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.episodes.factory import GenerationParams
from aomgen.episodes.grasps import TILTS_DEG, orientations
from aomgen.episodes.ik import IkSolver, ik_solver, path_residuals, walk
from aomgen.episodes.retarget import DemonstratedMotion
from aomgen.episodes.screening import Place, orbit_camera
from aomgen.episodes.variations import Ranges, draw_independently, scale_fit
from aomgen.errors import ConfigError
from aomgen.lighting.episode_shadows import find_body_spheres
from aomgen.results import Results
from aomgen.robots.robot import longest_reach

# Half of the objects stand where episodes put them, the others anywhere on the table that the arm reaches.
WIDE: Final = 0.5
# Rotations of objects on the whole table, [deg]; sizes; looks and lights, see `Ranges`.
YAW_DEG: Final = (-60.0, 60.0)
LOOKS: Final = {
    "scale": (0.6, 1.0),
    "light_turn_deg": (-60.0, 60.0),
    "light_intensity": (0.6, 1.3),
    "light_temperature_k": (4500.0, 9000.0),
    "hue_deg": (-180.0, 180.0),
    "saturation": (0.3, 1.6),
    "brightness": (0.5, 1.4),
}
# Share of closed objects, of the cameras exactly as recorded, and of materials as they were made.
CLOSED, RECORDED, AS_MADE = 0.5, 0.3, 0.4
# Motion of the other cameras about the recorded handle, [deg] and factor; of mounted ones, [m] and [deg].
TURN_DEG, TILT_DEG, DISTANCE = (-8.0, 8.0), (-8.0, 8.0), (0.9, 1.1)
MOUNT_M, MOUNT_DEG = 0.004, 1.5
# Distance of the gripper from the grasp along its approach, [m]; standard deviations across it, [m], and of its rotation, [deg].
BACK_M, ASIDE_M, TURNED_DEG = (0.0, 0.15), 0.015, 5.0
# Poses near the handle that are tried, and residuals of the arm that is accepted, [mm] and [deg].
NEAR_TRIES, RESIDUAL_MM, RESIDUAL_DEG = 12, 3.0, 2.0
# Standard deviation of the arm's joints about those of the demonstration, [rad], and tries to keep it off the object.
JOINTS_RAD, FREE_TRIES = 0.25, 20
# States of a scene with the arm anywhere, and with the gripper near the handle: of these only as many for fixed cameras.
FREE_STATES, NEAR_STATES = 2, 4
# Draws of a pose before an object is refused.
MAX_DRAWS: Final = 2000


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneState:
    """One state of a scene: the arm's joints (J,), the gripper 0 open .. 1 closed, and the object's joint value."""

    joints: Array
    gripper: float
    theta: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneView:
    """An image of a scene: name and pose of the camera, world frame, state, and intensity and color of the light."""

    name: str
    camera: Camera
    state: SceneState
    light: LightChange


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageScene:
    """A random scene.

    Attributes:
        variation: Pose, size, light and material of the object.
        fitted: The object at its size.
        T_world_object: Its pose (4, 4).
        fixed_views: Images of fixed cameras, with equal optics.
        carried_views: Images of the robot's cameras, with equal optics.
    """

    variation: Variation
    fitted: FittedAsset
    T_world_object: Array
    fixed_views: tuple[SceneView, ...]
    carried_views: tuple[SceneView, ...]


class SceneMaker:
    """Draws scenes in a run's room.

    Args:
        results: Results of a run with the stage "replacement".
        size: Width and height of the images, [px].
    """

    def __init__(self, results: Results, size: tuple[int, int]) -> None:
        self._results, self._robot, self._size = results, results.robot, size
        scene, first = results.episode_scene, results.fitted_assets[0]
        self._reference = first
        self._recorded_handle = apply(first.T_world_asset, first.contact_asset)
        self.cameras = {name: camera.resize(*size) for name, camera in scene.cameras.items()}
        usual = results.params("episodes", GenerationParams()).ranges
        low, high = scene.support.low_xy, scene.support.high_xy
        corners = ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))
        table = tuple((float(x), float(y)) for x, y in corners)
        self._ranges = (replace(usual, **LOOKS), replace(Ranges(polygon=table, yaw_deg=YAW_DEG), **LOOKS))
        self._places = [
            Place(
                ranges=ranges,
                support=scene.support,
                obstacles=scene.obstacles,
                reach=longest_reach(self._robot),
                cameras=self.cameras,
            )
            for ranges in self._ranges
        ]

    @cached_property
    def _solver(self) -> IkSolver:
        return ik_solver(self._robot)

    @cached_property
    def _motion(self) -> DemonstratedMotion:
        return DemonstratedMotion(self._results.demonstration)

    @cached_property
    def _spheres(self) -> list[tuple[int, Array, float]]:
        return find_body_spheres(self._robot)

    def put_in_place(self, asset: ArticulatedAsset) -> FittedAsset:
        """Put an asset at true size where the recorded object stood, handle at the recorded handle as seen from above."""
        R = self._reference.T_world_asset[:3, :3]
        offset = self._recorded_handle - R @ asset.handle_point
        height = self._results.episode_scene.support.height
        return FittedAsset(
            asset=asset,
            T_world_asset=transform(R, [offset[0], offset[1], height]),
            contact_asset=asset.handle_point,
            shares=np.array([0.0, 1.0]),
            thetas=np.array([0.0, LIMIT_SHARE * asset.joint.upper]),
            scale=1.0,
            mirrored=False,
            mode="trajectory",
            residual_mm=0.0,
        )

    def draw(self, placed: FittedAsset, rng: np.random.Generator) -> ImageScene:
        """Draw a scene with an asset from `put_in_place`.

        Raises:
            ConfigError: The table has no room for the asset within the arm's reach.
        """
        for _ in range(MAX_DRAWS):
            wide = int(rng.random() < WIDE)
            variation = draw_independently(rng, 0, 0, self._ranges[wide])
            fitted = scale_fit(placed, variation.scale)
            if self._places[wide].find_obstruction(variation, fitted) is None:
                break
        else:
            raise ConfigError(
                placed.asset.name, "has no room on the table within the arm's reach", "choose another asset"
            )
        if rng.random() < AS_MADE:
            variation = replace(variation, material=type(variation.material)())
        T = variation.place_at(fitted)
        free = [self._draw_free(fitted, T, rng) for _ in range(FREE_STATES)]
        near = [self._draw_near(fitted, T, rng) for _ in range(NEAR_STATES)]
        fixed = [view for state in free + near[:FREE_STATES] for view in self._fixed_views(state, rng)]
        carried = [view for state in near for view in self._carried_views(state, rng)]
        return ImageScene(
            variation=variation,
            fitted=fitted,
            T_world_object=T,
            fixed_views=tuple(fixed),
            carried_views=tuple(carried),
        )

    def _fixed_views(self, state: SceneState, rng: np.random.Generator) -> Iterator[SceneView]:
        """Yield an image of each fixed camera, most of them moved a little."""
        for name, camera in self.cameras.items():
            turn, tilt = (float(np.radians(rng.uniform(*span))) for span in (TURN_DEG, TILT_DEG))
            change = OrbitChange(turn=turn, tilt=tilt, distance=float(rng.uniform(*DISTANCE)))
            keep = rng.random() < RECORDED
            moved = camera if keep else orbit_camera(camera, self._recorded_handle, change)
            yield SceneView(name=name, camera=moved, state=state, light=self._draw_light(rng))

    def _carried_views(self, state: SceneState, rng: np.random.Generator) -> Iterator[SceneView]:
        """Yield an image of each of the robot's cameras, displaced as mounts differ from robot to robot."""
        for name, path in self._robot.camera_paths(state.joints[None], state.gripper).items():
            turn = matrix_from_rotvec(np.radians(MOUNT_DEG) * rng.normal(size=3))
            T = path.Ts_world_cam[0] @ transform(turn, MOUNT_M * rng.normal(size=3))
            camera = path.camera.resize(*self._size).move(T)
            yield SceneView(name=name, camera=camera, state=state, light=self._draw_light(rng))

    def _draw_light(self, rng: np.random.Generator) -> LightChange:
        return draw_independently(rng, 0, 0, self._ranges[0]).light

    def _draw_theta(self, fitted: FittedAsset, rng: np.random.Generator) -> float:
        share = 0.0 if rng.random() < CLOSED else rng.uniform(0, LIMIT_SHARE)
        return float(share * fitted.asset.joint.upper)

    def _draw_free(self, fitted: FittedAsset, T: Array, rng: np.random.Generator) -> SceneState:
        """Draw a state with the arm near a random configuration of the demonstration, off the object."""
        demo, theta = self._results.demonstration, self._draw_theta(fitted, rng)
        low, high = self._robot.joint_limits.T
        joints = demo.joints[rng.integers(len(demo))]
        for _ in range(FREE_TRIES):
            shown = demo.joints[rng.integers(len(demo))]
            joints = np.clip(shown + rng.normal(0, JOINTS_RAD, len(shown)), low, high)
            if self._is_free(joints, fitted, theta, T):
                break
        return SceneState(joints=joints, gripper=self._draw_gripper(rng), theta=theta)

    def _draw_near(self, fitted: FittedAsset, T: Array, rng: np.random.Generator) -> SceneState:
        """Draw a state with the gripper near the handle; where the arm reaches none, the arm is anywhere."""
        asset, theta = fitted.asset, self._draw_theta(fitted, rng)
        R_front = self._motion.hand_at_closed(self._reference)
        choices = [R for _, R in orientations(R_front, asset.handle_axis, TILTS_DEG)]
        Ts = np.tile(np.eye(4), (NEAR_TRIES, 1, 1))
        moved = asset.joint.motion(theta)
        for T_ee in Ts:
            # The first orientations are those that episodes prefer.
            R = choices[min(int(rng.geometric(0.4)) - 1, len(choices) - 1)]
            R = R @ matrix_from_rotvec(np.radians(TURNED_DEG) * rng.normal(size=3))
            turned = moved[:3, :3] @ R if rng.random() < 0.5 else R
            aside = ASIDE_M * rng.normal(size=2)
            point = apply(moved, asset.handle_point) + turned @ [*aside, -rng.uniform(*BACK_M)]
            T_ee[:] = T @ transform(turned, point)
        demo = self._results.demonstration
        start = demo.contact_frames[0]
        joints = walk(self._solver, demo.Ts_world_ee[start], Ts, demo.joints[start])
        mm, deg = path_residuals(self._solver, Ts, joints)
        found = np.flatnonzero((mm < RESIDUAL_MM) & (deg < RESIDUAL_DEG))
        if not len(found):
            return self._draw_free(fitted, T, rng)
        return SceneState(joints=joints[found[0]], gripper=self._draw_gripper(rng), theta=theta)

    def _draw_gripper(self, rng: np.random.Generator) -> float:
        return 0.0 if rng.random() < 0.6 else float(rng.uniform(0, 1))

    def _is_free(self, joints: Array, fitted: FittedAsset, theta: float, T: Array) -> bool:
        """Return whether the arm, as spheres, is off the object and the table."""
        bodies = self._robot.link_poses(joints[None], 0.0)[0]
        centers = np.stack([apply(bodies[body - 1], center) for body, center, _ in self._spheres])
        radii = np.array([radius for *_, radius in self._spheres])
        asset, local = fitted.asset, apply(np.linalg.inv(T), centers)
        away = asset.static.distances(local)
        away = np.minimum(
            away, asset.moving.distances(apply(np.linalg.inv(asset.joint.motion(theta)), local))
        )
        height = centers[:, 2] - self._results.episode_scene.support.height
        carried = np.array([body for body, *_ in self._spheres]) > 2
        return bool((away > radii).all() and (height > radii)[carried].all())
