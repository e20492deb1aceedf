"""Values from a fitted asset to a verified episode."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.demonstration import SceneTrajectory, Trajectory
from aomgen.core.episode import ContactLog
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.core.verdict import Verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejection:
    """Reason why a variation gave no episode; rejections are returned, stored and counted, never raised.

    Attributes:
        reason: Short key, for example "unreachable" or "collision".
        detail: One sentence with the value and its limit.
        metrics: The metrics on which the rejection is based, by name with unit.
        excess: Amount by which the value exceeds its limit, relative to the limit; None if there is no limit.
        bodies: Names of the two bodies that overlap; empty for other reasons.
        worst: The sample of the motion that violates the limit most, as a trajectory of length 1; None if it is unknown.
            It is not stored.
    """

    reason: str
    detail: str = ""
    metrics: Mapping[str, float] = field(default_factory=dict)
    excess: float | None = None
    bodies: tuple[str, ...] = ()
    worst: Trajectory | None = field(default=None, compare=False)

    @property
    def passed(self) -> bool:
        """Always False; the counterpart of `Verdict.passed`."""
        return False


def measure_excess(value: float, limit: float) -> float | None:
    """Compute the amount by which a value exceeds its limit, relative to the limit; None for a limit of 0.

    Example:
        >>> measure_excess(3.0, 1.0)
        2.0
    """
    return abs(value - limit) / abs(limit) if limit else None


Adaptation = Literal["object", "trajectory"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedAsset:
    """An asset at the pose of the recorded object, with the planned motion of its moving part.

    Attributes:
        asset: The asset after scaling and mirroring, asset frame.
        T_world_asset: Pose (4, 4) at the recorded object's location.
        contact_asset: Grasp point at joint value 0 (3,), asset frame, [m].
        shares: Times relative to the duration of the part's motion (K,), 0..1.
        thetas: Joint value at each of these times (K,), [rad] or [m]: increasing from 0 for opening, or decreasing to 0 for
            closing.
        scale: Scale factor that was applied to the asset.
        mirrored: The asset was mirrored so that its hinge is on the recorded side.
        mode: "object" (scaled to the recorded motion) or "trajectory" (original size).
        residual_mm: RMS distance between the recorded and the new path of the grasp point, [mm].
    """

    asset: ArticulatedAsset
    T_world_asset: Matrix4
    contact_asset: Vector3
    shares: Annotated[Array, "K"]
    thetas: Annotated[Array, "K"]
    scale: float
    mirrored: bool
    mode: Adaptation
    residual_mm: float

    __post_init__ = freeze_arrays

    @property
    def middle_asset(self) -> Array:
        """Center of the footprint (3,), asset frame, [m], about which objects are rotated."""
        low, high = self.asset.static.bounds
        return np.append((low[:2] + high[:2]) / 2, 0.0)

    @property
    def start_theta(self) -> float:
        """Planned first joint value, [rad] or [m]."""
        return float(self.thetas[0])

    @property
    def target_theta(self) -> float:
        """Planned final joint value, [rad] or [m]."""
        return float(self.thetas[-1])

    @property
    def travel(self) -> float:
        """Planned change of the joint value, positive for opening, [rad] or [m]."""
        return self.target_theta - self.start_theta

    def backwards(self) -> "FittedAsset":
        """Reverse the motion in time."""
        return replace(self, shares=1 - self.shares[::-1], thetas=self.thetas[::-1])

    def theta_at(self, shares: ArrayLike) -> Array:
        """Interpolate joint values at relative times (N,) of the motion; they are constant outside of 0..1."""
        return np.interp(np.asarray(shares, np.float64), self.shares, self.thetas)


@dataclass(frozen=True, slots=True, kw_only=True)
class LightChange:
    """Difference between an episode's light and the recorded light.

    Attributes:
        turn: Rotation of the light about the vertical, [rad].
        intensity: Factor on the linear radiance.
        temperature_k: Color temperature, [K], to which recorded light of 6500 K changes.
    """

    turn: float = 0.0
    intensity: float = 1.0
    temperature_k: float = 6500.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MaterialChange:
    """Difference between a new object's colors and its textures: rotation of the hue, [rad], and two factors."""

    hue: float = 0.0
    saturation: float = 1.0
    brightness: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class OrbitChange:
    """Motion of a camera about a point: rotations about the vertical and upward, [rad], and a factor on the distance."""

    turn: float = 0.0
    tilt: float = 0.0
    distance: float = 1.0


# Meaning of x and y of a variation: "world" and "object" are shifts along the axes of these frames, "polygon" is the position
# in the world frame.
VariationFrame = Literal["world", "object", "polygon"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Variation:
    """One sample of the object's pose and of all other differences between an episode and the recording.

    Attributes:
        seed, index: Seed of the sequence, and index of the sample in it.
        x, y: Shift of the object, or position of the center of its footprint, see `frame`, [m].
        yaw: Rotation about the vertical axis through the center of the object's footprint, [rad].
        frame: Meaning of x and y, see `VariationFrame`.
        scale: Factor on the size of the fitted asset.
        speed: Factor on the speed of the demonstrated motion.
        start_offset: Offset of the arm joints at the start (J,), [rad] or [m]; empty for no offset.
        light, material: Changes of the appearance.
        orbits: Motion of each moved camera.
        push_m: Largest displacement of the end effector from its planned path during the approach, [m].

    Example:
        >>> ag.Variation(seed=0, index=0, x=0.1, y=0.0, yaw=0.5).scale
        1.0
    """

    seed: int
    index: int
    x: float
    y: float
    yaw: float
    frame: VariationFrame = "world"
    scale: float = 1.0
    speed: float = 1.0
    start_offset: tuple[float, ...] = ()
    light: LightChange = LightChange()
    material: MaterialChange = MaterialChange()
    orbits: tuple[OrbitChange, ...] = ()
    push_m: float = 0.0

    def place_at(self, fitted: FittedAsset) -> Array:
        """Compute the pose T_world_object (4, 4) of the asset in this variation."""
        T = fitted.T_world_asset
        pivot = apply(T, fitted.middle_asset)
        shift = np.array([self.x, self.y, 0.0])
        if self.frame == "object":
            shift = T[:3, :3] @ shift
        elif self.frame == "polygon":
            shift[:2] -= pivot[:2]
        R = matrix_from_rotvec(np.array([0.0, 0.0, self.yaw]))
        return transform(R, pivot - R @ pivot + shift) @ T


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodePlan(SceneTrajectory):
    """A commanded trajectory that passed the kinematic checks, with the object's planned joint values.

    Attributes:
        variation: Variation of the object and the scene.
        fitted: Object and its planned motion.
        fps: Samples per second.
        phases: Index into `core.episode.PHASES` (T,).
        Ts_world_ee: Commanded end-effector poses (T, 4, 4).
        grasp: Description of the chosen grasp.
        metrics: Metrics of tier A (the kinematic checks), by name with unit.
    """

    variation: Variation
    fitted: FittedAsset
    fps: float
    phases: Annotated[NDArray[np.int64], "T"]
    Ts_world_ee: Annotated[Array, "T 4 4"]
    grasp: str
    metrics: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class VerifiedEpisode:
    """A plan and its simulated execution with the nominal setting, at the samples of the plan.

    Attributes:
        plan: The plan, which holds the commands (actions).
        reached: Simulated states of robot and object.
        contacts: Finger contacts on the object.
        verdict: Results of the verification with all settings.
    """

    plan: Annotated[EpisodePlan, "T"]
    reached: Annotated[Trajectory, "T"]
    contacts: ContactLog
    verdict: Verdict

    __post_init__ = freeze_arrays
