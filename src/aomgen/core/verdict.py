"""Results of a verification: settings, metrics against their limits, and the certificate of an episode."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

# Names of the first and last time and joint value of the grasp in a certificate.
HOLD: Final = ("first_s", "last_s", "first_theta", "last_theta")


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Resistance of the object in one simulated run.

    Attributes:
        name: Name, for example "nominal".
        damping: Damping of the joint, [N m s/rad] or [N s/m].
        frictionloss: Total dry friction of the joint without latch, [N m] or [N].
        moving_mass: Mass of the moving part, [kg].
        grip_friction: Factor on the sliding friction of gripper and moving part.
        latch: Additional dry friction of a latch, [N m] or [N].
        latch_reach: Joint value below which the latch acts, [rad] or [m].
    """

    name: str
    damping: float
    frictionloss: float
    moving_mass: float
    grip_friction: float = 1.0
    latch: float = 0.0
    latch_reach: float = 0.0

    def friction_at(self, theta: float) -> float:
        """Compute the dry friction of the joint, including the latch, at a joint value, [N m] or [N]."""
        return self.frictionloss + self.latch * (theta < self.latch_reach)


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A metric and its limit.

    Attributes:
        reason: Reason of the rejection if the check fails, for example "contact".
        figure: Name of the metric with its unit, for example "contact_share".
        value, limit: Values in the metric's unit.
        least: The limit is the smallest accepted value; otherwise it is the largest.
    """

    reason: str
    figure: str
    value: float
    limit: float
    least: bool = False

    @property
    def passed(self) -> bool:
        """True if the value is within the limit; False for NaN."""
        return self.margin >= 0

    @property
    def margin(self) -> float:
        """Distance of the value to the limit, negative beyond it."""
        return self.value - self.limit if self.least else self.limit - self.value


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingOutcome:
    """Outcome of one simulated run that passed.

    Attributes:
        setting: Setting of the run.
        final_theta: Joint value at the end of the run, [rad] or [m].
        peak_force_n: Largest sum of normal forces of the pads on the handle, [N].
        peak_reaction_n: Largest horizontal force of the robot on the object, [N].
        hold_s: First and last time at which the pads exerted force on the handle, [s].
        hold_thetas: Joint values at these times, [rad] or [m].
        checks: Metrics that have a limit.
    """

    setting: Setting
    final_theta: float
    peak_force_n: float
    peak_reaction_n: float
    hold_s: tuple[float, float]
    hold_thetas: tuple[float, float]
    checks: tuple[Check, ...]

    @property
    def figures(self) -> dict[str, float]:
        """All metrics, by name with unit."""
        forces = {"peak_force_n": self.peak_force_n, "peak_reaction_n": self.peak_reaction_n}
        return {check.figure: check.value for check in self.checks} | forces


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A passed verification.

    Attributes:
        start_theta, target_theta: Planned first and final joint value, which are fixed before simulation, [rad] or [m].
        outcomes: Outcome for each setting; the nominal setting is last.
        kinematic: Metrics of tier A (the kinematic checks) and their limits.
        bolted: The object's base was fixed to the world; the reaction force is then reported without a limit.
        seed, index: Seed and index of the variation, from which the settings were sampled.
        versions: Versions of the software that computed it, by name.
        digests: SHA-256 of its inputs, by name.
    """

    start_theta: float
    target_theta: float
    outcomes: tuple[SettingOutcome, ...]
    kinematic: tuple[Check, ...]
    bolted: bool
    seed: int
    index: int
    versions: Mapping[str, str] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Always True; the counterpart of `Rejection.passed`."""
        return True

    @property
    def margin(self) -> float:
        """Smallest margin of the joint's travel over all runs, as a share of the planned travel."""
        return self.margins["target_share"]

    @property
    def margins(self) -> dict[str, float]:
        """Smallest margin of each simulated metric over all settings, in the metric's unit."""
        margins: dict[str, float] = {}
        for check in (check for outcome in self.outcomes for check in outcome.checks):
            margins[check.figure] = min(check.margin, margins.get(check.figure, check.margin))
        return margins

    def as_json(self) -> dict[str, Any]:
        """Return the certificate as JSON values, which depend only on the inputs."""
        limits = {check.figure: check.limit for check in self.outcomes[0].checks}
        return {
            "passed": self.passed,
            "start_theta": self.start_theta,
            "target_theta": self.target_theta,
            "margin": self.margin,
            "bolted": self.bolted,
            "kinematic": {
                check.figure: {"value": check.value, "limit": check.limit, "margin": check.margin}
                for check in self.kinematic
            },
            "limits": limits,
            "margins": self.margins,
            "dynamic": [
                {
                    **asdict(outcome.setting),
                    **outcome.figures,
                    "final_theta": outcome.final_theta,
                    "hold": dict(zip(HOLD, (*outcome.hold_s, *outcome.hold_thetas), strict=True)),
                }
                for outcome in self.outcomes
            ],
            "seed": self.seed,
            "index": self.index,
            "versions": dict(self.versions),
            "digests": dict(self.digests),
        }
