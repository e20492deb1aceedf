"""The one joint of a USD stage, in metric Z-up coordinates."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.core.joint import Joint, JointType
from aomgen.core.transforms import apply, matrix_from_quat
from aomgen.core.values import Array
from aomgen.errors import AssetError


@dataclass(frozen=True, slots=True, kw_only=True)
class UsdJoint:
    """A joint and the prim paths of the bodies that move with it.

    Attributes:
        joint: Metric, Z up, value 0 as the file stands.
        moving_bodies: Prim paths.
        all_bodies: Prim paths of every rigid body.
    """

    joint: Joint
    moving_bodies: frozenset[str]
    all_bodies: frozenset[str]


def find_joint(stage: Any, to_metric: Array, unit: float, path: Path) -> UsdJoint:
    """Find the single revolute or prismatic joint of a stage.

    Args:
        to_metric: From stage coordinates to metres, Z up (4, 4).
        unit: metersPerUnit.
        path: File, for messages.

    Raises:
        AssetError: There is none, or several (all are listed), or it has no limits or body.
    """
    from pxr import Usd, UsdPhysics

    prims = list(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    moving = [p for p in prims if p.IsA(UsdPhysics.RevoluteJoint) or p.IsA(UsdPhysics.PrismaticJoint)]
    if len(moving) != 1:
        listed = ", ".join(f"{p.GetPath()} ({p.GetTypeName()})" for p in moving) or "none"
        problem = f"has {len(moving)} revolute or prismatic joints, want 1: {listed}"
        raise AssetError(path, problem, "fix the other joints in place or export one part")
    prim = moving[0]
    api = UsdPhysics.Joint(prim)
    bodies = [_target(api.GetBody0Rel()), _target(api.GetBody1Rel())]
    child = 1 if bodies[1] else 0
    if not bodies[child]:
        raise AssetError(path, f"joint {prim.GetPath()} names no body", "set body0 and body1")
    rigid = {str(p.GetPath()) for p in prims if p.HasAPI(UsdPhysics.RigidBodyAPI)} | set(filter(None, bodies))
    return UsdJoint(
        joint=_metric_joint(stage, prim, child, bodies, to_metric, unit, path),
        moving_bodies=frozenset(_fixed_to(bodies[child], prims)),
        all_bodies=frozenset(rigid),
    )


def _target(relation: Any) -> str:
    targets = relation.GetTargets() if relation else []
    return str(targets[0]) if targets else ""


def _fixed_to(body: str, prims: list[Any]) -> set[str]:
    """The body and all that fixed joints weld to it."""
    from pxr import UsdPhysics

    pairs = [
        (_target(UsdPhysics.Joint(p).GetBody0Rel()), _target(UsdPhysics.Joint(p).GetBody1Rel()))
        for p in prims
        if p.IsA(UsdPhysics.FixedJoint)
    ]
    group, size = {body}, 0
    while len(group) > size:
        size = len(group)
        for a, b in pairs:
            if a and b and (a in group or b in group):
                group |= {a, b}
    return group


def _metric_joint(
    stage: Any, prim: Any, child: int, bodies: list[str], to_metric: Array, unit: float, path: Path
) -> Joint:
    from pxr import UsdPhysics

    revolute = prim.IsA(UsdPhysics.RevoluteJoint)
    api = UsdPhysics.RevoluteJoint(prim) if revolute else UsdPhysics.PrismaticJoint(prim)
    lower, upper = float(api.GetLowerLimitAttr().Get()), float(api.GetUpperLimitAttr().Get())
    if not (np.isfinite([lower, upper]).all() and lower < upper):
        raise AssetError(
            path, f"joint {prim.GetPath()} has limits {lower} .. {upper}", "give it finite limits"
        )
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
