"""A textured panel in front of a wall, moved by a joint and rendered to a video by our engine."""

from dataclasses import dataclass

import numpy as np

from aomgen.conventions import BACKGROUND, MOVING
from aomgen.core.alignment import Clock
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.core.joint import Joint
from aomgen.core.values import Array
from aomgen.io.video import Video
from aomgen.motion.inputs import MotionInput
from aomgen.motion.kinematic_prior import KinematicPrior, shift_joint
from aomgen.splatting.rasterizer import render

HINGE = Joint(type="revolute", axis=np.array([0, 0, 1.0]), origin=np.zeros(3), lower=0.0, upper=1.0)
SLIDE = Joint(
    type="prismatic", axis=np.array([0.8, -0.6, 0.0]), origin=np.array([0.15, 0, 0]), lower=0.0, upper=0.2
)
HELD = np.array([0.3, 0.0, 0.0])
TIMES_S = np.arange(36) / 10
MOTION_S = (0.8, 3.0)
SHARES = np.clip((TIMES_S - MOTION_S[0]) / (MOTION_S[1] - MOTION_S[0]), 0, 1)
CAMERA = Camera(
    fx=170.0,
    fy=170.0,
    cx=72.0,
    cy=54.0,
    width=144,
    height=108,
    T_world_cam=look_at([0.35, -0.75, 0.25], [0.12, -0.05, 0.0]),
)


def _sheet(corner: Array, sides: Array, count: int, luma: Array) -> Gaussians:
    steps = (np.arange(count) + 0.5) / count
    u, v = (grid.ravel() for grid in np.meshgrid(steps, steps))
    means = corner + np.outer(u, sides[0]) + np.outer(v, sides[1])
    size = float(np.linalg.norm(sides[0])) / count * 0.7
    return gaussians_of(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (len(means), 1)),
        scales=np.full((len(means), 3), size),
        opacities=np.full(len(means), 0.95),
        sh=np.repeat((luma.reshape(-1, 1, 1) - 0.5) / SH_C0, 3, axis=2),
    )


def _texture(count: int, seed: int, contrast: float) -> Array:
    coarse = np.random.default_rng(seed).uniform(-1, 1, (count // 4, count // 4))
    return 0.5 + 0.5 * contrast * np.kron(coarse, np.ones((4, 4)))


@dataclass(frozen=True, kw_only=True)
class World:
    """A panel in front of a wall, its joint, and the path of the gripper that moves it."""

    demo: MotionInput
    hidden: Array
    joint: Joint
    thetas: Array

    def masks_at(self, times_s: Array, width: int, height: int) -> Array:
        assert (width, height) == (CAMERA.width, CAMERA.height)
        return self.hidden[np.round(times_s * 10).astype(int)]

    def hand(self, x: Array, factor: float) -> KinematicPrior:
        thetas = self.thetas * factor
        return KinematicPrior(
            joint=shift_joint(self.joint, self.joint.origin, np.asarray(x)),
            held_world=HELD,
            covariance=np.diag([4.5e-4, 4.5e-4, 5e-5, 5e-5])[: len(x), : len(x)],
            interval=MOTION_S,
            times_s=TIMES_S,
            thetas=thetas,
            theta_sd=0.035 * thetas,
        )


def world(
    joint: Joint = HINGE, *, contrast: float = 0.8, gains: Array | None = None, arm: bool = False
) -> World:
    panel = _sheet(
        np.array([0, 0, -0.12]), np.array([[0.3, 0, 0], [0, 0, 0.24]]), 40, _texture(40, 1, contrast)
    )
    wall = _sheet(np.array([-0.6, 0.3, -0.6]), np.array([[1.4, 0, 0], [0, 0, 1.2]]), 24, _texture(24, 2, 0.6))
    thetas = SHARES * joint.upper
    gains = np.ones(len(TIMES_S)) if gains is None else gains
    frames = np.stack(
        [
            render(concatenate([wall, panel.transform(joint.motion(theta))]), CAMERA, threads=1).rgb
            for theta in thetas
        ]
    )
    frames = frames * gains[:, None, None, None]
    frames += np.random.default_rng(3).normal(0, 0.004, frames.shape)
    hidden = np.zeros((len(TIMES_S), CAMERA.height, CAMERA.width), bool)
    if arm:
        for index in range(6, len(TIMES_S)):
            hidden[index, 30:60, 20 + 2 * index : 50 + 2 * index] = True
        frames[hidden] = np.random.default_rng(4).uniform(0, 1, (int(hidden.sum()), 3))
    demo = MotionInput(
        video=Video(frames_srgb=np.clip(frames * 255, 0, 255).astype(np.uint8), times_s=TIMES_S, fps=10.0),
        camera=CAMERA,
        log=None,  # type: ignore[arg-type]
        robot=None,  # type: ignore[arg-type]
        scene=concatenate([wall, panel]),
        labels=np.repeat(np.array([BACKGROUND, MOVING], np.uint8), [len(wall), len(panel)]),
        clock=Clock(offset_s=0.0),
    )
    return World(demo=demo, hidden=hidden, joint=joint, thetas=thetas)
