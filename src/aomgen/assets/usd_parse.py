"""One USD file to one articulated asset; runs in the child process only."""

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

# Rotation that turns a Y-up stage into Z up.
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def parse_usd(
    path: Path, joint_name: str = "", *, limits: Sequence[float] = (), handle: Sequence[float] = ()
) -> ArticulatedAsset:
    """Parse a USD file in this process.

    With a name, the joint of that prim name or path is the one that moves, and others are fixed as they are modelled.
    The moving link is what hangs on the joint's body 1 (or on body 0 where body 1 is the
    world), with everything fixed to it; the rest is static. As the file stands is joint value
    0; the axis is turned so that the larger limit is positive. The result is moved so that its
    front faces -y, it stands on z = 0 and is centred in x; a file that is already in this frame
    is not changed. A file without `aomgen:handle_point` is foreign: it is closed and gets a handle,
    see `normalization.complete`, which also explains `limits` and `handle`.

    Raises:
        MalformedFileError, UnsafePathError, MissingFileError, AssetError: See `usd_read.read_usd`.
    """
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException:
        stage = None
    if not stage:
        raise MalformedFileError(path, "cannot be parsed as USD", "open and export the asset again")
    check_layers(stage, path.resolve().parent)
    unit = float(UsdGeom.GetStageMetersPerUnit(stage))
    up = np.eye(4) if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else _Z_UP_FROM_Y_UP
    to_metric = up @ np.diag([unit, unit, unit, 1.0])
    joint, moving_bodies, bodies = _find_joint(stage, joint_name, to_metric, unit, path, limited=not limits)
    static, moving = read_links(stage, moving_bodies, bodies, to_metric, path)
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
        return complete(asset, path, limits=limits, handle=handle)
    authored = replace(asset, static=finish_link(static, path), moving=finish_link(moving, path))
    return to_asset_frame(_with_authored_handle(authored, stage, to_metric))


def _find_joint(
    stage: Any, name: str, to_metric: Array, unit: float, path: Path, *, limited: bool
) -> tuple[Joint, frozenset[str], frozenset[str]]:
    """A revolute or prismatic joint of a stage, and the prim paths of the bodies that move and of all.

    Args:
        name: Name of the joint; may be empty if there is only one.
        to_metric: From stage coordinates to metres, Z up (4, 4).
        unit: metersPerUnit.
        path: File, for messages.

    Raises:
        AssetError: There is none, or several to choose from (all are listed), or it has no limits or body.
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
    """The body and all that joints other than the moving one connect to it."""
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
    # The child's axis points along a positive value, the parent's against it when seen from the child.
    sign = 1.0 if child == 1 else -1.0
    value = _value_as_it_stands(stage, prim, child, bodies, to_metric, sign * axis, revolute)
    lower, upper = lower * scale - value, upper * scale - value
    if abs(lower) > abs(upper):
        sign, lower, upper = -sign, -upper, -lower
    kind: JointType = "revolute" if revolute else "prismatic"
    return Joint(type=kind, axis=sign * axis, origin=frame[:3, 3], lower=lower + 0.0, upper=upper)


def _frame(stage: Any, prim: Any, side: int, body: str, to_metric: Array) -> Array:
    """Joint frame on one of its bodies: unit axes and origin (4, 4), metric."""
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
    """Joint value of the authored poses, [rad] or [m]; 0 where the two frames do not fit together."""
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
