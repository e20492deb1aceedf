"""Which colliders of a moving part are its handle: by name, by what protrudes, or a rim."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.joint import Joint
from aomgen.core.mesh import sample_meshes
from aomgen.core.transforms import transform
from aomgen.core.values import Array
from aomgen.errors import AssetError

# "nob" is how some makers spell it.
HANDLE_WORDS: Final = ("handle", "knob", "nob", "grip", "pull")
# A handle protrudes from the part by at least this, [m].
LEAST_PROTRUSION_M: Final = 0.008
# A handle covers less than this share of the front it is on.
MOST_AREA: Final = 0.25
# A hinged part's handle lies in the outer share of its reach.
OUTER_SHARE: Final = 0.5
# A collider within this of a named mesh belongs to it, [m].
NEAR_NAMED_M: Final = 0.005
# Colliders that protrude as far as the outermost one to within this are candidates for the held bar, [m].
SAME_HEIGHT_M: Final = 0.004
# A part thinner than this can be held at its rim, of which so much is its handle, [m].
MAX_RIM_M, RIM_DEPTH_M = 0.05, 0.03
# A box axis within 37 degrees of the opening direction is the normal of the front.
SAME_DIRECTION: Final = 0.8
# Surface points in which a stated handle is measured.
SAMPLES: Final = 40_000
PREFIX: Final = "handle"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """Indices of a handle's colliders, of the one that is held, and how far they protrude, [m]."""

    handle: list[int]
    bar: int
    protrusion: float


def opening_direction(link: AssetLink, joint: Joint) -> Array:
    """Unit direction (3,) in which the middle of the moving link starts to move."""
    if joint.type == "prismatic":
        return joint.axis
    points = np.concatenate([mesh.vertices for mesh in link.meshes])
    middle = (points.min(0) + points.max(0)) / 2
    direction = np.cross(joint.axis, middle - joint.origin)
    length = float(np.linalg.norm(direction))
    if not length > 1e-4:
        raise AssetError(link.name, "lies symmetrically around its joint axis", "state its handle: --handle")
    return direction / length


def find_handle(asset: ArticulatedAsset) -> ArticulatedAsset:
    """The asset with the handle's colliders named so, `handle_point` in the middle of the held one and `handle_axis` along it.

    Colliders that are named like a handle, or lie in a mesh named so, are looked at first; otherwise all
    colliders that protrude from the largest front. The front looks in the opening direction; that of a
    sliding door looks across it. A thin part without any handle is held at the rim far from its hinge.

    Raises:
        AssetError: Nothing protrudes, and the part has no rim that fingers hold.
    """
    link, joint = asset.moving, asset.joint
    found = _search(link, joint, _find_named(link)) or _search(link, joint, [])
    if found is None:
        return _hold_rim(asset)
    boxes = list(link.colliders)
    for number, index in enumerate(found.handle):
        boxes[index] = replace(boxes[index], name=f"{PREFIX}_{number}")
    bar = boxes[found.bar]
    along = int(np.argmax(bar.half_extents))
    return replace(
        asset,
        moving=replace(link, colliders=tuple(boxes)),
        handle_point=bar.T_asset_box[:3, 3],
        handle_axis=bar.T_asset_box[:3, along],
    )


def state_handle(link: AssetLink, low: Array, high: Array) -> AssetLink:
    """The link with one more collider, named as its handle: the box around its surface between two corners (3,), [m].

    Raises:
        AssetError: Nothing of the link lies there.
    """
    points = sample_meshes(link.meshes, SAMPLES, np.random.default_rng(0))
    inside = points[((points >= low) & (points <= high)).all(1)]
    if not len(inside) >= 3:
        raise AssetError(
            "--handle", f"no surface of the moving part lies in {low.tolist()} .. {high.tolist()}",
            "give the corners in the coordinates of the file, in metres",
        )  # fmt: skip
    lower, upper = inside.min(0), inside.max(0)
    box = BoxCollider(
        name=PREFIX,
        T_asset_box=transform(np.eye(3), (lower + upper) / 2),
        half_extents=np.maximum((upper - lower) / 2, 1e-3),
    )
    outside = [
        item for item in link.colliders if not ((item.T_asset_box[:3, 3] >= low) & (item.T_asset_box[:3, 3] <= high)).all()
    ]  # fmt: skip
    return replace(link, colliders=(*outside, box))


def _find_named(link: AssetLink) -> list[int]:
    """Indices of the colliders that are named like a handle, or lie in a mesh named so."""
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


def _search(link: AssetLink, joint: Joint, named: Sequence[int]) -> _Found | None:
    """The handle on the front that looks in the opening direction, or else on the one from which most protrudes."""
    first, *others = _fronts(link, joint)
    found = _protruding(link, joint, first, named)
    if found is not None:
        return found
    across = [item for front in others if (item := _protruding(link, joint, front, named)) is not None]
    return max(across, key=lambda item: item.protrusion, default=None)


