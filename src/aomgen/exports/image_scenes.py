"""Random scenes of labeled images: pose, size and appearance of the object, joint values, robot joints and cameras."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera, CameraPath
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.joint import LIMIT_SHARE
from aomgen.core.plan import FittedAsset, LightChange, MaterialChange, OrbitChange, Variation
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.episodes.grasps import TILTS_DEG, orientations
from aomgen.episodes.ik import IkSolver, ik_solver, path_residuals, walk
from aomgen.episodes.parameters import GenerationParams
from aomgen.episodes.retarget import DemonstratedMotion
from aomgen.episodes.screening import Place, orbit_camera
from aomgen.episodes.variations import Ranges, draw_independently, scale_fit
from aomgen.errors import ConfigError
from aomgen.lighting.episode_shadows import find_body_spheres
from aomgen.results import Results
from aomgen.robots.robot import RobotConfiguration, longest_reach

# Share of objects that are placed anywhere within reach on the table; the others are placed as in episodes.
WIDE: Final = 0.5
# Range of the yaw of objects on the whole table, [deg].
YAW_DEG: Final = (-60.0, 60.0)
# Ranges of sizes, appearances and lights, see `Ranges`; wider than those of a policy, so that it interpolates.
LOOKS: Final = {
    "scale": (0.6, 1.0),
    "light_turn_deg": (-60.0, 60.0),
    "light_intensity": (0.6, 1.3),
    "light_temperature_k": (4500.0, 9000.0),
    "hue_deg": (-180.0, 180.0),
    "saturation": (0.3, 1.6),
    "brightness": (0.5, 1.4),
}
# Shares of closed objects, of cameras exactly as recorded, and of unchanged materials.
CLOSED, RECORDED, AS_MADE = 0.8, 0.3, 0.4
# Rotation [deg] and distance factor of the other cameras about the recorded handle; offsets of mounted cameras, [m]
# and [deg].
TURN_DEG, TILT_DEG, DISTANCE = (-8.0, 8.0), (-8.0, 8.0), (0.9, 1.1)
MOUNT_M, MOUNT_DEG = 0.004, 1.5
# Distance of the gripper from the grasp along its approach, [m]; standard deviations of its lateral offset, [m], and
# of its rotation, [deg].
BACK_M, ASIDE_M, TURNED_DEG = (0.0, 0.15), 0.015, 5.0
# Number of poses near the handle that are tried, and accepted residuals of the arm, [mm] and [deg].
NEAR_TRIES, RESIDUAL_MM, RESIDUAL_DEG = 12, 3.0, 2.0
# Standard deviation of the arm's joints about the demonstration, [rad]; number of tries for a collision-free arm.
JOINTS_RAD, FREE_TRIES = 0.25, 20
# Bodies moved by at most this number of joints belong to the arm's base, which may be below the level of the table.
FOOT_JOINTS: Final = 2
# Number of states of a scene; share of open grippers; probability that a grasp is chosen before the next one;
# probability that the gripper has rotated with the part.
STATES, OPEN, USUAL, WITH_PART = 8, 0.6, 0.4, 0.5
# Number of sampled poses before an object is refused.
MAX_DRAWS: Final = 2000


# Spheres: index of a body in the twin, center (3,) in the frame of the body, and radius, [m].
Spheres = Sequence[tuple[int, Array, float]]


class SceneMaker:
    """Sampler of scenes in the surroundings of a run.

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
        reach = longest_reach(self._robot)
        low = np.maximum(scene.support.low_xy, reach.shoulder_world[:2] - reach.reach_m)
        high = np.minimum(scene.support.high_xy, reach.shoulder_world[:2] + reach.reach_m)
        # Lower and upper corner (2,) of the scanned table within the arm's reach, world frame, [m].
        self.table = low, high
        corners = ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))
        table = tuple((float(x), float(y)) for x, y in corners)
        self._ranges = (replace(usual, **LOOKS), replace(Ranges(polygon=table, yaw_deg=YAW_DEG), **LOOKS))
        self._places = [
            Place(
                ranges=ranges,
                support=scene.support,
                obstacles=scene.obstacles,
                reach=reach,
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
    def _spheres(self) -> Spheres:
        """Return spheres on the bodies above the arm's base, which may touch the table; see `FOOT_JOINTS`."""
        zero = np.zeros(len(self._robot.joint_names))
        moved_by = RobotConfiguration(robot=self._robot, joints=zero, gripper=0.0).segments()
        return [item for item in find_body_spheres(self._robot) if moved_by[item[0] - 1] > FOOT_JOINTS]

    @cached_property
    def _arm_spheres(self) -> Spheres:
        """Return spheres on the arm without its gripper."""
        hand = {self._robot.body_names.index(name) for name in self._robot.hand_bodies}
        return [item for item in self._spheres if item[0] - 1 not in hand]

    def put_in_place(self, asset: ArticulatedAsset) -> FittedAsset:
        """Place an asset at true size like the recorded object, with the same horizontal handle position."""
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

    def draw(
        self, placed: FittedAsset, rng: np.random.Generator
    ) -> tuple[Variation, FittedAsset, SceneTrajectory]:
        """Sample a scene with an asset from `put_in_place`.

        Returns:
            Pose, size, light and material of the object; the object at its size; and states of robot and object.

        Raises:
            ConfigError: The asset does not fit on the table within the arm's reach.
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
            variation = replace(variation, material=MaterialChange())
        return variation, fitted, self._draw_states(fitted, variation.place_at(fitted), rng)

    def draw_light(self, rng: np.random.Generator) -> LightChange:
        """Sample the light of an image."""
        return draw_independently(rng, 0, 0, self._ranges[0]).light

    def draw_cameras(self, rng: np.random.Generator) -> Iterator[tuple[str, Camera]]:
        """Yield the fixed cameras by name, world frame, most of them slightly moved."""
        for name, camera in self.cameras.items():
            turn, tilt = (float(np.radians(rng.uniform(*span))) for span in (TURN_DEG, TILT_DEG))
            change = OrbitChange(turn=turn, tilt=tilt, distance=float(rng.uniform(*DISTANCE)))
            keep = rng.random() < RECORDED
            yield name, camera if keep else orbit_camera(camera, self._recorded_handle, change)

    def draw_paths(
        self, states: SceneTrajectory, rng: np.random.Generator
    ) -> Iterator[tuple[str, CameraPath]]:
        """Yield the robot's cameras in the states by name, displaced by random errors of their mounts."""
        for name, path in self._robot.camera_paths(states.joints, states.gripper).items():
            turns = matrix_from_rotvec(np.radians(MOUNT_DEG) * rng.normal(size=(len(states), 3)))
            moves = transform(turns, MOUNT_M * rng.normal(size=(len(states), 3)))
            camera = path.camera.resize(*self._size)
            yield name, CameraPath(camera=camera, Ts_world_cam=path.Ts_world_cam @ moves)

    def _draw_states(self, fitted: FittedAsset, T: Array, rng: np.random.Generator) -> SceneTrajectory:
        """Sample states: a random arm in the first half, a gripper near the handle in the second half."""
        thetas = [self._draw_theta(fitted, rng) for _ in range(STATES)]
        joints = [
            self._draw_near(fitted, theta, T, rng)
            if k >= STATES // 2
            else self._draw_free(fitted, theta, T, rng)
            for k, theta in enumerate(thetas)
        ]
        closed = np.where(rng.random(STATES) < OPEN, 0.0, rng.uniform(0, 1, STATES))
        return SceneTrajectory(
            times_s=np.arange(STATES, dtype=np.float64),
            joints=np.stack(joints),
            gripper=closed,
            thetas=np.array(thetas),
            T_world_object=T,
        )

    def _draw_theta(self, fitted: FittedAsset, rng: np.random.Generator) -> float:
        share = 0.0 if rng.random() < CLOSED else rng.uniform(0, LIMIT_SHARE)
        return float(share * fitted.asset.joint.upper)

    def _draw_free(self, fitted: FittedAsset, theta: float, T: Array, rng: np.random.Generator) -> Array:
        """Sample joints (J,) near a random configuration of the demonstration, without contact with the object."""
        demo = self._results.demonstration
        low, high = self._robot.joint_limits.T
        joints = demo.joints[rng.integers(len(demo))]
        for _ in range(FREE_TRIES):
            shown = demo.joints[rng.integers(len(demo))]
            joints = np.clip(shown + rng.normal(0, JOINTS_RAD, len(shown)), low, high)
            if self._is_free(joints, fitted, theta, T, self._spheres):
                break
        return joints

    def _draw_near(self, fitted: FittedAsset, theta: float, T: Array, rng: np.random.Generator) -> Array:
        """Sample joints (J,) with the gripper near the handle; if no such pose is reachable, use `_draw_free`."""
        asset, Ts = fitted.asset, np.tile(np.eye(4), (NEAR_TRIES, 1, 1))
        R_front = self._motion.hand_at_closed(self._reference)
        choices = [R for _, R in orientations(R_front, asset.handle_axis, TILTS_DEG)]
        moved = asset.joint.motion(theta)
        for T_ee in Ts:
            # Episodes prefer the first orientations.
            R = choices[min(int(rng.geometric(USUAL)) - 1, len(choices) - 1)]
            R = R @ matrix_from_rotvec(np.radians(TURNED_DEG) * rng.normal(size=3))
            turned = moved[:3, :3] @ R if rng.random() < WITH_PART else R
            aside = ASIDE_M * rng.normal(size=2)
            point = apply(moved, asset.handle_point) + turned @ [*aside, -rng.uniform(*BACK_M)]
            T_ee[:] = T @ transform(turned, point)
        demo = self._results.demonstration
        start = demo.contact_frames[0]
        joints = walk(self._solver, demo.Ts_world_ee[start], Ts, demo.joints[start])
        mm, deg = path_residuals(self._solver, Ts, joints)
        for k in np.flatnonzero((mm < RESIDUAL_MM) & (deg < RESIDUAL_DEG)):
            if self._is_free(joints[k], fitted, theta, T, self._arm_spheres):
                return joints[k]
        return self._draw_free(fitted, theta, T, rng)

    def _is_free(self, joints: Array, fitted: FittedAsset, theta: float, T: Array, spheres: Spheres) -> bool:
        """Return whether spheres on the robot's bodies are outside the object and above the table."""
        bodies = self._robot.link_poses(joints[None], 0.0)[0]
        centers = np.stack([apply(bodies[body - 1], center) for body, center, _ in spheres])
        radii = np.array([radius for *_, radius in spheres])
        asset, local = fitted.asset, apply(invert(T), centers)
        away = asset.static.distances(local)
        away = np.minimum(away, asset.moving.distances(apply(invert(asset.joint.motion(theta)), local)))
        height = centers[:, 2] - self._results.episode_scene.support.height
        return bool((away > radii).all() and (height > radii).all())
