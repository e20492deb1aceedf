"""What verification says: passed with margins, or rejected with a reason."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejection:
    """Why a variation gave no episode; stored and counted, never raised.

    Attributes:
        reason: Short key, for example "unreachable" or "collision".
        detail: One sentence with the value against its limit.
        metrics: The figures behind it, by name with unit.
    """

    reason: str
    detail: str = ""
    metrics: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingOutcome:
    """One simulated run at one damping and friction of the object's joint.

    Attributes:
        name: Of the setting, for example "nominal".
        damping: [N m s/rad] or [N s/m].
        frictionloss: [N m] or [N].
        final_theta: Joint value at the end of the run, [rad] or [m].
        target_share: Final value over the planned final value.
        contact_share: Share of the progress made while a finger pad carried force.
        peak_force_n: Largest sum of normal forces of the fingers on the part, [N].
        peak_reaction_n: Largest horizontal force of the robot on the object, [N].
        tracking_mm: Largest distance between commanded and reached end effector, [mm].
    """

    name: str
    damping: float
    frictionloss: float
    final_theta: float
    target_share: float
    contact_share: float
    peak_force_n: float
    peak_reaction_n: float
    tracking_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A passed verification.

    Attributes:
        target_theta: Planned final joint value, fixed before simulation, [rad] or [m].
        outcomes: One for each setting; all of them passed.
        kinematic: Tier A's figures, by name with unit.
        bolted: The object's base was held by the world; then its reaction is only reported.
    """

    target_theta: float
    outcomes: tuple[SettingOutcome, ...]
    kinematic: Mapping[str, float]
    bolted: bool

    @property
    def margin(self) -> float:
        """Smallest distance of the runs to the pass line of 90 % of the target, as a share."""
        return min(outcome.target_share for outcome in self.outcomes) - 0.9

    def as_json(self) -> dict[str, Any]:
        """Plain values for storage."""
        runs = [
            {name: getattr(outcome, name) for name in SettingOutcome.__dataclass_fields__}
            for outcome in self.outcomes
        ]
        return {
            "passed": True,
            "target_theta": self.target_theta,
            "margin": self.margin,
            "bolted": self.bolted,
            "kinematic": dict(self.kinematic),
            "dynamic": runs,
        }
