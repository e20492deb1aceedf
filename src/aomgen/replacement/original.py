"""The recorded object itself as an asset: boxes around its points, its estimated joint and its own Gaussians.

Source: AOMGen, sec. 4.3, "Pose Generalization", which moves the reconstructed object.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np

from aomgen.assets.choice import ORIGINAL
from aomgen.assets.normalization import FALLBACK_DENSITY, clear_path
from aomgen.assets.procedural.shapes import AlignedBox, Material, boxes_mesh
from aomgen.conventions import MOVING, STATIC
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.boxes import QUANTILES
from aomgen.core.demonstration import Demonstration, RecordedObject
from aomgen.core.joint import LIMIT_SHARE
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply, invert, transform
from aomgen.core.values import Array
from aomgen.errors import EstimationError
from aomgen.replacement.correspondence import RecordedContact, face_sides, slide_along_handle
from aomgen.twin.twin import OBJECT, PART, TwinModel

# Assumed thickness of a door or flap, [m]: through its window the scan shows the surfaces behind it.
DOOR_M: Final = 0.03
# Gaussians farther behind the door than this do not belong to it, [m].
BEHIND_M: Final = 0.01
# A handle is searched within these distances of the held point, across its bar and along it, [m].
AROUND_M, ALONG_M = 0.03, 0.15
# Distance between the handle and the face on which it is mounted, [m].
FACE_M: Final = 0.005
# Quantiles of the handle's points that bound its box.
HANDLE_QUANTILES: Final = (0.05, 0.95)
# Smallest number of points of a handle.
LEAST_POINTS: Final = 30
# Gap between the body and the part that it encloses, [m].
GAP_M: Final = 0.002
# Upper joint limit as a multiple of the largest recorded joint value: the range beyond is unobserved.
BEYOND: Final = 1.001
# Name of the collider of the moving part without its handle.
PANEL: Final = "panel"


def fit_original(
    demo: Demonstration, contact: RecordedContact, recorded: RecordedObject, category: str
) -> FittedAsset:
    """Describe the recorded object as an asset at its recorded location, closed, with its recorded motion.

    The links are solid boxes; the space of the moving part is removed from the body. Their density is that of assets without a
    stated mass.

    Raises:
        EstimationError: The recorded motion closes the object, or no handle protrudes from the part at the held point.
    """
    if contact.direction == "closing":
        raise EstimationError("original", "was scanned open", "record its opening, or name other assets")
    R = contact.R_world_front
    low, high = np.quantile(recorded.static_points_world @ R, QUANTILES, axis=0)
    T_world_asset = transform(R, R @ np.append((low + high)[:2] / 2, contact.support_z))
    asset = _as_boxes(demo, contact, recorded, T_world_asset, category)
    held = apply(invert(T_world_asset), contact.path_world[0])
    contact_asset = slide_along_handle(asset, float((held - asset.handle_point) @ asset.handle_axis))
    path = apply(T_world_asset @ asset.joint.motion(contact.thetas), contact_asset[None])
    return FittedAsset(
        asset=asset,
        T_world_asset=T_world_asset,
        contact_asset=contact_asset,
        shares=contact.shares,
        thetas=contact.thetas,
        scale=1.0,
        mirrored=False,
        mode="trajectory",
        residual_mm=float(1000 * np.sqrt(((path - contact.path_world) ** 2).sum(1).mean())),
    )


def _as_boxes(
    demo: Demonstration,
    contact: RecordedContact,
    recorded: RecordedObject,
    T_world_asset: Array,
    category: str,
) -> ArticulatedAsset:
    to_asset = invert(T_world_asset)
    static, moving = (
        apply(to_asset, points) for points in (recorded.static_points_world, recorded.moving_points_world)
    )
    held = apply(to_asset, contact.path_world[0])
    joint = demo.joint.move(to_asset)
    joint = replace(joint, lower=0.0, upper=BEYOND * float(contact.thetas[-1]) / LIMIT_SHARE)
    # A held bar is parallel to the x axis of the end effector, and upright or level on its face.
    hand_x = to_asset[:3, :3] @ demo.Ts_world_ee[demo.contact_frames[0], :3, 0]
    bar, across = (0, 2) if abs(hand_x[0]) > abs(hand_x[2]) else (2, 0)
    panel, handle = _part_boxes(moving, held, bar, across)
    if joint.type == "revolute" and face_sides(joint, held) == [0, 2]:
        panel[1, 1] = min(panel[1, 1], panel[0, 1] + DOOR_M)
    body = np.quantile(static, QUANTILES, axis=0)
    body[0, 2] = 0.0
    around = {f"body_{k}": box for k, box in enumerate(subtract_box(body, panel))}
    return clear_path(
        ArticulatedAsset(
            name=ORIGINAL,
            category=category,
            static=box_link("body", around),
            moving=box_link("part", {PANEL: panel, "handle_bar": handle}),
            joint=joint,
            handle_point=handle.mean(0),
            handle_axis=np.eye(3)[bar],
        )
    )


def original_twin(background: TwinModel, recorded: TwinModel, fitted: FittedAsset) -> TwinModel:
    """Add the recorded Gaussians of the object, in the colors of the scan, to the cleared scene as those of an asset.

    Gaussians behind a door's window belong to the body.
    """
    T_asset_object = invert(fitted.T_world_asset) @ recorded.T_world_object
    which = np.isin(recorded.labels, (STATIC, MOVING))
    own = recorded.gaussians.select(which).transform(T_asset_object)
    moving = recorded.labels[which] == MOVING
    if fitted.asset.joint.type == "revolute":
        panel = next(box for box in fitted.asset.moving.colliders if box.name == PANEL)
        moving &= own.means[:, 1] < panel.corners[:, 1].max() + BEHIND_M
    return background.extend(
        own,
        np.where(moving, background.body(PART), background.body(OBJECT)).astype(np.int32),
        np.where(moving, MOVING, STATIC).astype(np.uint8),
        joint=fitted.asset.joint,
        T_world_object=fitted.T_world_asset,
        scan_state=replace(background.scan_state, theta=0.0, T_world_object=fitted.T_world_asset),
    )


def _part_boxes(moving: Array, held: Array, bar: int, across: int) -> tuple[Array, Array]:
    """Fit the corners (2, 3) of the boxes of panel and handle, asset frame, [m].

    Args:
        moving: Points (N, 3) of the moving part, asset frame, [m].
        held: The held point (3,), asset frame, [m].
        bar, across: Index of the axis along the handle's bar, and of the other axis of its face.

    Raises:
        EstimationError: See `fit_original`.
    """
    aside = np.abs(moving[:, across] - held[across])
    if not (aside > AROUND_M).sum() >= LEAST_POINTS:
        raise EstimationError("original", "the part is not larger than its handle", "name other assets")
    panel = np.quantile(moving[aside > AROUND_M], QUANTILES, axis=0)
    panel[:, across] = np.quantile(moving[:, across], QUANTILES)
    near = (aside < AROUND_M) & (np.abs(moving[:, bar] - held[bar]) < ALONG_M)
    near &= (moving[:, 1] < panel[0, 1] - FACE_M) & (np.abs(moving[:, 1] - held[1]) < AROUND_M)
    if not near.sum() >= LEAST_POINTS:
        raise EstimationError(
            "original",
            f"{near.sum()} points protrude from the part where it was held, expected {LEAST_POINTS}",
            "scan the handle from nearby, or name other assets",
        )
    panel[0, 2] = max(panel[0, 2], GAP_M)
    handle = np.quantile(moving[near], HANDLE_QUANTILES, axis=0)
    # The depth of a bar is assumed to equal its width, because the scan shows posts and blur behind it.
    handle[1, 1] = handle[0, 1] + np.ptp(handle[:, across])
    return panel, handle


def subtract_box(box: Array, hole: Array) -> list[Array]:
    """Fill a box, except for a hole in it, with boxes; all are corners (2, 3)."""
    rest, pieces = box.copy(), []
    hole = hole + GAP_M * np.array([[-1.0], [1.0]])
    if not ((hole[0] < box[1]) & (hole[1] > box[0])).all():
        return [box]
    for axis, end in product(range(3), range(2)):
        piece = rest.copy()
        piece[1 - end, axis] = hole[end, axis]
        if piece[1, axis] > piece[0, axis]:
            pieces.append(piece)
            rest[end, axis] = hole[end, axis]
    return pieces


def box_link(name: str, boxes: Mapping[str, Array]) -> AssetLink:
    """Create a link whose visible mesh is its collider boxes (2, 3), for programs that use the asset without its Gaussians."""
    shapes = {key: AlignedBox(lower=tuple(low), upper=tuple(high)) for key, (low, high) in boxes.items()}
    colliders = tuple(shape.collider(key) for key, shape in shapes.items())
    mesh = boxes_mesh(name, list(shapes.values()), Material())
    link = AssetLink(name=name, meshes=(mesh,), colliders=colliders, mass=0.0)
    return replace(link, mass=FALLBACK_DENSITY * link.volume)
