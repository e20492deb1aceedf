"""The front of the moving part as a rectangle in space, from where the video shows it after the gripper has moved it.

Doors, lids and drawers have flat fronts. A rectangle behind the grasp is carried along with the end effector, which the
joint log gives in metric units, and has to cover the region of the video to which the part has come. A drawer that was
pulled out shows its sides as well, so its region is what the rectangle sweeps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

from aomgen.core.camera import Camera
from aomgen.core.transforms import apply, invert, matrix_from_rotvec
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.errors import NoMotionError
from aomgen.parts.panel_terms import iou
from aomgen.prompting.video_regions import REMEDY
from aomgen.segmentation.interface import Mask

# Regions are compared in images of this width, [px]: a pixel is some 4 mm at a table's distance.
WIDTH: Final = 320
# Sides of a rectangle, [m]: a handle is narrower, and no single arm opens what is larger.
MIN_SIDE_M, MAX_SIDE_M = 0.03, 1.2
# Handles stand this far off the front: mean and standard deviation, [m].
DEPTH_M, DEPTH_SD_M = 0.03, 0.03
# A gripper approaches a front squarely, and turns in the grasp little, standard deviations, [rad].
YAW_SD, SLIP_SD = 0.15, 0.2
# Loss of agreement for one standard deviation in each of these three.
PRIOR_WEIGHT: Final = 0.005
# Loss of agreement for a grasp that is 1 m beside its rectangle.
OUTSIDE_WEIGHT: Final = 2.0
# Rectangles that are drawn at random first, their largest reach from the grasp [m], and those that are improved.
DRAWS, REACH_M, STARTS = 3000, 0.6, 8
# First steps of the improvement: four sides and depth [m], yaw and slip [rad].
STEPS: Final = (0.08, 0.08, 0.08, 0.08, 0.02, 0.1, 0.1)
# Least overlap of a rectangle and the region; doors and drawers reach 95 %.
MIN_AGREEMENT: Final = 0.6
# A normal that is steeper than this cosine belongs to a lid.
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
        """Position (3,) of the end effector before the motion, [m]."""
        return self.T_world_first[:3, 3]

    def carry(self, slip_rad: float) -> Array:
        """Transform (4, 4) of the part, which turns by an angle about the vertical in the grasp."""
        T_slip = np.eye(4)
        T_slip[:3, :3] = matrix_from_rotvec([0.0, 0.0, slip_rad])
        middle = self.T_world_last[:3, 3]
        T_slip[:3, 3] = middle - T_slip[:3, :3] @ middle
        return T_slip @ self.T_world_last @ invert(self.T_world_first)


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A rectangle before the motion, and how well it explains what the images show.

    Attributes:
        corners_world: (4, 3), [m]: lower left, lower right, upper right, upper left of whoever looks along the approach.
        confidence: 0..1.
    """

    corners_world: Annotated[Array, "4 3"]
    confidence: float

    __post_init__ = freeze_arrays

    @property
    def center(self) -> Vector3:
        """(3,), [m]."""
        return self.corners_world.mean(0)

    @property
    def axes(self) -> Array:
        """Unit vectors (3, 3) in rows: along the lower side, up, and into the object."""
        along, up = (self.corners_world[k] - self.corners_world[0] for k in (1, 3))
        along, up = along / np.linalg.norm(along), up / np.linalg.norm(up)
        return np.stack([along, up, np.cross(up, along)])

    @property
    def front(self) -> Array:
        """Corners (8, 3) of the space in front of the rectangle that a handle may take."""
        return np.concatenate(
            [self.corners_world, self.corners_world - (DEPTH_M + DEPTH_SD_M) * self.axes[2]]
        )


def place_corners(grip: Grip, x: Array) -> Array:
    """Corners (4, 3) of a rectangle, see `Panel`.

    Args:
        x: Distance of left, right, lower and upper side from the contact, and depth of the rectangle behind it, [m];
            its yaw against the approach and the slip of the grasp, [rad] (7,).
    """
    left, right, lower, upper, depth, yaw, _ = x
    normal = matrix_from_rotvec([0.0, 0.0, yaw]) @ grip.T_world_first[:3, 2]
    lies = abs(normal[2]) > LYING
    # The upper side of a lid is the farther one of whoever stands at the robot.
    up = grip.T_world_first[:3, 0] if lies else np.array([0.0, 0.0, 1.0])
    normal = np.array([0.0, 0.0, np.sign(normal[2])]) if lies else normal - (normal @ up) * up
    normal = normal / np.linalg.norm(normal)
    up = up - (up @ normal) * normal
    up = up / np.linalg.norm(up)
    along = np.cross(normal, up)
    middle = grip.contact + depth * normal
    sides = ((-left, -lower), (right, -lower), (right, upper), (-left, upper))
    return np.array([middle + a * along + b * up for a, b in sides])


def fill_hull(points_px: Array, width: int, height: int) -> Mask:
    """Mask (height, width) of the convex hull of pixels (N, 2); empty for less than a triangle."""
    image = Image.new("1", (width, height))
    try:
        outline = points_px[ConvexHull(points_px).vertices]
    except QhullError:
        return np.zeros((height, width), bool)
    ImageDraw.Draw(image).polygon([(float(x), float(y)) for x, y in outline], fill=1)
    return np.asarray(image, bool)


class RegionAgreement:
    """Agreement of rectangles with the region to which the part has come."""

    def __init__(self, region: Mask, hidden: Mask, camera: Camera, grip: Grip) -> None:
        """Reduce the region (H, W) and the pixels that the robot hides (H, W) of the video's camera."""
        self.grip, self._camera = grip, camera.narrow(WIDTH)
        size = self._camera.width, self._camera.height
        self._region, hides = (
            np.asarray(Image.fromarray(mask).resize(size), bool) for mask in (region, hidden)
        )
        self._seen = ~hides

    def measure(self, x: Array, model: Model) -> float:
        """IoU of the drawn rectangle and the region, 0..1; 0 for a rectangle behind the camera."""
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
        """IoU less what is implausible about the rectangle; minus infinity beyond the sides' limits."""
        left, right, lower, upper, depth, yaw, slip = x
        sides = left + right, lower + upper
        if min(sides) < MIN_SIDE_M or max(sides) > MAX_SIDE_M:
            return float("-inf")
        prior = ((depth - DEPTH_M) / DEPTH_SD_M) ** 2 + (yaw / YAW_SD) ** 2 + (slip / SLIP_SD) ** 2
        outside = float(np.maximum(0.0, -x[:4]).sum())
        return self.measure(x, model) - PRIOR_WEIGHT * prior - OUTSIDE_WEIGHT * outside


def fit_region(agreement: RegionAgreement, rng: np.random.Generator) -> tuple[Array, Model]:
    """Find the rectangle (7,), see `place_corners`, that explains the region best, and how it explains it.

    Raises:
        NoMotionError: None explains most of the region.
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
    """Improve the best of some vectors (N, D) by the method of Nelder and Mead; the largest score, and its vector."""
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
