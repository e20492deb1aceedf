"""Inspect an asset before use: joint, size, handle, clearance for a finger, colliders, mass, textures."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from aomgen.assets.asset_check import (
    FINGER_BALL,
    check_asset,
    find_hinged_pairs,
    held_at_rim,
    outward_normal,
)
from aomgen.assets.normalization import DENSITIES
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.mesh import sample_meshes
from aomgen.core.values import Array

# Number of sampled surface points per link, and step along a finger's path behind the handle, [m].
SAMPLES, WAY_STEP_M = 60_000, 5e-4
# Distance changes below this are ignored when a gap is measured, because surface samples are millimeters apart, [m].
FAR_M = 1e-3
# Length of the path along which a gap is searched; handles protrude less, [m].
LONGEST_WAY_M = 0.08
# Largest recommended distance of the visible surface from the colliders, [m], and the percentile that is compared with it.
NEAR_M, MOST = 0.003, 95.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """The result of inspecting one property of an asset.

    Attributes:
        name: The inspected property.
        state: Its value.
        problem: The reason why the asset cannot be used, or empty.
        warning: A deficiency that does not prevent use, or empty.
    """

    name: str
    state: str
    problem: str = ""
    warning: str = ""


def examine(asset: ArticulatedAsset) -> list[Finding]:
    """Inspect all properties of an asset that do not depend on a recording."""
    problems = check_asset(asset)
    joint = asset.joint
    opening = f"{np.degrees(joint.upper):.0f} deg" if joint.type == "revolute" else f"{joint.upper:.3f} m"
    rng = np.random.default_rng(0)
    points = [sample_meshes(link.meshes, SAMPLES, rng) for link in (asset.static, asset.moving)]
    low, high = np.concatenate(points).min(0), np.concatenate(points).max(0)
    found = [Finding(name="use", state="", problem=sentence) for sentence in problems] or [
        Finding(name="use", state="can be simulated and grasped")
    ]
    found += [
        Finding(name="joint", state=f"{joint.type}, opens by {opening}"),
        Finding(name="size", state=" x ".join(f"{side:.3f}" for side in high - low) + " m"),
        _finger(asset, np.concatenate(points)),
        *(
            _colliders(link, surface)
            for link, surface in zip((asset.static, asset.moving), points, strict=True)
        ),
        *(_mass(link) for link in (asset.static, asset.moving)),
        *_hinges(asset),
        _textures(asset),
        *(Finding(name="assumed", state="", warning=note) for note in asset.notes),
    ]
    if asset.credit:
        found.append(Finding(name="credit", state=asset.credit))
    return found


def _finger(asset: ArticulatedAsset, surface: Array) -> Finding:
    """Measure the clearance between the visible meshes behind the handle, or on the narrower side of a rim."""
    rim = held_at_rim(asset)
    outward = outward_normal(asset)
    across: Array = np.cross(asset.handle_axis, outward).astype(np.float64)
    tree = cKDTree(surface)
    room = min(_room(tree, asset.handle_point, way) for way in ((across, -across) if rim else (-outward,)))
    state = (
        f"{'rim' if rim else 'bar'} at {np.round(asset.handle_point, 3).tolist()}, {1000 * room:.0f} mm free"
    )
    short = room < FINGER_BALL
    return Finding(
        name="handle",
        state=state,
        warning=f"the clearance between its meshes is less than {1000 * FINGER_BALL:.0f} mm" if short else "",
    )


def _room(tree: cKDTree, start: Array, direction: Array) -> float:
    """Compute the diameter of the largest ball in the first gap along a direction, [m].

    Args:
        tree: Points of the surface.
        start: Point (3,) inside a solid.
        direction: Unit direction (3,).
    """
    steps = np.arange(0.0, LONGEST_WAY_M, WAY_STEP_M)
    distances, _ = tree.query(start + steps[:, None] * direction)
    left = np.flatnonzero(distances > np.minimum.accumulate(distances) + FAR_M)
    gap = distances[left[0] :] if len(left) else np.zeros(1)
    narrows = np.flatnonzero(gap < np.maximum.accumulate(gap) - FAR_M)
    return 2 * float(gap[: narrows[0]].max() if len(narrows) else gap.max())


def _colliders(link: AssetLink, surface: Array) -> Finding:
    """Measure how far the visible surface is outside of the colliders."""
    off = 1000 * float(np.percentile(link.distances(surface), MOST))
    far = off > 1000 * NEAR_M
    return Finding(
        name=f"colliders of {link.name}",
        state=f"{len(link.colliders)} boxes; the surface is up to {off:.1f} mm outside",
        warning=f"this exceeds {1000 * NEAR_M:.0f} mm: author boxes that follow the surface" if far else "",
    )


def _mass(link: AssetLink) -> Finding:
    density = link.mass / link.volume
    odd = not DENSITIES[0] <= density <= DENSITIES[1]
    return Finding(
        name=f"mass of {link.name}",
        state=f"{link.mass:.2f} kg, {density:.0f} kg/m^3 of its colliders",
        warning="not plausible for a household object: check the unit" if odd else "",
    )


def _hinges(asset: ArticulatedAsset) -> list[Finding]:
    pairs = sorted(find_hinged_pairs(asset)) if asset.static.colliders and asset.moving.colliders else []
    if not pairs:
        return []
    shown = ", ".join(f"'{static}' in '{moving}'" for static, moving in pairs[:3])
    return [
        Finding(
            name="hinge",
            state=f"{len(pairs)} pairs of colliders overlap in the closed state ({shown}); "
            "they do not collide in simulation",
        )
    ]


def _textures(asset: ArticulatedAsset) -> Finding:
    meshes = [mesh for link in (asset.static, asset.moving) for mesh in link.meshes]
    textured = [mesh for mesh in meshes if mesh.texture_srgb.size]
    return Finding(name="textures", state=f"{len(textured)} of {len(meshes)} meshes")
