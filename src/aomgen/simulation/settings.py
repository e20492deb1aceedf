"""Sample the settings of simulated runs, which vary the object's resistance, from an episode's seed and index.

Four properties have two levels each, which gives sixteen corner settings. Each episode is simulated in two opposite
corners, so that both levels of every property are covered, and in the nominal setting. The episodes with indices 8 k to
8 k + 7 cover all sixteen corners.
"""

from dataclasses import replace
from itertools import product

import mujoco
import numpy as np

from aomgen.assets.mjcf import HOLDING_SOLIMP, RESISTANCES, holding_friction
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.verdict import Setting
from aomgen.simulation.scene import Scene

# Factors on the moving part's mass, for example for an empty drawer or thin door, and for a loaded drawer or door.
LIGHT, HEAVY = 0.5, 2.0
# Factors on the sliding friction of gripper and part, for clean rubber on paint and for greasy metal.
ROUGH, SLIPPERY = 1.25, 0.6
# Force of a latch at the handle, [N], and path of the handle over which it acts, [m]: magnetic and roller catches release
# at 5 to 15 N within a few millimeters.
LATCH_N, LATCH_WAY_M = 15.0, 0.004


def draw_settings(asset: ArticulatedAsset, seed: int, index: int) -> tuple[Setting, ...]:
    """Sample the settings of an episode: a corner with high joint resistance, the opposite corner, and the nominal setting.

    A block of eight indices covers all pairs of corners in random order. With a fixed order, the corners would correlate
    with the poses of the object, which are sampled from a low-discrepancy sequence.

    Args:
        asset: Simulated object.
        seed, index: Seed and index of the episode's variation.
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
    """Build one corner setting.

    Args:
        asset: Simulated object.
        stiff: High instead of low joint resistance.
        heavy: High instead of low mass of the moving part.
        slippery: Low instead of high friction of gripper and part.
        latched: Add a latch, unless the friction of the joint holds the part, as for a laptop's lid.
    """
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
    """Apply a setting to a model.

    Args:
        scene: Scene of the model.
        model: Copy of the scene's model, changed in place.
        setting: Setting to be applied.
        theta: Current value of the object's joint, [rad] or [m].
    """
    model.dof_damping[scene.object_dof] = setting.damping
    model.dof_frictionloss[scene.object_dof] = setting.friction_at(theta)
    if setting.latch:
        model.dof_solimp[scene.object_dof] = HOLDING_SOLIMP
    model.geom_friction[scene.roles.gripper | scene.roles.moving, 0] *= setting.grip_friction
    body, factor = model.body(scene.names.moving_body).id, setting.moving_mass / scene.asset.moving.mass
    if factor != 1.0:
        model.body_mass[body] *= factor
        model.body_inertia[body] *= factor
        # This updates the inverse weights, which depend on the masses and scale the contacts.
        mujoco.mj_setConst(model, mujoco.MjData(model))


def _setting(
    name: str, asset: ArticulatedAsset, resistance: tuple[float, float], mass_factor: float = 1.0
) -> Setting:
    """Build a setting without a latch from damping and dry friction; the holding friction is scaled with the mass."""
    damping, friction = resistance
    return Setting(
        name=name,
        damping=damping,
        frictionloss=friction + mass_factor * holding_friction(asset),
        moving_mass=mass_factor * asset.moving.mass,
    )
