"""How the joints of a hand follow its drivers: couplings in closed form, loops by letting them settle."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from aomgen.core.values import Array
from aomgen.errors import MalformedFileError
from aomgen.robots.arm_chain import ArmChain

# Rows of the table from open to closed; between them positions are linear to far below a millimetre.
STEPS = 33
# Time in which the held joints come to rest, [s]; loops that stay open after it are refused.
SETTLE_S = 0.3
# A loop whose ends stay farther apart than this at the end is not closed, [m].
OPEN_LOOP_M = 0.002
REMEDY = "give each finger joint's value as robot.hand.open and robot.hand.closed in capture.toml"


def has_loops(model: mujoco.MjModel) -> bool:
    """Whether bodies are joined beyond the tree."""
    return bool(np.isin(model.eq_type, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)).any())


def couplings(model: mujoco.MjModel) -> dict[str, tuple[str, Array]]:
    """For each joint that follows another one: that one, and the polynomial's coefficients (5,).

    The name is empty for a joint that is held still.
    """
    result = {}
    for equality in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        source = int(model.eq_obj2id[equality])
        name = model.joint(source).name if source >= 0 else ""
        result[model.joint(model.eq_obj1id[equality]).name] = (name, model.eq_data[equality, :5].copy())
    return result


def drivers_of(
    model: mujoco.MjModel, chain: ArmChain, actuated: Sequence[str], given: Sequence[str], path: Path
) -> tuple[str, ...]:
    """The joints of the hand that follow none: those that a gripper value has to be mapped to.

    Args:
        model: With the file's couplings.
        chain: Arm and hand.
        actuated: Joints that the file's actuators drive; in a hand with loops, only they are drivers.
        given: Joints whose open and closed values the capture names; they are the drivers.
        path: For messages.

    Raises:
        MalformedFileError: An unknown joint is given, or the file does not tell how the fingers
            move together.
    """
    unknown = [name for name in given if name not in chain.hand_joints]
    if unknown:
        raise MalformedFileError(
            path,
            f"has no finger joint '{unknown[0]}' (robot.hand names it)",
            f"finger joints: {', '.join(chain.hand_joints) or 'none'}",
        )
    followed = couplings(model)
    if given:
        return tuple(given)
    free = [name for name in chain.hand_joints if name not in followed]
    if has_loops(model):
        free = [name for name in free if name in _sources(actuated, followed)]
        if not free:
            raise MalformedFileError(
                path, "closes loops in the hand, but no actuator tells what drives them", REMEDY
            )
    if len(free) > 2 or (len(free) > 1 and has_loops(model)):
        raise MalformedFileError(
            path, f"does not tell how the finger joints {', '.join(free)} move together", REMEDY
        )
    return tuple(free)


def _sources(names: Sequence[str], followed: Mapping[str, tuple[str, Array]]) -> set[str]:
    result = set()
    for name in names:
        for _ in followed:
            name = followed.get(name, (name,))[0]
        result.add(name)
    return result


def finger_positions(
    spec: mujoco.MjSpec, model: mujoco.MjModel, chain: ArmChain, driven: Mapping[str, Array], path: Path
) -> Array:
    """Values (K, F) of all hand joints while the drivers take the values (K,), [rad] or [m].

    Raises:
        MalformedFileError: A joint follows nothing, or a loop cannot be closed.
    """
    if has_loops(model):
        return _settled(spec, chain, driven, path)
    followed = couplings(model)
    found: dict[str, Array] = dict(driven)
    for _ in chain.hand_joints:
        for name, (source, polynomial) in followed.items():
            if name in found or (source and source not in found):
                continue
            way = found[source] - _zero(model, source) if source else np.zeros(_count(driven))
            value = _zero(model, name) + np.polynomial.polynomial.polyval(way, polynomial)
            found[name] = np.asarray(value, np.float64)
    missing = [name for name in chain.hand_joints if name not in found]
    if missing:
        raise MalformedFileError(path, f"does not tell what finger joint '{missing[0]}' follows", REMEDY)
    return np.stack([found[name] for name in chain.hand_joints], 1)


def _count(driven: Mapping[str, Array]) -> int:
    return len(next(iter(driven.values())))


def _zero(model: mujoco.MjModel, joint: str) -> float:
    return float(model.qpos0[model.joint(joint).qposadr[0]])


def _settled(spec: mujoco.MjSpec, chain: ArmChain, driven: Mapping[str, Array], path: Path) -> Array:
    """Hold the drivers at each value and let the rest come to rest, without gravity and contacts."""
    spec = spec.copy()
    spec.option.gravity = np.zeros(3)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for number, name in enumerate([*driven, *chain.joints]):
        hold = spec.add_equality(name=f"hold_{number}", type=mujoco.mjtEq.mjEQ_JOINT, name1=name)
        hold.solref, hold.objtype = [0.004, 1.0], mujoco.mjtObj.mjOBJ_JOINT
    model = spec.compile()
    data = mujoco.MjData(model)
    holds = [model.equality(f"hold_{number}").id for number in range(len(driven))]
    fingers = [model.joint(name).qposadr[0] for name in chain.hand_joints]
    rows = []
    for step in range(_count(driven)):
        for hold, (name, values) in zip(holds, driven.items(), strict=True):
            model.eq_data[hold, 0] = values[step] - _zero(model, name)
        mujoco.mj_step(model, data, round(SETTLE_S / model.opt.timestep))
        rows.append(data.qpos[fingers].copy())
        loops = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        apart = float(np.abs(data.efc_pos[: data.nefc][loops]).max(initial=0.0))
        if not apart <= OPEN_LOOP_M:
            raise MalformedFileError(
                path,
                f"closes loops in the hand that stay {1000 * apart:.1f} mm open, limit {1000 * OPEN_LOOP_M:.0f} mm",
                REMEDY,
            )
    return np.array(rows)
