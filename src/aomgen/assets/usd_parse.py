"""Parse a USD file to an articulated asset; this module is used in the child process only."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.assets.normalization import choose_joint, complete, finish_link, to_asset_frame
from aomgen.assets.usd_geometry import read_links
from aomgen.assets.usd_material import check_layers
from aomgen.assets.usd_write import NAMESPACE
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.joint import Joint, JointType
from aomgen.core.transforms import apply, matrix_from_quat
from aomgen.core.values import Array
from aomgen.errors import AssetError, MalformedFileError

# Transform from Y up to Z up (4, 4).
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def parse_usd(
    path: Path,
    joint_name: str = "",
    *,
    scale: float = 1.0,
    limits: Sequence[float] = (),
    handle: Sequence[float] = (),
) -> ArticulatedAsset:
    """Parse a USD file in this process.

    The moving link consists of the joint's body 1 (or body 0 if body 1 is the world) and all bodies that other joints
    connect to it; the rest is static. The pose in the file is joint value 0, and the axis is oriented so that the limit
    with the larger magnitude is positive. The result is in the asset frame, see `normalization.to_asset_frame`. A file
    without `aomgen:handle_point` was not written by AOMGen: it is closed and gets a handle, see `normalization.complete`.

    Args:
        path: USD file.
        joint_name: Prim name or path of the joint that moves; may be empty if there is only one. Other joints are fixed.
        scale: Factor on all lengths; `limits` and `handle` refer to the unscaled file.
        limits: Lower and upper joint limit relative to the pose in the file, [rad] or [m]; they replace the limits in the
            file.
        handle: Lower and upper corner of a box around the handle, in the coordinates of the stage in meters, Z up.

    Raises:
        MalformedFileError, UnsafePathError, MissingFileError, LimitExceededError, AssetError: See `usd_read.read_usd`.
    """
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException:
        stage = None
    if not stage:
        raise MalformedFileError(path, "cannot be parsed as USD", "open and export the asset again")
    check_layers(stage, path.resolve().parent)
    unit = scale * float(UsdGeom.GetStageMetersPerUnit(stage))
    up = np.eye(4) if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else _Z_UP_FROM_Y_UP
    to_metric = up @ np.diag([unit, unit, unit, 1.0])
    joint, moving_bodies, bodies = _find_joint(stage, joint_name, to_metric, unit, path, limited=not limits)
    links = read_links(stage, moving_bodies, bodies, to_metric, path)
    static, moving = (replace(link, mass=scale**3 * link.mass) for link in links)
    root = stage.GetDefaultPrim()
    asset = ArticulatedAsset(
        name=str((root.GetDisplayName() or root.GetName()) if root else path.stem),
        category=str(_root_attribute(stage, "category") or path.stem.split("-")[0]),
        static=static,
        moving=moving,
        joint=joint,
        handle_point=np.zeros(3),
        handle_axis=np.array([0.0, 0.0, 1.0]),
        credit=str(_root_attribute(stage, "credit") or ""),
    )
    if _root_attribute(stage, "handle_point") is None or limits or handle:
        return complete(asset, path, scale=scale, limits=limits, handle=handle)
    authored = replace(asset, static=finish_link(static, path), moving=finish_link(moving, path))
    return to_asset_frame(_with_authored_handle(authored, stage, to_metric))


def _find_joint(
    stage: Any, name: str, to_metric: Array, unit: float, path: Path, *, limited: bool
) -> tuple[Joint, frozenset[str], frozenset[str]]:
    """Find a revolute or prismatic joint of a stage, and the prim paths of the moving bodies and of all bodies.

    Args:
        stage: Open Usd.Stage.
        name: Name or path of the joint; may be empty if there is only one.
        to_metric: Transform (4, 4) from stage coordinates to meters, Z up.
        unit: Length of the stage's unit, [m].
        path: File, for messages.
        limited: Refuse a joint without limits; otherwise such a joint gets the placeholder limits 0 .. 1.

    Raises:
        AssetError: There is no joint, or there are several to choose from (all are listed); the joint has no limits or
            no body.
    """
    from pxr import Usd, UsdPhysics

    prims = list(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    joints = [p for p in prims if p.IsA(UsdPhysics.RevoluteJoint) or p.IsA(UsdPhysics.PrismaticJoint)]
    prim = choose_joint({str(p.GetPath()): p for p in joints}, name, path)
    api = UsdPhysics.Joint(prim)
    bodies = [_target(api.GetBody0Rel()), _target(api.GetBody1Rel())]
    child = 1 if bodies[1] else 0
    if not bodies[child]:
        raise AssetError(path, f"joint {prim.GetPath()} names no body", "set body0 and body1")
    rigid = {str(p.GetPath()) for p in prims if p.HasAPI(UsdPhysics.RigidBodyAPI)} | set(filter(None, bodies))
    joint = _metric_joint(stage, prim, child, bodies, to_metric, unit, path, limited)
    return joint, frozenset(_find_rigid_group(bodies[child], prims, prim)), frozenset(rigid)


def _target(relation: Any) -> str:
    targets = relation.GetTargets() if relation else []
    return str(targets[0]) if targets else ""


def _find_rigid_group(body: str, prims: list[Any], moving: Any) -> set[str]:
    """Return the prim paths of a body and of all bodies that joints other than the moving one connect to it."""
    from pxr import UsdPhysics

    pairs = [
        (_target(UsdPhysics.Joint(p).GetBody0Rel()), _target(UsdPhysics.Joint(p).GetBody1Rel()))
        for p in prims
        if p.IsA(UsdPhysics.Joint) and p != moving
    ]
    group, size = {body}, 0
    while len(group) > size:
        size = len(group)
        for a, b in pairs:
            if a and b and (a in group or b in group):
                group |= {a, b}
    return group


def _metric_joint(
    stage: Any,
    prim: Any,
    child: int,
    bodies: list[str],
    to_metric: Array,
    unit: float,
    path: Path,
    limited: bool,
) -> Joint:
    from pxr import UsdPhysics

    revolute = prim.IsA(UsdPhysics.RevoluteJoint)
    api = UsdPhysics.RevoluteJoint(prim) if revolute else UsdPhysics.PrismaticJoint(prim)
    lower, upper = float(api.GetLowerLimitAttr().Get()), float(api.GetUpperLimitAttr().Get())
    if not (np.isfinite([lower, upper]).all() and lower < upper):
        if limited:
            raise AssetError(
                path, f"joint {prim.GetPath()} has limits {lower} .. {upper}",
                "state how far it opens: --limits 0 1.57 (rad or m)",
            )  # fmt: skip
        lower, upper = 0.0, 1.0
    scale = np.pi / 180.0 if revolute else unit
    frame = _frame(stage, prim, child, bodies[child], to_metric)
    axis = frame[:3, "XYZ".index(str(api.GetAxisAttr().Get()))]
    # A positive value moves body 1 relative to body 0 along the axis; if body 0 moves, the sign is reversed.
    sign = 1.0 if child == 1 else -1.0
    value = _value_as_it_stands(stage, prim, child, bodies, to_metric, sign * axis, revolute)
    lower, upper = lower * scale - value, upper * scale - value
    if abs(lower) > abs(upper):
        sign, lower, upper = -sign, -upper, -lower
    kind: JointType = "revolute" if revolute else "prismatic"
    return Joint(type=kind, axis=sign * axis, origin=frame[:3, 3], lower=lower + 0.0, upper=upper)


def _frame(stage: Any, prim: Any, side: int, body: str, to_metric: Array) -> Array:
    """Compute the joint frame (4, 4) on one of its bodies: unit axes and origin, [m]."""
    from pxr import UsdGeom, UsdPhysics

    api = UsdPhysics.Joint(prim)
    position = (api.GetLocalPos1Attr() if side else api.GetLocalPos0Attr()).Get()
    quat = (api.GetLocalRot1Attr() if side else api.GetLocalRot0Attr()).Get()
    place = to_metric
    if body:
        item = stage.GetPrimAtPath(body)
        place = to_metric @ np.array(UsdGeom.XformCache().GetLocalToWorldTransform(item)).T
    local = matrix_from_quat([quat.GetReal(), *quat.GetImaginary()])
    axes = place[:3, :3] @ local
    frame = np.eye(4)
    frame[:3, :3] = axes / np.linalg.norm(axes, axis=0)
    frame[:3, 3] = apply(place, np.array(position, np.float64))
    return frame


def _value_as_it_stands(
    stage: Any, prim: Any, child: int, bodies: list[str], to_metric: Array, axis: Array, revolute: bool
) -> float:
    """Compute the joint value in the pose of the file, [rad] or [m]; 0 if the two joint frames are inconsistent."""
    own = _frame(stage, prim, child, bodies[child], to_metric)
    other = _frame(stage, prim, 1 - child, bodies[1 - child], to_metric)
    offset = own[:3, 3] - other[:3, 3]
    if not revolute:
        along = float(offset @ axis)
        return along if np.linalg.norm(offset - along * axis) < 1e-3 else 0.0
    if not np.linalg.norm(offset) < 1e-3:
        return 0.0
    column = int(np.argmin(np.abs(own[:3, :3].T @ axis)))
    turned, reference = own[:3, column], other[:3, column]
    if not abs(reference @ axis) < 1e-3:
        return 0.0
    angle = float(np.arctan2(np.cross(reference, turned) @ axis, reference @ turned))
    return angle if abs(angle) > 1e-5 else 0.0


def _root_attribute(stage: Any, name: str) -> Any | None:
    root = stage.GetDefaultPrim()
    attribute = root.GetAttribute(f"{NAMESPACE}:{name}") if root else None
    return attribute.Get() if attribute else None


def _with_authored_handle(asset: ArticulatedAsset, stage: Any, to_metric: Array) -> ArticulatedAsset:
    from pxr import UsdGeom

    point, axis = _root_attribute(stage, "handle_point"), _root_attribute(stage, "handle_axis")
    if axis is None:
        raise AssetError(asset.name, "has aomgen:handle_point without aomgen:handle_axis", "author both")
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetDefaultPrim())).T
    place = to_metric @ matrix
    direction = place[:3, :3] @ np.array(axis, np.float64)
    return replace(
        asset,
        handle_point=apply(place, np.array(point, np.float64)),
        handle_axis=direction / np.linalg.norm(direction),
    )
