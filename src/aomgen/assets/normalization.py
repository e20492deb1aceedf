"""Convert an imported asset to the asset frame: closed, with colliders, masses and a handle."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from aomgen.assets.asset_check import find_overlaps, outward_normal
from aomgen.assets.box_cover import box_cover
from aomgen.assets.handle_search import find_handle, opening_direction, state_handle
from aomgen.assets.usd_write import make_names_unique
from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.mesh import sample_meshes
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.errors import AssetError, SeveralJointsError

# Largest number of iterations in which static colliders are cut back; the remaining clearance, [m]; and the smallest
# thickness of a box that is kept, [m].
CUTS: Final = 6
CLEARANCE_M, THINNEST_M = 2e-4, 1e-3
T = TypeVar("T")
# A link's own colliders are used if at least this share of its surface is within this distance of them, [m].
COVER_SHARE, COVER_M, COVER_SAMPLES = 0.9, 0.02, 4000
# Density of the colliders that is assumed for a link without a plausible mass in the file, [kg/m^3].
FALLBACK_DENSITY = 400.0
# Range of plausible densities of furniture and appliances, [kg/m^3].
DENSITIES: Final = (20.0, 4000.0)
# Two joint limits count as equally closed if the volumes of the asset's bounding boxes differ by less than this share.
SAME_ROOM: Final = 0.02
# A joint opens toward the limit that is at least this many times as far from a closed pose as the other limit.
FARTHER: Final = 2.0


def choose_joint(joints: Mapping[str, T], name: str, path: Path) -> T:
    """Select a joint by its name or by the last component of its path; an empty name selects the only joint.

    Args:
        joints: Joints by name or by path with "/".
        name: Name of the joint; may be empty.
        path: File of the joints, for messages.

    Raises:
        AssetError: There is no joint, or not exactly one of that name.
        SeveralJointsError: The name is empty and there are several joints; all are listed.
    """
    found = [item for known, item in joints.items() if not name or name in (known, known.rpartition("/")[2])]
    if len(found) == 1:
        return found[0]
    if not joints:
        raise AssetError(path, "has no revolute or prismatic joint", "add one, or choose another model")
    if not name:
        raise SeveralJointsError(path, joints, "name the one that opens: FILE#JOINT, or --joint in an import")
    raise AssetError(path, f"has no single joint '{name}'", f"choose one of: {', '.join(joints)}")


def finish_link(link: AssetLink, path: Path) -> AssetLink:
    """Return a link with colliders, a positive mass, and unique names of colliders and of meshes.

    If the link has no colliders, boxes cover its meshes; if it has no mass, `FALLBACK_DENSITY` is assumed.

    Args:
        link: Link to be completed.
        path: Its file, for messages.

    Raises:
        AssetError: The link has no meshes.
    """
    boxes = link.colliders or box_cover(link.meshes)
    if not link.meshes or not boxes:
        raise AssetError(path, f"link {link.name!r} has no meshes", "check what its joint connects")
    covered = replace(link, meshes=make_names_unique(link.meshes), colliders=make_names_unique(boxes))
    return covered if link.mass > 0 else replace(covered, mass=FALLBACK_DENSITY * covered.volume)


def _cover_surface(link: AssetLink) -> bool:
    """Return whether most of the visible surface of a link is near its own colliders."""
    if not (link.colliders and link.meshes):
        return False
    points = sample_meshes(link.meshes, COVER_SAMPLES, np.random.default_rng(0))
    return float(np.mean(link.distances(points) <= COVER_M)) >= COVER_SHARE


def complete(
    drawn: ArticulatedAsset,
    path: Path,
    *,
    scale: float = 1.0,
    limits: Sequence[float] = (),
    handle: Sequence[float] = (),
) -> ArticulatedAsset:
    """Convert a model to an asset: closed, with colliders, masses and a handle, in the asset frame.

    Args:
        drawn: The model in the pose of its file; links may be without colliders and mass.
        path: Its file, for messages.
        scale: Factor by which the model is larger than in its file; `limits` and `handle` refer to the file.
        limits: Lower and upper joint limit relative to the pose in the file, [rad] or [m]; they replace the limits in the
            file.
        handle: Lower and upper corner of a box around the handle, in the coordinates of the file, [m].

    Returns:
        The asset; `notes` list the assumptions.

    Raises:
        AssetError: A link has no meshes, or no handle was found on the moving link.
    """
    if limits:
        unit = scale if drawn.joint.type == "prismatic" else 1.0
        lower, upper = (unit * float(limit) for limit in limits)
        drawn = replace(drawn, joint=replace(drawn.joint, lower=lower, upper=upper))
    moving, static = (
        finish_link(link if _cover_surface(link) else replace(link, colliders=()), path)
        for link in (drawn.moving, drawn.static)
    )
    if handle:
        moving = state_handle(moving, scale * np.array(handle[:3]), scale * np.array(handle[3:]))
    notes = [*drawn.notes]
    links = []
    for link in (static, moving):
        density, mass = link.mass / link.volume, FALLBACK_DENSITY * link.volume
        # Another density is implausible for furniture or appliances.
        if not DENSITIES[0] <= density <= DENSITIES[1]:
            notes.append(
                f"'{link.name}' weighs {link.mass / scale**3:.3g} kg in the file, {density:.3g} kg/m^3 of its colliders; "
                f"{mass:.2f} kg are assumed"
            )
            link = replace(link, mass=mass)
        links.append(link)
    asset = find_handle(close(replace(drawn, static=links[0], moving=links[1])))
    return replace(to_asset_frame(clear_path(asset)), notes=tuple(notes))


def clear_path(asset: ArticulatedAsset) -> ArticulatedAsset:
    """Cut static colliders back where the moving colliders pass, and remove boxes that become too thin.

    This is necessary because boxes protrude from curved surfaces, and parts of purely visual models often overlap.
    """
    for _ in range(CUTS):
        cuts: dict[str, list[Array]] = {}
        for overlap in find_overlaps(asset):
            shift = (overlap.depth + CLEARANCE_M) * overlap.normal
            cuts.setdefault(overlap.static, []).append(shift)
        if not cuts:
            return asset
        kept = [_cut(box, cuts.get(box.name, [])) for box in asset.static.colliders]
        boxes = tuple(box for box in kept if box.half_extents.min() > THINNEST_M / 2)
        asset = replace(asset, static=replace(asset.static, colliders=boxes))
    return asset


def _cut(box: BoxCollider, shifts: list[Array]) -> BoxCollider:
    """Move the faces of a box inward, each by the longest of the shifts that are mostly along its inward normal."""
    R = box.T_asset_box[:3, :3]
    inward = np.zeros((2, 3))
    for shift in shifts:
        local = R.T @ shift
        axis = int(np.argmax(np.abs(local)))
        # A shift in the positive direction removes material at the lower face.
        side = 0 if local[axis] > 0 else 1
        inward[side, axis] = max(inward[side, axis], abs(local[axis]))
    half = np.maximum(box.half_extents - inward.sum(0) / 2, 0.0)
    T = box.T_asset_box.copy()
    T[:3, 3] += R @ (inward[0] - inward[1]) / 2
    return replace(box, T_asset_box=T, half_extents=half)


def close(asset: ArticulatedAsset) -> ArticulatedAsset:
    """Move the joint to the limit at which the asset's bounding box is smallest; this pose becomes joint value 0.

    Files show objects open or closed, with limits of either sign; the bounding box is nearly always smallest when the
    object is closed. If it is smallest between the limits, in the pose of the file, this pose is closed, and the farther
    limit is open. The axis is reversed if necessary, so that positive values open the joint.

    Raises:
        AssetError: The pose of the file is closed, and the limits do not state in which direction the joint opens.
    """
    joint = asset.joint
    limits = sorted([joint.lower, joint.upper], key=abs)
    room = [_bounding_volume(asset, value) for value in limits]
    drawn = _bounding_volume(asset, 0.0)
    if joint.lower < 0 < joint.upper and (1 + SAME_ROOM) * drawn < min(room):
        if not abs(limits[1]) >= FARTHER * abs(limits[0]):
            raise AssetError(
                asset.name,
                f"is closed between its joint limits {joint.lower:.3g} and {joint.upper:.3g}",
                "state the limits of one direction: --limits 0 UPPER or --limits LOWER 0",
            )
        limits[0], room[0] = 0.0, drawn
    closed, opened = limits if room[0] <= (1 + SAME_ROOM) * room[1] else reversed(limits)
    axis = joint.axis if opened > closed else -joint.axis
    opening = replace(joint, axis=axis, lower=0.0, upper=abs(opened - closed))
    return replace(asset, moving=asset.moving.transform(joint.motion(closed)), joint=opening)


def _bounding_volume(asset: ArticulatedAsset, value: float) -> float:
    """Compute the volume of the bounding box of an asset's meshes at a joint value, [m^3]."""
    static, moving = (
        np.concatenate([mesh.vertices for mesh in link.meshes]) for link in (asset.static, asset.moving)
    )
    points = np.concatenate([static, apply(asset.joint.motion(value), moving)])
    return float(np.prod(np.ptp(points, axis=0)))


