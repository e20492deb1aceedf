"""Settings of a simulated run: variations of the object's resistance, drawn from an episode's seed and index.

Four properties have two levels each, which makes sixteen corners. An episode is tried in two opposite ones, so that
it meets both levels of every property, and in the nominal setting; eight episodes in a row meet all sixteen.
"""

from dataclasses import replace
from itertools import product

import mujoco
import numpy as np

from aomgen.assets.mjcf import HOLDING_SOLIMP, RESISTANCES, holding_friction
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.verdict import Setting
from aomgen.simulation.scene import Scene

# Factors on the moving part's mass: an empty drawer or thin door, and shelves full of jars.
LIGHT, HEAVY = 0.5, 2.0
# Factors on the friction of gripper and part, 0.6 to 0.8: clean rubber on paint, and greasy metal.
ROUGH, SLIPPERY = 1.25, 0.6
# Magnet and roller catches let go at 5 to 15 N at the handle, [N], within a few millimetres of its way, [m].
LATCH_N, LATCH_WAY_M = 15.0, 0.004


def draw_settings(asset: ArticulatedAsset, seed: int, index: int) -> tuple[Setting, ...]:
    """The settings of an episode, the hardest first and the nominal one last.

    A block of eight indices meets all pairs in a random order: with a fixed one, places of the object, which come
    from a sequence with periods of their own, would always meet the same corners.
    """
    pairs = list(product((False, True), repeat=3))
    order = np.random.default_rng([seed, index // len(pairs)]).permutation(len(pairs))
    bits = pairs[order[index % len(pairs)]]
    stiff = corner_setting(asset, True, *bits)
    easy = corner_setting(asset, False, *(not bit for bit in bits))
    nominal = _setting("nominal", asset, RESISTANCES[asset.joint.type][0])
    return stiff, easy, nominal


def corner_setting(
    asset: ArticulatedAsset, stiff: bool, heavy: bool, slippery: bool, latched: bool
) -> Setting:
    """One corner. A part that its hinge's friction holds, as a laptop's lid, has no latch."""
    _, easy, hard = RESISTANCES[asset.joint.type]
    latched = latched and not holding_friction(asset)
    words = ["stiff" if stiff else "easy", "heavy" if heavy else "light", "slippery" if slippery else "rough"]
    name = " ".join([*words, "latched"] if latched else words)
    setting = _setting(name, asset, hard if stiff else easy, HEAVY if heavy else LIGHT)
    joint, lever = asset.joint, 1.0
    if joint.type == "revolute":
        lever = float(np.linalg.norm(np.cross(joint.axis, asset.handle_point - joint.origin)))
    return replace(
        setting,
        grip_friction=SLIPPERY if slippery else ROUGH,
        latch=LATCH_N * lever * latched,
        latch_reach=LATCH_WAY_M / lever * latched,
    )


def apply_setting(scene: Scene, model: mujoco.MjModel, setting: Setting, theta: float) -> None:
    """Apply a setting to a model, a copy of the scene's, whose object joint has the value `theta`."""
    model.dof_damping[scene.object_dof] = setting.damping
    model.dof_frictionloss[scene.object_dof] = setting.friction_at(theta)
    if setting.latch:
        model.dof_solimp[scene.object_dof] = HOLDING_SOLIMP
    model.geom_friction[scene.roles.gripper | scene.roles.moving, 0] *= setting.grip_friction
    body, factor = model.body(scene.names.moving_body).id, setting.moving_mass / scene.asset.moving.mass
    if factor != 1.0:
        model.body_mass[body] *= factor
        model.body_inertia[body] *= factor
        # Inverse weights, which contacts are scaled by, follow from the masses.
        mujoco.mj_setConst(model, mujoco.MjData(model))


def _setting(
    name: str, asset: ArticulatedAsset, resistance: tuple[float, float], mass_factor: float = 1.0
) -> Setting:
    """A setting without a latch, of damping and dry friction; the holding friction of a lid grows with its weight."""
    damping, friction = resistance
    return Setting(
        name=name,
        damping=damping,
        frictionloss=friction + mass_factor * holding_friction(asset),
        moving_mass=mass_factor * asset.moving.mass,
    )
