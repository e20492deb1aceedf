"""One USD file to one articulated asset; runs in the child process only."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.assets.canonical import canonical_transform, guess_handle
from aomgen.assets.usd_geometry import LinkParts, read_links
from aomgen.assets.usd_joint import find_joint
from aomgen.assets.usd_material import check_layers
from aomgen.assets.usd_write import NAMESPACE
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.errors import AssetError, MalformedFileError

# Used for a link whose file names no mass, [kg/m^3] of its colliders.
FALLBACK_DENSITY = 400.0
# Rotation that turns a Y-up stage into Z up.
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def parse_usd(path: Path) -> ArticulatedAsset:
    """Parse a USD file in this process.

    The moving link is what hangs on the joint's body 1 (or on body 0 where body 1 is the
    world), with everything fixed to it; the rest is static. As the file stands is joint value
    0; the axis is turned so that the larger limit is positive. The result is moved so that its
    front looks towards -y, it stands on z = 0 and is centred in x; a file that is so already
    is not touched. Without `aomgen:handle_point` the handle is guessed (`canonical.guess_handle`).

    Raises:
        MalformedFileError, UnsafePathError, MissingFileError, AssetError: See `usd_read.read_usd`.
    """
    from pxr import Tf, Usd, UsdGeom, UsdPhysics

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise MalformedFileError(
            path, "cannot be parsed as USD", "open and export the asset again"
        ) from error
    if not stage:
        raise MalformedFileError(path, "cannot be parsed as USD", "open and export the asset again")
    folder = path.resolve().parent
    check_layers(stage, folder)
    unit = float(UsdGeom.GetStageMetersPerUnit(stage))
    up = np.eye(4) if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else _Z_UP_FROM_Y_UP
    to_metric = up @ np.diag([unit, unit, unit, 1.0])
    joint = find_joint(stage, to_metric, unit, path)
    static, moving = read_links(stage, joint, to_metric, folder)
    kilograms = float(UsdPhysics.GetStageKilogramsPerUnit(stage))
    asset = ArticulatedAsset(
        name=_name(stage, path),
        category=str(_root_attribute(stage, "category") or path.stem.split("-")[0]),
        static=_link(static, kilograms, path),
        moving=_link(moving, kilograms, path),
        joint=joint.joint,
        handle_point=np.zeros(3),
        handle_axis=np.array([0.0, 0.0, 1.0]),
    )
    return _placed(_with_handle(asset, stage, to_metric))


def _name(stage: Any, path: Path) -> str:
    root = stage.GetDefaultPrim()
    return str((root.GetDisplayName() or root.GetName()) if root else path.stem)


def _root_attribute(stage: Any, name: str) -> Any | None:
    root = stage.GetDefaultPrim()
    attribute = root.GetAttribute(f"{NAMESPACE}:{name}") if root else None
    return attribute.Get() if attribute else None


def _link(parts: LinkParts, kilograms: float, path: Path) -> AssetLink:
    if not parts.meshes or not parts.colliders:
        raise AssetError(path, f"link {parts.name!r} has no meshes", "check which prims its joint connects")
    mass = parts.mass * kilograms
    if not mass > 0:
        mass = FALLBACK_DENSITY * sum(8 * float(box.half_extents.prod()) for box in parts.colliders)
    return AssetLink(name=parts.name, meshes=parts.meshes, colliders=parts.colliders, mass=mass)


def _with_handle(asset: ArticulatedAsset, stage: Any, to_metric: Array) -> ArticulatedAsset:
    from pxr import UsdGeom

    point, axis = _root_attribute(stage, "handle_point"), _root_attribute(stage, "handle_axis")
    if point is None or axis is None:
        guessed = guess_handle(asset.moving, asset.joint)
        return replace(asset, handle_point=guessed.point, handle_axis=guessed.axis)
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetDefaultPrim())).T
    place = to_metric @ matrix
    direction = place[:3, :3] @ np.array(axis, np.float64)
    return replace(
        asset,
        handle_point=apply(place, np.array(point, np.float64)),
        handle_axis=direction / np.linalg.norm(direction),
    )


def _placed(asset: ArticulatedAsset) -> ArticulatedAsset:
    T = canonical_transform(asset)
    return asset if np.allclose(T, np.eye(4), atol=1e-6) else asset.transformed(T)