def to_asset_frame(asset: ArticulatedAsset) -> ArticulatedAsset:
    """Transform an asset to the asset frame: front toward -y, standing on z = 0, centered in x and y.

    The rotation is a multiple of 90 degrees about z, because models are aligned with the axes of their files; a part that
    opens upward (a lid) keeps its heading. If the file names the handle, the face that carries it is the front. An asset
    that is already in this frame is not changed.
    """
    named = asset.handle_bar is not None
    outward = outward_normal(asset) if named else opening_direction(asset.moving, asset.joint)
    turns = 0
    if np.hypot(outward[0], outward[1]) > 0.5:
        angle = np.arctan2(-1.0, 0.0) - np.arctan2(outward[1], outward[0])
        turns = int(np.round(angle / (np.pi / 2))) % 4
    R = np.round(matrix_from_rotvec([0.0, 0.0, turns * np.pi / 2]))
    points = np.concatenate([mesh.vertices for mesh in asset.static.meshes]) @ R.T
    middle = (points.min(0) + points.max(0)) / 2
    everything = np.concatenate([m.vertices for link in (asset.static, asset.moving) for m in link.meshes])
    offset = np.array([-middle[0], 0.0, -everything[:, 2].min()])
    if turns or abs(middle[1]) > 0.25:
        offset[1] = -middle[1]
    offset[np.abs(offset) < 2e-3] = 0.0
    T = transform(R, offset)
    return asset if np.allclose(T, np.eye(4), atol=1e-6) else asset.transform(T)
