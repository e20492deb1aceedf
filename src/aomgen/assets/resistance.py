"""What simulation assumes about an object beyond shape and mass: joint resistance and contact friction."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.joint import JointType
from aomgen.core.transforms import apply

# Standard gravity as MuJoCo's default has it, [m/s^2].
GRAVITY: Final = 9.81
# Keeps light doors stable in the solver, [kg m^2] or [kg].
ARMATURE: Final = 0.005
# Sliding [1], torsional and rolling [m] coefficients of the colliders: plastic on rubber pads.
CONTACT_FRICTION: Final = (0.8, 0.01, 0.0005)
# A friction hinge holds a lid wherever it is left: it bears this many times its weight.
HOLDS: Final = 1.3
# MuJoCo's default dry friction creeps by degrees a second under a load; this solver impedance stands still.
HOLDING_SOLIMP: Final = (0.9999, 0.9999, 0.001, 0.5, 2.0)
# A smaller load comes from the rounding of an axis in a file, [N m] or [N].
NO_LOAD: Final = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class JointResistance:
    """Passive resistance of an object's joint in one simulated run.

    Attributes:
        name: Key in the verdict.
        damping: [N m s/rad] or [N s/m].
        frictionloss: Dry friction beyond `holding_friction`, [N m] or [N].
    """

    name: str
    damping: float
    frictionloss: float


# The first is nominal: its run gives an episode's states, and its values are written into the USD.
RESISTANCES: Final[dict[JointType, tuple[JointResistance, ...]]] = {
    "revolute": (
        JointResistance(name="nominal", damping=0.3, frictionloss=0.15),
        JointResistance(name="light", damping=0.05, frictionloss=0.02),
        JointResistance(name="heavy", damping=1.2, frictionloss=0.8),
    ),
    "prismatic": (
        JointResistance(name="nominal", damping=4.0, frictionloss=2.0),
        JointResistance(name="light", damping=1.0, frictionloss=0.3),
        JointResistance(name="heavy", damping=16.0, frictionloss=8.0),
    ),
}


def holding_friction(asset: ArticulatedAsset) -> float:
    """Dry friction that keeps the moving part where it is left, against its weight, [N m] or [N].

    Enough for every value in the joint's range; 0 for upright hinges and level slides. The
    asset stands upright.
    """
    joint, colliders = asset.joint, asset.moving.colliders
    volumes = np.array([box.half_extents.prod() for box in colliders])
    middle = volumes @ np.array([box.T_asset_box[:3, 3] for box in colliders]) / volumes.sum()
    weight = np.array([0.0, 0.0, -GRAVITY * asset.moving.mass])
    if joint.type == "prismatic":
        load = abs(float(weight @ joint.axis))
    else:
        arms = apply(joint.motion(np.linspace(joint.lower, joint.upper, 40)), middle) - joint.origin
        load = float(np.abs(np.cross(arms, weight) @ joint.axis).max())
    return HOLDS * load if load > NO_LOAD else 0.0
