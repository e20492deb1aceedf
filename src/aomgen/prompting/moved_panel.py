"""Estimate the front of the moving part as a 3D rectangle, from the video region that it covers after its motion.

Doors, lids and drawers have flat fronts. A rectangle behind the grasp moves with the end effector, whose metric path is
known from the joint log, and has to cover the video region that the part covers after its motion. A drawer that was
pulled out also shows its sides, so its region is the one that the rectangle sweeps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import minimize

from aomgen.core.camera import Camera
from aomgen.core.transforms import apply, invert, matrix_from_rotvec
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.errors import NoMotionError
from aomgen.io.images import fill_hull
from aomgen.parts.panel_terms import iou
from aomgen.prompting.video_regions import REMEDY
from aomgen.segmentation.interface import Mask

# Regions are compared in images of this width, [px]; a pixel is about 4 mm at the distance of a table.
WIDTH: Final = 320
# Limits of the sides of a rectangle, [m]; handles are narrower, and a single arm cannot open larger fronts.
MIN_SIDE_M, MAX_SIDE_M = 0.03, 1.2
# Distance of handles from the front: mean and standard deviation, [m].
DEPTH_M, DEPTH_SD_M = 0.03, 0.03
# Standard deviations of the yaw between approach and front, and of the part's rotation in the grasp, [rad].
YAW_SD, SLIP_SD = 0.15, 0.2
# Loss of agreement for a deviation of one standard deviation in depth, yaw or slip.
PRIOR_WEIGHT: Final = 0.005
# Loss of agreement for a grasp at a distance of 1 m from its rectangle.
OUTSIDE_WEIGHT: Final = 2.0
# Number of initial random rectangles, their largest extent from the grasp [m], and number of those that are refined.
DRAWS, REACH_M, STARTS = 3000, 0.6, 8
# Initial steps of the refinement: four sides and depth [m], yaw and slip [rad].
STEPS: Final = (0.08, 0.08, 0.08, 0.08, 0.02, 0.1, 0.1)
# Smallest accepted overlap of a rectangle and the region; doors and drawers reach 95 %.
MIN_AGREEMENT: Final = 0.6
# A front is a lid if the vertical component of its unit normal is larger than this.
LYING: Final = 0.7

Model = Literal["carried", "swept"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Grip:
    """The end effector before and after the motion, world frame.

    Attributes:
        T_world_first, T_world_last: Poses (4, 4); z is the direction of approach.
    """

    T_world_first: Matrix4
    T_world_last: Matrix4

    __post_init__ = freeze_arrays

    @property
    def contact(self) -> Vector3:
        """Return the position (3,) of the end effector before the motion, [m]."""
        return self.T_world_first[:3, 3]

    def carry(self, slip_rad: float) -> Array:
        """Compute the motion (4, 4) of the part, which also rotates in the grasp by an angle about the vertical."""
        T_slip = np.eye(4)
        T_slip[:3, :3] = matrix_from_rotvec([0.0, 0.0, slip_rad])
        middle = self.T_world_last[:3, 3]
        T_slip[:3, 3] = middle - T_slip[:3, :3] @ middle
        return T_slip @ self.T_world_last @ invert(self.T_world_first)


@dataclass(frozen=True, slots=True, kw_only=True)
class Front:
    """Rectangle before the motion, with its confidence.

    Attributes:
        corners_world: Corners (4, 3), [m]: lower left, lower right, upper right, upper left as seen along the approach.
        confidence: Agreement with the images, 0..1.
    """

    corners_world: Annotated[Array, "4 3"]
    confidence: float

    __post_init__ = freeze_arrays

    @property
    def center(self) -> Vector3:
        """Return the center (3,), [m]."""
        return self.corners_world.mean(0)

    @property
    def axes(self) -> Array:
        """Return unit vectors (3, 3) in rows: along the lower side, upwards, and into the object."""
        along, up = (self.corners_world[k] - self.corners_world[0] for k in (1, 3))
        along, up = along / np.linalg.norm(along), up / np.linalg.norm(up)
        return np.stack([along, up, np.cross(up, along)])

    @property
    def handle_space(self) -> Array:
        """Return the corners (8, 3) of the space in front of the rectangle that may contain a handle."""
        return np.concatenate(
            [self.corners_world, self.corners_world - (DEPTH_M + DEPTH_SD_M) * self.axes[2]]
        )


def place_corners(grip: Grip, x: Array) -> Array:
    """Compute the corners (4, 3) of a rectangle, see `Front`.

    Args:
        x: Distance of left, right, lower and upper side from the contact, and depth of the rectangle behind it, [m];
            its yaw against the approach and the slip of the grasp, [rad] (7,).
    """
    left, right, lower, upper, depth, yaw, _ = x
    normal = matrix_from_rotvec([0.0, 0.0, yaw]) @ grip.T_world_first[:3, 2]
    lies = abs(normal[2]) > LYING
    # The upper side of a lid is the one farther from the robot.
    up = grip.T_world_first[:3, 0] if lies else np.array([0.0, 0.0, 1.0])
    normal = np.array([0.0, 0.0, np.sign(normal[2])]) if lies else normal - (normal @ up) * up
    normal = normal / np.linalg.norm(normal)
    up = up - (up @ normal) * normal
    up = up / np.linalg.norm(up)
    along = np.cross(normal, up)
    middle = grip.contact + depth * normal
    sides = ((-left, -lower), (right, -lower), (right, upper), (-left, upper))
    return np.array([middle + a * along + b * up for a, b in sides])


class RegionAgreement:
    """Agreement of rectangles with the region that the part covers after the motion."""

    def __init__(self, region: Mask, hidden: Mask, camera: Camera, grip: Grip) -> None:
        """Reduce the region (H, W) and the mask of the robot (H, W) in images of the video's camera."""
        self.grip, self._camera = grip, camera.narrow(WIDTH)
        size = self._camera.width, self._camera.height
        self._region, hides = (
            np.asarray(Image.fromarray(mask).resize(size), bool) for mask in (region, hidden)
        )
        self._seen = ~hides

    def measure(self, x: Array, model: Model) -> float:
        """Compute the IoU of the projected rectangle and the region, 0..1; 0 for a rectangle behind the camera."""
        corners = place_corners(self.grip, x)
        placed = apply(self.grip.carry(float(x[6])), corners)
        if model == "swept":
            placed = np.concatenate([placed, corners])
        pixels, depths = self._camera.project(placed)
        if not np.all(depths > 0):
            return 0.0
        drawn = fill_hull(pixels, self._camera.width, self._camera.height)
        return float(iou(drawn & self._seen, self._region & self._seen))

    def score(self, x: Array, model: Model) -> float:
        """Compute the IoU minus penalties for implausible rectangles; minus infinity beyond the side limits."""
        left, right, lower, upper, depth, yaw, slip = x
        sides = left + right, lower + upper
        if min(sides) < MIN_SIDE_M or max(sides) > MAX_SIDE_M:
            return float("-inf")
        prior = ((depth - DEPTH_M) / DEPTH_SD_M) ** 2 + (yaw / YAW_SD) ** 2 + (slip / SLIP_SD) ** 2
        outside = float(np.maximum(0.0, -x[:4]).sum())
        return self.measure(x, model) - PRIOR_WEIGHT * prior - OUTSIDE_WEIGHT * outside


