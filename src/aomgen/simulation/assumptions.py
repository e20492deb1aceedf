"""What verification assumed, in plain values, so that another simulator can repeat it."""

from typing import Any, Final

from aomgen.assets.resistance import (
    ARMATURE,
    CONTACT_FRICTION,
    HOLDING_SOLIMP,
    RESISTANCES,
    holding_friction,
)
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.values import Array
from aomgen.simulation.replay import CONTROL_HZ, SETTLE_S

CONTROL: Final = (
    "from frame t on the position command moves straight from action[t-1] to action[t], reached at t+1, with "
    "velocity feed-forward; the arm is gravity compensated; before frame 0 it stands at state[0]"
)


def assumptions(asset: ArticulatedAsset, joint_zeros_rad: Array, *, bolted: bool) -> dict[str, Any]:
    """Content of `simulation` in `episode.json`; SI units.

    Args:
        asset: As it was simulated, after scaling.
        joint_zeros_rad: All joints of the episode minus what the real arm reads there (J,).
        bolted: Its base was held by the world.
    """
    holding = holding_friction(asset)
    return {
        "control": CONTROL,
        "control_hz_at_least": CONTROL_HZ,
        "settle_s": SETTLE_S,
        "joint_zeros_rad": joint_zeros_rad.tolist(),
        "bolted": bolted,
        "masses_kg": {"static": asset.static.mass, "moving": asset.moving.mass},
        "contact_friction": list(CONTACT_FRICTION),
        "joint_armature": ARMATURE,
        "joint_holding_friction": holding,
        "joint_solimp_friction": list(HOLDING_SOLIMP) if holding else None,
        "settings": [
            {
                "name": resistance.name,
                "joint_damping": resistance.damping,
                "joint_frictionloss": resistance.frictionloss + holding,
            }
            for resistance in RESISTANCES[asset.joint.type]
        ],
    }