def _fronts(link: AssetLink, joint: Joint) -> list[Array]:
    """Unit normals (3,) of the faces that may carry the handle, the likeliest first."""
    direction = opening_direction(link, joint)
    largest = max(link.colliders, key=lambda box: float(np.sort(box.half_extents)[1:].prod()))
    axes = largest.T_asset_box[:3, :3].T
    along = axes @ direction
    best = int(np.argmax(np.abs(along)))
    front = axes[best] * np.sign(along[best]) if abs(along[best]) >= SAME_DIRECTION else direction
    if joint.type == "revolute":
        return [front]
    across = [axes[k] for k in range(3) if abs(along[k]) < SAME_DIRECTION]
    return [front, *(sign * axis for axis in across for sign in (1, -1))]


def _protruding(link: AssetLink, joint: Joint, front: Array, named: Sequence[int]) -> _Found | None:
    """The colliders that stand off the largest one along a direction."""
    sides = np.linalg.svd(front[None])[2][1:]
    spans = np.array([[_span(box, axis) for axis in (front, *sides)] for box in link.colliders])
    areas = (spans[:, 1:, 1] - spans[:, 1:, 0]).prod(1)
    main = int(np.argmax(np.where(np.isin(np.arange(len(areas)), named), 0.0, areas)))
    top = spans[main, 0, 1]
    middles = np.array([box.T_asset_box[:3, 3] for box in link.colliders])
    out = spans[:, 0].mean(1) > top
    if len(named):
        out &= np.isin(np.arange(len(areas)), named)
    else:
        out &= areas < MOST_AREA * areas[main]
        if joint.type == "revolute":
            arms = middles - joint.origin
            reach = np.linalg.norm(arms - np.outer(arms @ joint.axis, joint.axis), axis=1)
            out &= reach >= OUTER_SHARE * reach.max()
    chosen = np.flatnonzero(out)
    if not len(chosen) or not spans[chosen, 0, 1].max() - top >= LEAST_PROTRUSION_M:
        return None
    heights = spans[chosen, 0].mean(1)
    outermost = chosen[heights >= heights.max() - SAME_HEIGHT_M]
    lengths = [2 * link.colliders[index].half_extents.max() for index in outermost]
    return _Found(
        handle=chosen.tolist(),
        bar=int(outermost[int(np.argmax(lengths))]),
        protrusion=float(spans[chosen, 0, 1].max() - top),
    )


def _span(box: BoxCollider, axis: Array) -> tuple[float, float]:
    """Lowest and highest coordinate of a box along a direction."""
    middle = float(box.T_asset_box[:3, 3] @ axis)
    half = float(np.abs(box.T_asset_box[:3, :3].T @ axis) @ box.half_extents)
    return middle - half, middle + half


def _hold_rim(asset: ArticulatedAsset) -> ArticulatedAsset:
    """The asset with the strip of its largest collider that is farthest from the hinge as its handle.

    Raises:
        AssetError: The part slides, or is too thick to be held.
    """
    link, joint = asset.moving, asset.joint
    index = int(np.argmax([np.sort(box.half_extents)[1:].prod() for box in link.colliders]))
    box = link.colliders[index]
    thin = int(np.argmin(box.half_extents))
    if joint.type != "revolute" or not 2 * box.half_extents[thin] <= MAX_RIM_M:
        raise AssetError(
            asset.name,
            f"has no handle: nothing protrudes from '{link.name}' by {1000 * LEAST_PROTRUSION_M:.0f} mm, nor is it "
            f"a lid thinner than {1000 * MAX_RIM_M:.0f} mm",
            "state where its handle is: --handle X0 Y0 Z0 X1 Y1 Z1, or name a mesh of it handle",
        )
    T, half = box.T_asset_box, box.half_extents
    along = int(np.argmax([abs(T[:3, k] @ joint.axis) if k != thin else -1 for k in range(3)]))
    away = 3 - thin - along
    sign = np.sign(T[:3, away] @ (T[:3, 3] - joint.origin))
    depth = min(RIM_DEPTH_M / 2, half[away] / 2)
    rim_half, rest_half = half.copy(), half.copy()
    rim_half[away], rest_half[away] = depth, half[away] - depth
    rim, rest = T.copy(), T.copy()
    rim[:3, 3] += sign * (half[away] - depth) * T[:3, away]
    rest[:3, 3] -= sign * depth * T[:3, away]
    boxes = list(link.colliders)
    boxes[index] = replace(box, T_asset_box=rest, half_extents=rest_half)
    boxes.append(BoxCollider(name=f"{PREFIX}_rim", T_asset_box=rim, half_extents=rim_half))
    return replace(
        asset,
        moving=replace(link, colliders=tuple(boxes)),
        handle_point=rim[:3, 3],
        handle_axis=T[:3, along],
    )
