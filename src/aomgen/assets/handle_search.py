"""Find the colliders of a moving part that form its handle: by name, by protrusion, or at a rim."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from aomgen.assets.asset_check import check_handle, outward_normal
from aomgen.assets.usd_write import make_names_unique
from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.joint import Joint
from aomgen.core.mesh import sample_meshes
from aomgen.core.transforms import transform
from aomgen.core.values import Array
from aomgen.errors import AssetError

# Some models spell knob as "nob".
HANDLE_WORDS: Final = ("handle", "knob", "nob", "grip", "pull")
# A handle protrudes from the part by at least this, [m].
LEAST_PROTRUSION_M: Final = 0.008
# A knob that protrudes by at least this can be held from both sides, [m].
LEAST_PINCH_M: Final = 0.015
# A handle covers less than this share of its front.
MOST_AREA: Final = 0.25
# The handle of a hinged part is in this outer share of its extent.
OUTER_SHARE: Final = 0.5
# A collider within this of a named mesh belongs to it, [m].
NEAR_NAMED_M: Final = 0.005
# Colliders whose heights differ by less protrude equally, [m]; this number of them is tested as the held bar.
SAME_HEIGHT_M, MOST_BARS = 0.004, 3
# Largest thickness of a part that can be held at its rim, and depth of the rim that serves as the handle, [m].
MAX_RIM_M, RIM_DEPTH_M = 0.05, 0.03
# A box axis within 37 degrees of the opening direction is the normal of the front.
SAME_DIRECTION: Final = 0.8
# Surface points in which a stated handle is measured.
SAMPLES: Final = 40_000
PREFIX: Final = "handle"


def opening_direction(link: AssetLink, joint: Joint, handle: Sequence[int] = ()) -> Array:
    """Compute the unit direction (3,) in which the handle or the center of the closed moving link starts to move.

    Args:
        link: Moving link.
        joint: Its joint.
        handle: Indices of the colliders of the handle; if there are none, the direction is that of the link's center.

    Raises:
        AssetError: The handle or the center is on the axis of a revolute joint.
    """
    if joint.type == "prismatic":
        return joint.axis
    parts = [link.colliders[index].corners for index in handle] or [mesh.vertices for mesh in link.meshes]
    points = np.concatenate(parts)
    middle = (points.min(0) + points.max(0)) / 2
    direction = np.cross(joint.axis, middle - joint.origin)
    length = float(np.linalg.norm(direction))
    if not length > 1e-4:
        raise AssetError(
            link.name, "is symmetric about its joint axis", "state the position of its handle with --handle"
        )
    return direction / length


def find_handle(asset: ArticulatedAsset) -> ArticulatedAsset:
    """Name the handle colliders of a closed asset, and set `handle_point` and `handle_axis` to the held collider.

    The candidates are, in this order: colliders that are named like a handle or are inside of a mesh with such a name,
    colliders that protrude from the largest front in the opening direction, colliders that protrude from the sides (as
    handles of sliding doors do), and the rim of a thin part far from its hinge. On the first front with a handle that a
    gripper can hold, a bar with clearance behind it is preferred to a knob that is held from both sides. If no
    candidate can be held, the first one is used, and `check_handle` states the reason.

    Raises:
        AssetError: No collider protrudes, and the part has no rim.
    """
    link, joint = asset.moving, asset.joint
    named = _find_named(link)
    fronts = _fronts(link, joint, named)
    first: ArticulatedAsset | None = None
    for names in [named, []] if named else [[]]:
        opening, *across = [_protruding(link, joint, front, names) for front in fronts]
        # The handle of a sliding door is on the side with the largest protrusion.
        across.sort(key=lambda found: -max((deep for _, _, deep in found), default=0.0))
        for found in (opening, *across):
            bars = [_with_handle(asset, handle, bar) for handle, bar, _ in found]
            knobs = [
                _on_its_front(asset, handle, bar, deep)
                for handle, bar, deep in found
                if deep >= LEAST_PINCH_M
            ]
            held = [item for item in (*bars, *knobs) if not check_handle(item)]
            if held:
                return held[0]
            first = first or next(iter(bars), None)
    rims = _at_rim(asset)
    first = next((item for item in rims if not check_handle(item)), first or next(iter(rims), None))
    if first is None:
        raise AssetError(
            asset.name,
            f"has no handle: nothing protrudes from '{link.name}' by {1000 * LEAST_PROTRUSION_M:.0f} mm, "
            f"and it is not a lid thinner than {1000 * MAX_RIM_M:.0f} mm",
            "state its position with --handle X0 Y0 Z0 X1 Y1 Z1, or name one of its meshes 'handle'",
        )
    return first


def _with_handle(asset: ArticulatedAsset, handle: Sequence[int], bar: int) -> ArticulatedAsset:
    """Name colliders (given by index) as the handle of an asset, and set which of them is held."""
    boxes = list(asset.moving.colliders)
    for index in handle:
        boxes[index] = replace(boxes[index], name=f"{PREFIX}_{boxes[index].name}")
    along = int(np.argmax(boxes[bar].half_extents))
    return replace(
        asset,
        moving=replace(asset.moving, colliders=make_names_unique(boxes)),
        handle_point=boxes[bar].T_asset_box[:3, 3],
        handle_axis=boxes[bar].T_asset_box[:3, along],
    )


def _on_its_front(asset: ArticulatedAsset, handle: Sequence[int], bar: int, deep: float) -> ArticulatedAsset:
    """Set the handle as `_with_handle` does, and extend the held collider to the front, so that it can be pinched.

    Args:
        deep: Protrusion of the collider from the front, [m].
    """
    held = _with_handle(asset, handle, bar)
    box = held.moving.colliders[bar]
    outward = outward_normal(held)
    axis = int(np.argmax(np.abs(box.T_asset_box[:3, :3].T @ outward)))
    missing = max(0.0, deep - 2 * box.half_extents[axis])
    half, T = box.half_extents.copy(), box.T_asset_box.copy()
    half[axis] += missing / 2
    T[:3, 3] -= missing / 2 * outward
    boxes = list(held.moving.colliders)
    boxes[bar] = replace(box, T_asset_box=T, half_extents=half)
    return replace(held, moving=replace(held.moving, colliders=tuple(boxes)), handle_point=T[:3, 3])


def state_handle(link: AssetLink, low: Array, high: Array) -> AssetLink:
    """Add a handle collider to a link: the bounding box of the link's surface inside a given box.

    Args:
        link: Link of the handle; its colliders whose centers are in the given box are removed.
        low, high: Lower and upper corner of the given box (3,), in the frame of the link, [m].

    Raises:
        AssetError: The box contains no surface of the link.
    """
    points = sample_meshes(link.meshes, SAMPLES, np.random.default_rng(0))
    inside = points[((points >= low) & (points <= high)).all(1)]
    if not len(inside) >= 3:
        raise AssetError(
            "--handle", "states a box that contains no surface of the moving part",
            "give the corners in the coordinates of the file, in meters",
        )  # fmt: skip
    lower, upper = inside.min(0), inside.max(0)
    box = BoxCollider(
        name=f"{PREFIX}_stated",
        T_asset_box=transform(np.eye(3), (lower + upper) / 2),
        half_extents=np.maximum((upper - lower) / 2, 1e-3),
    )
    outside = [
        item for item in link.colliders if not ((item.T_asset_box[:3, 3] >= low) & (item.T_asset_box[:3, 3] <= high)).all()
    ]  # fmt: skip
    return replace(link, colliders=make_names_unique([*outside, box]))


def _find_named(link: AssetLink) -> list[int]:
    """Return the indices of colliders that are named like a handle or are inside of a mesh with such a name."""
    bounds = [
        (mesh.vertices.min(0) - NEAR_NAMED_M, mesh.vertices.max(0) + NEAR_NAMED_M)
        for mesh in link.meshes
        if _is_named(mesh.name)
    ]
    return [
        index
        for index, box in enumerate(link.colliders)
        if _is_named(box.name)
        or any((box.corners >= low).all() and (box.corners <= high).all() for low, high in bounds)
    ]


def _is_named(name: str) -> bool:
    return any(word in name.lower() for word in HANDLE_WORDS)


def _fronts(link: AssetLink, joint: Joint, named: Sequence[int]) -> list[Array]:
    """Return unit normals (3,) of the faces that may carry the handle, the most probable first.

    Args:
        link: Moving link.
        joint: Its joint.
        named: Indices of the colliders that are named as a handle; may be empty.
    """
    direction = opening_direction(link, joint, named)
    axes = link.colliders[_largest(link)].T_asset_box[:3, :3].T
    along = axes @ direction
    best = int(np.argmax(np.abs(along)))
    front = axes[best] * np.sign(along[best]) if abs(along[best]) >= SAME_DIRECTION else direction
    if joint.type == "revolute":
        return [front]
    across = [axes[k] for k in range(3) if abs(along[k]) < SAME_DIRECTION]
    return [front, *(sign * axis for axis in across for sign in (1, -1))]


def _largest(link: AssetLink) -> int:
    """Return the index of the collider with the largest face."""
    return int(np.argmax([np.sort(box.half_extents)[1:].prod() for box in link.colliders]))


def _protruding(
    link: AssetLink, joint: Joint, front: Array, named: Sequence[int]
) -> list[tuple[list[int], int, float]]:
    """Return the indices of colliders that protrude from the largest one along a direction, and candidates for holding.

    Each candidate is a collider with its protrusion, [m].
    """
    sides = np.linalg.svd(front[None])[2][1:]
    spans = np.array([[_span(box, axis) for axis in (front, *sides)] for box in link.colliders])
    areas = (spans[:, 1:, 1] - spans[:, 1:, 0]).prod(1)
    is_named = np.isin(np.arange(len(areas)), named)
    main = int(np.argmax(np.where(is_named, 0.0, areas)))
    top = spans[main, 0, 1]
    out = spans[:, 0].mean(1) > top
    if len(named):
        out &= is_named
    else:
        out &= areas < MOST_AREA * areas[main]
        if joint.type == "revolute":
            arms = np.array([box.T_asset_box[:3, 3] for box in link.colliders]) - joint.origin
            reach = np.linalg.norm(arms - np.outer(arms @ joint.axis, joint.axis), axis=1)
            out &= reach >= OUTER_SHARE * reach.max()
    # A handle protrudes from all other colliders: the front board of a drawer protrudes from its bottom alone.
    rest = spans[~out, 0, 1].max()
    out &= spans[:, 0].mean(1) > rest - SAME_HEIGHT_M
    handle = np.flatnonzero(out)
    if not len(handle) or not spans[handle, 0, 1].max() - top >= LEAST_PROTRUSION_M:
        return []
    heights = np.round(spans[handle, 0].mean(1) / SAME_HEIGHT_M)
    lengths = np.array([link.colliders[index].half_extents.max() for index in handle])
    # Sorted by height, then by length, both descending.
    order = np.lexsort((-lengths, -heights))[:MOST_BARS]
    return [(handle.tolist(), int(handle[place]), float(spans[handle[place], 0, 1] - top)) for place in order]


def _span(box: BoxCollider, axis: Array) -> tuple[float, float]:
    """Compute the lowest and highest coordinate of a box along a direction."""
    middle = float(box.T_asset_box[:3, 3] @ axis)
    half = float(np.abs(box.T_asset_box[:3, :3].T @ axis) @ box.half_extents)
    return middle - half, middle + half


def _at_rim(asset: ArticulatedAsset) -> list[ArticulatedAsset]:
    """Set the handle to the strip of the largest collider farthest from the hinge; empty for thick or sliding parts."""
    link, joint = asset.moving, asset.joint
    index = _largest(link)
    box = link.colliders[index]
    T, half = box.T_asset_box, box.half_extents
    thin = int(np.argmin(half))
    if joint.type != "revolute" or not 2 * half[thin] <= MAX_RIM_M:
        return []
    along = int(np.argmax(np.abs(T[:3, :3].T @ joint.axis) - 2 * np.eye(3)[thin]))
    away = 3 - thin - along
    outward = np.sign(T[:3, away] @ (T[:3, 3] - joint.origin)) * T[:3, away]
    depth = min(RIM_DEPTH_M / 2, half[away] / 2)
    rim, rest = T.copy(), T.copy()
    rim[:3, 3] += (half[away] - depth) * outward
    rest[:3, 3] -= depth * outward
    boxes = list(link.colliders)
    boxes[index] = replace(box, T_asset_box=rest, half_extents=half - depth * np.eye(3)[away])
    strip = half.copy()
    strip[away] = depth
    boxes.append(BoxCollider(name=f"{PREFIX}_rim", T_asset_box=rim, half_extents=strip))
    return [
        replace(
            asset,
            moving=replace(link, colliders=make_names_unique(boxes)),
            handle_point=rim[:3, 3],
            handle_axis=T[:3, along],
        )
    ]
