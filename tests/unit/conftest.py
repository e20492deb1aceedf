"""A small scene with everything known: robot, table, wall, and a microwave with its light."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC, linear_from_srgb, srgb_from_linear
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.core.light import Light, hemisphere_light, light_from_harmonics
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.lighting.light_estimation import REFLECTED
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel
from aomgen.splatting.surfels import Surfels, surfels_of
from aomgen.twin.binding import bind
from aomgen.twin.twin import TwinModel, TwinState
from broken_captures import write_small
from diffuse_shading import shaded_srgb
from small_robot import urdf_text

TABLE_SRGB = np.array([0.6, 0.45, 0.3])


@dataclass(frozen=True)
class ToyScene:
    """What a perfect reconstruction of the scene would give, and what is true about it."""

    robot: RobotModel
    gaussians: Gaussians
    labels: np.ndarray
    twin: TwinModel
    light: Light
    asset: ArticulatedAsset
    surfels: tuple[Surfels, Surfels]
    camera: Camera


def lit(surfels: Surfels, light: Light, R_world_body: np.ndarray) -> Gaussians:
    """Surfels with the colors that the light gives them."""
    colors = shaded_srgb(surfels.albedo_linear, surfels.transfer, light.view_from(R_world_body))
    return surfels.gaussians.with_sh(((colors - 0.5) / SH_C0)[:, None])


def sheet(count: int, low: tuple, high: tuple, axis: int, at: float, color: np.ndarray, rng) -> Gaussians:
    """A flat random carpet across one axis; its harmonics of degree 1 are small and random."""
    means = np.insert(rng.uniform(low, high, (count, 2)), axis, at, axis=1)
    scales = np.full((count, 3), 0.011)
    scales[:, axis] = 0.001
    sh = rng.normal(0, 0.01, (count, 4, 3))
    sh[:, 0] = (color + rng.normal(0, 0.01, (count, 1)) - 0.5) / SH_C0
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    return gaussians_of(means=means, quats=quats, scales=scales, opacities=np.full(count, 0.95), sh=sh)


def robot_gaussians(robot: RobotModel, Ts: np.ndarray, light: Light, rng) -> tuple[Gaussians, np.ndarray]:
    """The robot's surface, lit, and the body of each Gaussian."""
    parts, bodies = [], []
    for mesh in robot.meshes:
        vertices = apply(Ts[mesh.body], mesh.vertices_body)
        points, faces, _ = sample_surface(vertices, mesh.faces, 250, rng)
        normals = face_normals_areas(vertices, mesh.faces)[0][faces]
        colors = srgb_from_linear((linear_from_srgb(mesh.color_srgb) + REFLECTED) * light.irradiance(normals))
        parts.append(
            gaussians_of(
                means=points,
                quats=np.tile([1.0, 0, 0, 0], (250, 1)),
                scales=np.full((250, 3), 0.01),
                opacities=np.full(250, 0.9),
                sh=((np.minimum(colors, 1) - 0.5) / SH_C0)[:, None],
            )
        )
        bodies.append(np.full(250, mesh.body, np.int32))
    return concatenate(parts), np.concatenate(bodies)


@pytest.fixture(scope="session")
def made() -> Callable[[str, int], ArticulatedAsset]:
    """Makes the asset of a category and seed, once; everything in it is frozen."""
    return cache(make_asset)


@pytest.fixture(scope="session")
def robot() -> RobotModel:
    """Loaded once; everything in it is frozen."""
    return load_robot("ur5e_2f85")


@pytest.fixture(scope="session")
def toy_scene(robot: RobotModel) -> ToyScene:
    """Built once; everything in it is frozen."""
    rng = np.random.default_rng(0)
    joints = np.array([-0.3, -1.9, 1.9, -1.57, -1.57, 0.0])
    radiance = np.array(hemisphere_light((0.9, 0.85, 0.8), (0.3, 0.3, 0.3)).radiance_sh)
    radiance[3] -= 0.4
    light = light_from_harmonics(radiance)
    arm, bodies = robot_gaussians(robot, robot.link_poses(joints[None], [0.0])[0], light, rng)
    T = transform(matrix_from_rotvec(np.array([0, 0, 0.3 - np.pi / 2])), np.array([0.65, -0.1, 0.0]))
    asset = make_asset("microwave", 3)
    surfels = (surfels_of(asset.static.meshes, 5000, rng), surfels_of(asset.moving.meshes, 4000, rng))
    static, moving = (lit(s, light, T[:3, :3]).transform(T) for s in surfels)
    table = sheet(24_000, (-0.2, -0.9), (1.2, 0.8), 2, 0.0, TABLE_SRGB, rng)
    wall = sheet(6_000, (-1.5, 0.0), (1.5, 1.4), 0, 1.3, np.array([0.7, 0.7, 0.75]), rng)
    gaussians = concatenate([arm, static, moving, table, wall])
    counts = (len(arm), len(static), len(moving), len(table) + len(wall))
    labels = np.repeat(np.array([ROBOT, STATIC, MOVING, BACKGROUND], np.uint8), counts)
    robot_bodies = np.concatenate([bodies, np.full(sum(counts[1:]), -1, np.int32)])
    state = TwinState(joints=joints, gripper=0.0, theta=0.0, T_world_object=T)
    twin = bind(gaussians, labels, robot_bodies, robot, asset.joint.move(T), state)
    pose = look_at((-0.4, -0.9, 0.7), (0.5, -0.05, 0.1))
    camera = Camera(fx=150, fy=150, cx=80, cy=60, width=160, height=120, T_world_cam=pose)
    return ToyScene(
        robot=robot,
        gaussians=gaussians,
        labels=labels,
        twin=twin,
        light=light,
        asset=asset,
        surfels=surfels,
        camera=camera,
    )


@pytest.fixture(scope="session")
def small_capture(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled capture with fewer, smaller images and frames; read only."""
    folder = tmp_path_factory.mktemp("small") / "capture"
    write_small(sample, folder)
    return folder


@pytest.fixture
def small_copy(small_capture: Path, tmp_path: Path) -> Path:
    """A copy of the small capture that a test may damage."""
    return Path(shutil.copytree(small_capture, tmp_path / "capture"))


@pytest.fixture
def write_urdf(tmp_path: Path) -> Callable[..., Path]:
    """Writes the small robot, changed as the arguments of `urdf_text` say."""

    def write(**changes: object) -> Path:
        path = tmp_path / "robot.urdf"
        path.write_text(urdf_text(**changes))  # pyright: ignore[reportArgumentType]
        return path

    return write
