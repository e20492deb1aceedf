"""An asset from elsewhere in the frame in which all of ours stand, closed, with a handle."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from aomgen.assets.asset_check import find_overlaps, outward_normal
from aomgen.assets.box_cover import box_cover
from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.joint import Joint
from aomgen.core.mesh import sample_meshes
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.errors import AssetError

HANDLE_WORDS = ("handle", "knob", "grip", "pull")
# The handle's outermost layer, [m], in which its middle and direction are sought.
LAYER = 0.008
# A revolute part's handle lies in the outer share of its reach.
OUTER_SHARE = 0.5
# Surface points that the handle is searched in: many on each handle of usual size.
SAMPLES = 20_000
# Rounds in which colliders are cut back, what is left free between them, and boards thinner than which carry nothing, [m].
CUTS: Final = 6
CLEARANCE_M, THINNEST_M = 2e-4, 1e-3
T = TypeVar("T")
# Used for a link whose file names no mass, [kg/m^3] of its colliders.
FALLBACK_DENSITY = 400.0
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
    listed = ", ".join(joints) or "none"
    if not joints or not name:
        problem = f"has {len(joints)} revolute or prismatic joints, want 1: {listed}"
        raise AssetError(path, problem, "name the one that opens: FILE#JOINT, or --joint when it is imported")
    raise AssetError(path, f"has no single joint '{name}'", f"choose one of: {listed}")


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
    volume = sum(8 * float(box.half_extents.prod()) for box in boxes)
    return replace(
        link, colliders=tuple(boxes), mass=link.mass if link.mass > 0 else FALLBACK_DENSITY * volume
    )


def cleared(asset: ArticulatedAsset) -> ArticulatedAsset:
    """The asset with static colliders cut back to where the moving ones pass; what is left thinner is dropped.

    Boxes overhang curved surfaces, and models that were drawn to be looked at are often in each other.
    """
    for _ in range(CUTS):
        cuts: dict[str, list[Array]] = {}
        for overlap in find_overlaps(asset):
            way = (overlap.depth + CLEARANCE_M) * overlap.normal
            cuts.setdefault(overlap.static, []).append(way)
        if not cuts:
            return asset
        kept = [_cut(box, cuts.get(box.name, [])) for box in asset.static.colliders]
        boxes = tuple(box for box in kept if box.half_extents.min() > THINNEST_M / 2)
        asset = replace(asset, static=replace(asset.static, colliders=boxes))
    return asset


def _cut(box: BoxCollider, ways: list[Array]) -> BoxCollider:
    """The box with its faces moved inward, each by the longest of the ways that point through it mostly."""
    R = box.T_asset_box[:3, :3]
    inward = np.zeros((2, 3))
    for way in ways:
        local = R.T @ way
        axis = int(np.argmax(np.abs(local)))
        # Giving way upwards means to lose from below.
        side = 0 if local[axis] > 0 else 1
        inward[side, axis] = max(inward[side, axis], abs(local[axis]))
    half = np.maximum(box.half_extents - inward.sum(0) / 2, 0.0)
    T = box.T_asset_box.copy()
    T[:3, 3] += R @ (inward[0] - inward[1]) / 2
    return replace(box, T_asset_box=T, half_extents=half)


def closed(asset: ArticulatedAsset) -> ArticulatedAsset:
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
    return replace(asset, moving=asset.moving.transformed(joint.motion(value)), joint=opening)


def _opening_direction(link: AssetLink, joint: Joint) -> Array:
    """Unit direction (3,) in which the middle of the moving link starts to move."""
    if joint.type == "prismatic":
        return joint.axis
    points = np.concatenate([mesh.vertices for mesh in link.meshes])
    middle = (points.min(0) + points.max(0)) / 2
    direction = np.cross(joint.axis, middle - joint.origin)
    length = float(np.linalg.norm(direction))
    if not length > 1e-4:
        raise AssetError(link.name, "lies symmetrically around its joint axis", "name its handle in the file")
    return direction / length


def guess_handle(link: AssetLink, joint: Joint) -> tuple[Array, Array]:
    """Guess the middle of a moving link's handle bar (3,), [m], and its unit direction (3,).

    Meshes named like a handle are taken where there are some; otherwise the part of the link
    that protrudes most in the opening direction, for a revolute part within the outer half of
    its reach (a handle is opposite the hinge). The direction is the longer one of that region.
    """
    named = [m for m in link.meshes if any(word in m.name.lower() for word in HANDLE_WORDS)]
    points = sample_meshes(named or link.meshes, SAMPLES, np.random.default_rng(0))
    outward = _opening_direction(link, joint)
    if joint.type == "revolute" and not named:
        arms = points - joint.origin
        reach = np.linalg.norm(arms - np.outer(arms @ joint.axis, joint.axis), axis=1)
        points = points[reach >= OUTER_SHARE * reach.max()]
    heights = points @ outward
    bar = points[heights >= heights.max() - LAYER]
    across = np.linalg.svd(outward[None])[2][1:]
    flat = (bar - bar.mean(0)) @ across.T
    direction = np.linalg.svd(flat, full_matrices=False)[2][0] @ across
    side = np.cross(outward, direction)
    point = sum(
        (0.5 * ((bar @ axis).min() + (bar @ axis).max()) * axis for axis in (direction, side)), np.zeros(3)
    )
    return point + (heights.max() - LAYER / 2) * outward, direction


def to_asset_frame(asset: ArticulatedAsset) -> ArticulatedAsset:
    """The asset in the asset frame: front towards -y, on z = 0, centred in x and y.

    The front is turned by whole quarter turns, as files are drawn along their axes; a part that
    opens upwards (a lid) keeps its heading. Where the file names its handle, the face that
    carries it is the front. An asset that stands so already is not touched.
    """
    named = asset.handle_bar is not None
    outward = outward_normal(asset) if named else _opening_direction(asset.moving, asset.joint)
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
    return asset if np.allclose(T, np.eye(4), atol=1e-6) else asset.transformed(T)
