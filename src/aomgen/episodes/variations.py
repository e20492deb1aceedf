"""Variations of the episodes: pure functions of a seed and an index, spread evenly over the requested ranges.

Source: AOMGen, sec. 5.2 (ranges of x, y and yaw); Halton's sequence, scrambled (Owen, 2017).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Final, Literal

import numpy as np
from scipy.stats import qmc

from aomgen.core.joint import LIMIT_SHARE
from aomgen.core.plan import (
    FittedAsset,
    LightChange,
    MaterialChange,
    OrbitChange,
    Variation,
    VariationFrame,
)
from aomgen.core.transforms import similarity, transform
from aomgen.core.values import Array
from aomgen.errors import ConfigError
from aomgen.simulation.judge import PassRule

Range = tuple[float, float]
# An area has at least three corners.
CORNERS: Final = 3
# With a larger deviation from its plan the arm would meet obstacles that planning has avoided, [m].
MAX_PUSH_M: Final = 0.02
# Range of black-body temperatures with a known color, [K].
COLDEST_K, HOTTEST_K = 1667, 25_000


@dataclass(frozen=True, slots=True, kw_only=True)
class OrbitRanges:
    """Ranges of a camera's motion about its target.

    Attributes:
        turn_deg: Rotation about the vertical, [deg].
        tilt_deg: Rotation upwards, [deg].
        distance: Factor on the distance.
    """

    turn_deg: Range = (0.0, 0.0)
    tilt_deg: Range = (0.0, 0.0)
    distance: Range = (1.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranges:
    """Ranges of every draw, uniform between low and high; pose and size are relative to the fitted asset.

    Attributes:
        x_m, y_m: Shift, [m].
        yaw_deg: Rotation about the vertical, [deg].
        axes: Frame of x and y: the robot's base ("world"), or the object's, y pointing into its front.
        polygon: Corners of an area of the table, world frame, [m]: the center of the object's footprint is
            spread over it, and x_m and y_m are ignored; empty for none.
        scale: Factor on the asset's size.
        speed: Factor on the demonstrated speed.
        start_deg: Offset of every revolute arm joint at the start, [deg]; prismatic joints have none.
        light_turn_deg, light_intensity, light_temperature_k: See `LightChange`.
        hue_deg, saturation, brightness: See `MaterialChange`.
        push_m: Largest displacement of the simulated end effector from its planned path before the grasp, [m];
            the recorded actions are still the planned targets.
        around: Motion of every camera of the scene.
        free: Motion of the added cameras, about the object at its pose.

    Example:
        >>> ag.Ranges(x_m=(0.0, 0.2), scale=(0.8, 1.0)).y_m
        (-0.05, 0.05)
    """

    x_m: Range = (-0.05, 0.30)
    y_m: Range = (-0.05, 0.05)
    yaw_deg: Range = (-45.0, 45.0)
    axes: Literal["world", "object"] = "world"
    polygon: tuple[tuple[float, float], ...] = ()
    scale: Range = (1.0, 1.0)
    speed: Range = (1.0, 1.0)
    start_deg: Range = (0.0, 0.0)
    light_turn_deg: Range = (0.0, 0.0)
    light_intensity: Range = (1.0, 1.0)
    light_temperature_k: Range = (6500.0, 6500.0)
    hue_deg: Range = (0.0, 0.0)
    saturation: Range = (1.0, 1.0)
    brightness: Range = (1.0, 1.0)
    push_m: Range = (0.0, 0.0)
    around: OrbitRanges = field(default_factory=OrbitRanges)
    free: OrbitRanges = field(
        default_factory=lambda: OrbitRanges(
            turn_deg=(-60.0, 60.0), tilt_deg=(-10.0, 25.0), distance=(0.8, 1.4)
        )
    )

    def __post_init__(self) -> None:
        """Refuse empty or inconsistent ranges.

        Raises:
            ConfigError: A range is no pair or ends before it begins, an area has too few corners or is empty.
        """
        for ranges, prefix in ((self, ""), (self.around, "around."), (self.free, "free.")):
            for item in fields(ranges):
                value, place = getattr(ranges, item.name), f"episodes.ranges.{prefix}{item.name}"
                if isinstance(value, tuple) and item.name != "polygon":
                    _require_range(value, place)
        if not 0 <= self.push_m[0] <= self.push_m[1] <= MAX_PUSH_M:
            raise ConfigError(
                "episodes.ranges.push_m",
                f"is {self.push_m}",
                f"expected 0 to {MAX_PUSH_M:g}, the lower one first",
            )
        for name in ("scale", "speed", "light_intensity", "light_temperature_k"):
            if not getattr(self, name)[0] > 0:
                raise ConfigError(
                    f"episodes.ranges.{name}", f"is {getattr(self, name)}", "expected more than 0"
                )
        low, high = self.light_temperature_k
        if not (low >= COLDEST_K and high <= HOTTEST_K):
            raise ConfigError(
                "episodes.ranges.light_temperature_k",
                f"is {low:g} to {high:g}",
                f"expected {COLDEST_K} to {HOTTEST_K}",
            )
        if self.axes not in ("world", "object"):
            raise ConfigError("episodes.ranges.axes", f"is '{self.axes}'", 'use "world" or "object"')
        if not all(isinstance(corner, tuple) and len(corner) == 2 for corner in self.polygon):
            raise ConfigError(
                "episodes.ranges.polygon", f"is {self.polygon}", "give its corners, [[x, y], ...] in meters"
            )
        if self.polygon and not (len(self.polygon) >= CORNERS and 0 < area(self.polygon) < np.inf):
            raise ConfigError(
                "episodes.ranges.polygon",
                f"has {len(self.polygon)} corners and an area of 0",
                "give three or more corners of the area in which objects may be placed",
            )

    @property
    def frame(self) -> VariationFrame:
        """Frame of x and y of draws."""
        return "polygon" if self.polygon else self.axes

    @property
    def place_bounds(self) -> tuple[Range, Range]:
        """Lowest and highest x and y of draws, [m]."""
        if not self.polygon:
            return self.x_m, self.y_m
        (low_x, low_y), (high_x, high_y) = np.min(self.polygon, 0), np.max(self.polygon, 0)
        return (low_x, high_x), (low_y, high_y)


def draw(
    seed: int,
    asset: int,
    index: int,
    ranges: Ranges,
    *,
    slides: Sequence[bool] = (),
    cameras: int = 0,
    free: int = 0,
) -> Variation:
    """Draw sample `index` of the sequence of an asset.

    Adding joints or cameras changes no other value.

    Args:
        seed: Seed of the generation.
        asset: Number of the asset; each has a separate sequence.
        index: Index in the sequence, from 0.
        slides: Whether each arm joint (J,) is prismatic; the others have an offset at the start.
        cameras: Number of cameras moved by `ranges.around`.
        free: Number of cameras moved by `ranges.free`.
    """
    orbits = [ranges.around] * cameras + [ranges.free] * free
    bounds = _bounds(ranges, slides, orbits)
    sequence = qmc.Halton(len(bounds), scramble=True, rng=np.random.default_rng([seed, asset]))
    return _variation(sequence.fast_forward(index).random(1)[0], bounds, ranges, seed, index, len(slides))


def draw_independently(rng: np.random.Generator, seed: int, index: int, ranges: Ranges) -> Variation:
    """Draw a variation with uniform values, independent of all others; arm and cameras begin as recorded."""
    bounds = _bounds(ranges, (), [])
    return _variation(rng.random(len(bounds)), bounds, ranges, seed, index, 0)


def _bounds(ranges: Ranges, slides: Sequence[bool], orbits: Sequence[OrbitRanges]) -> Array:
    """Return the lowest and highest values (D, 2) of a draw."""
    return np.array([
        *ranges.place_bounds, ranges.yaw_deg, ranges.scale, ranges.speed,
        ranges.light_turn_deg, ranges.light_intensity, ranges.light_temperature_k,
        ranges.hue_deg, ranges.saturation, ranges.brightness, ranges.push_m,
        *[(0.0, 0.0) if slide else ranges.start_deg for slide in slides],
        *[bound for orbit in orbits for bound in (orbit.turn_deg, orbit.tilt_deg, orbit.distance)],
    ])  # fmt: skip


def _variation(
    shares: Array, bounds: Array, ranges: Ranges, seed: int, index: int, arm_joints: int
) -> Variation:
    """Make the variation at shares (D,) of the bounds (D, 2)."""
    lows, highs = bounds.T
    values = (lows + shares * (highs - lows)).tolist()
    x, y, yaw, scale, speed, turn, intensity, temperature_k, hue, saturation, brightness, push = values[:12]
    starts, views = values[12 : 12 + arm_joints], values[12 + arm_joints :]
    return Variation(
        seed=seed,
        index=index,
        x=x,
        y=y,
        yaw=float(np.deg2rad(yaw)),
        frame=ranges.frame,
        scale=scale,
        speed=speed,
        start_offset=tuple(np.deg2rad(starts).tolist()) if any(ranges.start_deg) else (),
        light=LightChange(turn=float(np.deg2rad(turn)), intensity=intensity, temperature_k=temperature_k),
        material=MaterialChange(hue=float(np.deg2rad(hue)), saturation=saturation, brightness=brightness),
        orbits=tuple(
            OrbitChange(
                turn=float(np.deg2rad(views[k])), tilt=float(np.deg2rad(views[k + 1])), distance=views[k + 2]
            )
            for k in range(0, len(views), 3)
        ),
        push_m=push,
    )


def scale_fit(fitted: FittedAsset, scale: float) -> FittedAsset:
    """Scale a fitted asset, keeping the position of its held point as seen from above, and its opening.

    A slide's travel scales with its object, but a small one is opened at least as far as success requires,
    where its range allows; a hinge turns by the same angle.
    """
    if scale == 1.0:
        return fitted
    held = fitted.contact_asset
    R, t = fitted.T_world_asset[:3, :3], fitted.T_world_asset[:3, 3]
    shift = R @ np.append((1 - scale) * held[:2], 0.0)
    thetas = fitted.thetas
    if fitted.asset.joint.type == "prismatic":
        least, most = PassRule().least_travel("prismatic"), LIMIT_SHARE * scale * fitted.asset.joint.upper
        travel = scale * abs(fitted.travel)
        thetas = scale * thetas * max(1.0, min(least * (1 + 1e-6), most) / travel)
    return replace(
        fitted,
        asset=fitted.asset.transform(similarity(scale, np.eye(3), np.zeros(3))),
        T_world_asset=transform(R, t + shift),
        contact_asset=scale * held,
        thetas=thetas,
        scale=fitted.scale * scale,
    )


def area(corners: tuple[tuple[float, float], ...]) -> float:
    """Compute the area of a polygon that does not cross itself, [m^2]."""
    x, y = np.asarray(corners, np.float64).T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def inside(corners: tuple[tuple[float, float], ...], point: Array) -> bool:
    """Return whether a point (2,) is in a polygon: a ray from it crosses the outline an odd number of times."""
    a = np.asarray(corners, np.float64)
    b = np.roll(a, -1, 0)
    crosses = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    rise = np.where(crosses, b[:, 1] - a[:, 1], 1.0)
    at = a[:, 0] + (point[1] - a[:, 1]) / rise * (b[:, 0] - a[:, 0])
    return bool(np.count_nonzero(crosses & (point[0] < at)) % 2)


def _require_range(value: tuple[float, ...], place: str) -> None:
    if not (len(value) == 2 and np.isfinite(value).all() and value[0] <= value[1]):
        raise ConfigError(place, f"is {value}", "give two numbers, the lower one first")
