"""Convert a foreign asset to the asset frame: closed, with colliders, masses and a handle."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from aomgen.assets.asset_check import find_overlaps, outward_normal
from aomgen.assets.box_cover import box_cover
from aomgen.assets.handle_search import find_handle, opening_direction, state_handle
from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.mesh import sample_meshes
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.errors import AssetError, SeveralJointsError

# Rounds in which colliders are cut back, what is left free between them, and boards thinner than which carry nothing, [m].
CUTS: Final = 6
CLEARANCE_M, THINNEST_M = 2e-4, 1e-3
T = TypeVar("T")
# A link's own colliders are used where so much of its surface lies within this of them, [m].
COVER_SHARE, COVER_M, COVER_SAMPLES = 0.9, 0.02, 4000
# Used for a link whose file names no plausible mass, [kg/m^3] of its colliders.
FALLBACK_DENSITY = 400.0
# Densities outside these belong to no furniture or appliance, [kg/m^3].
DENSITIES: Final = (20.0, 4000.0)
# Limits at which an asset takes room that differs less than this share are equally closed.
SAME_ROOM: Final = 0.02


def choose_joint(joints: Mapping[str, T], name: str, path: Path) -> T:
    """The joint of that name, whole or its last part behind "/"; without a name the only one.

    Raises:
        AssetError: There is none of that name, or there are several to choose from; all are listed.
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
    """The link with boxes that cover it where it has no colliders, a mass, and every collider's name once.

    Raises:
        AssetError: It has no meshes.
    """
    boxes: list[BoxCollider] = []
    names = Counter[str]()
    for item in link.colliders or box_cover(link.meshes):
        names[item.name] += 1
        suffix = f"_{names[item.name]}" if names[item.name] > 1 else ""
        boxes.append(replace(item, name=item.name + suffix))
    if not link.meshes or not boxes:
        raise AssetError(path, f"link {link.name!r} has no meshes", "check what its joint connects")
    covered = replace(link, colliders=tuple(boxes))
    return covered if link.mass > 0 else replace(covered, mass=FALLBACK_DENSITY * covered.volume)


def _cover_surface(link: AssetLink) -> bool:
    """Return whether most of the visible surface of a link is near its own colliders."""
    if not (link.colliders and link.meshes):
        return False
    points = sample_meshes(link.meshes, COVER_SAMPLES, np.random.default_rng(0))
    return float(np.mean(link.distances(points) <= COVER_M)) >= COVER_SHARE


def complete(
    drawn: ArticulatedAsset, path: Path, *, limits: Sequence[float] = (), handle: Sequence[float] = ()
) -> ArticulatedAsset:
    """Convert a model to an asset: closed, with colliders, masses and a handle, in the asset frame.

    Args:
        drawn: The model in its original pose; links may be without colliders and mass.
        path: Its file, for messages.
        limits: Lower and upper limit of the joint in place of the file's, [rad] or [m] from the drawn pose.
        handle: Low and high corner of a box around the handle, in the coordinates of the file, [m].

    Returns:
        The asset; `notes` list the assumptions.

    Raises:
        AssetError: A link without meshes, or a moving one without a handle.
    """
    if limits:
        drawn = replace(drawn, joint=replace(drawn.joint, lower=float(limits[0]), upper=float(limits[1])))
    moving, static = (
        finish_link(link if _cover_surface(link) else replace(link, colliders=()), path)
        for link in (drawn.moving, drawn.static)
    )
    if handle:
        moving = state_handle(moving, np.array(handle[:3]), np.array(handle[3:]))
    notes = [*drawn.notes]
    links = []
    for link in (static, moving):
        plausible = _with_plausible_mass(link)
        if plausible.mass != link.mass:
            notes.append(
                f"'{link.name}' weighs {link.mass:.3g} kg in the file, {link.mass / link.volume:.3g} kg/m^3 of its "
                f"colliders; {plausible.mass:.2f} kg are assumed"
            )
        links.append(plausible)
    asset = find_handle(close(replace(drawn, static=links[0], moving=links[1])))
    return replace(to_asset_frame(clear_path(asset)), notes=tuple(notes))


def _with_plausible_mass(link: AssetLink) -> AssetLink:
    """The link, with a mass of usual density where the given one is implausible for furniture or appliances."""
    low, high = DENSITIES
    plausible = low <= link.mass / link.volume <= high
    return link if plausible else replace(link, mass=FALLBACK_DENSITY * link.volume)


def clear_path(asset: ArticulatedAsset) -> ArticulatedAsset:
    """Cut static colliders back to where the moving ones pass, and drop boxes that become too thin.

    Boxes overhang curved surfaces, and parts of purely visual models often overlap.
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
    """The box with its faces moved inward, each by the longest shift that points mostly through it."""
    R = box.T_asset_box[:3, :3]
    inward = np.zeros((2, 3))
    for shift in shifts:
        local = R.T @ shift
        axis = int(np.argmax(np.abs(local)))
        # An upward shift removes material from below.
        side = 0 if local[axis] > 0 else 1
        inward[side, axis] = max(inward[side, axis], abs(local[axis]))
    half = np.maximum(box.half_extents - inward.sum(0) / 2, 0.0)
    T = box.T_asset_box.copy()
    T[:3, 3] += R @ (inward[0] - inward[1]) / 2
    return replace(box, T_asset_box=T, half_extents=half)


def close(asset: ArticulatedAsset) -> ArticulatedAsset:
    """The asset turned to the limit of its joint at which it takes the least room, which becomes joint value 0.

    Files are drawn open or closed, with limits on either side; what is closed is nearly always a smaller box.
    """
    joint = asset.joint
    limits = np.array([joint.lower, joint.upper])
    static, moving = (
        np.concatenate([mesh.vertices for mesh in link.meshes]) for link in (asset.static, asset.moving)
    )
    room = []
    for value in limits:
        points = np.concatenate([static, apply(joint.motion(value), moving)])
        room.append(float(np.prod(np.ptp(points, axis=0))))
    least = np.array(room) <= (1 + SAME_ROOM) * min(room)
    value = float(min(limits[least], key=abs))
    turned = -1.0 if value == joint.upper else 1.0
    opening = replace(joint, axis=turned * joint.axis, lower=0.0, upper=joint.upper - joint.lower)
    return replace(asset, moving=asset.moving.transform(joint.motion(value)), joint=opening)


def to_asset_frame(asset: ArticulatedAsset) -> ArticulatedAsset:
    """The asset in the asset frame: front towards -y, on z = 0, centred in x and y.

    The front is turned by whole quarter turns, as files are drawn along their axes; a part that
    opens upwards (a lid) keeps its heading. Where the file names its handle, the face that
    carries it is the front. An asset that is already in this frame is not changed.
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