def fit_region(agreement: RegionAgreement, rng: np.random.Generator) -> tuple[Array, Model]:
    """Find the rectangle (7,), see `place_corners`, that explains the region best, and its model of the region.

    Raises:
        NoMotionError: No rectangle explains most of the region.
    """
    models: tuple[Model, ...] = ("carried", "swept")
    draws = np.column_stack([
        rng.uniform(0, REACH_M, (DRAWS, 4)),
        rng.normal(DEPTH_M, DEPTH_SD_M, DRAWS),
        rng.normal(0, YAW_SD, DRAWS),
        rng.normal(0, SLIP_SD, DRAWS),
    ])  # fmt: skip
    found = {
        model: improve(lambda x, model=model: agreement.score(x, model), draws, STEPS) for model in models
    }
    model = max(models, key=lambda name: found[name][0])
    best = found[model][1]
    agreement_share = agreement.measure(best, model)
    if not agreement_share >= MIN_AGREEMENT:
        raise NoMotionError(
            "demonstration video",
            f"no flat front that the gripper carries explains what has moved (overlap {agreement_share:.0%}, at least "
            f"{MIN_AGREEMENT:.0%} is needed)",
            REMEDY,
        )
    return best, model


def improve(
    score: Callable[[Array], float], draws: Array, steps: tuple[float, ...]
) -> tuple[float, NDArray[np.float64]]:
    """Refine the best of some vectors (N, D) by the Nelder-Mead method; return the largest score and its vector."""
    scores = np.array([score(x) for x in draws])
    fits = [
        minimize(
            lambda x: -score(x),
            start,
            method="Nelder-Mead",
            options={"initial_simplex": np.vstack([start, start + np.diag(steps)]), "maxiter": 600},
        )
        for start in draws[np.argsort(-scores)[:STARTS]]
    ]
    best = min(fits, key=lambda fit: fit.fun)
    return -float(best.fun), np.asarray(best.x, np.float64)
