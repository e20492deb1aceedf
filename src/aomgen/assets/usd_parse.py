"""One USD file to one articulated asset; runs in the child process only."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.assets.asset_check import outward_normal
from aomgen.assets.usd_geometry import read_links
from aomgen.assets.usd_material import check_layers
from aomgen.assets.usd_write import NAMESPACE
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import Joint, JointType
from aomgen.core.mesh import sample_surface
from aomgen.core.transforms import apply, matrix_from_quat, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.errors import AssetError, MalformedFileError

HANDLE_WORDS = ("handle", "knob", "grip", "pull")
# The handle's outermost layer, [m], in which its middle and direction are sought.
LAYER = 0.008
# A revolute part's handle lies in the outer share of its reach.
OUTER_SHARE = 0.5
# Surface points that the handle is searched in: many on each handle of usual size.
SAMPLES = 20_000
# Rotation that turns a Y-up stage into Z up.
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def parse_usd(path: Path) -> ArticulatedAsset:
    """Parse a USD file in this process.

    The moving link is what hangs on the joint's body 1 (or on body 0 where body 1 is the
    world), with everything fixed to it; the rest is static. As the file stands is joint value
    0; the axis is turned so that the larger limit is positive. The result is moved so that its
    front looks towards -y, it stands on z = 0 and is centred in x; a file that is so already
    is not touched. Without `aomgen:handle_point` the handle is guessed (`guess_handle`).

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
    joint, moving_bodies, bodies = _find_joint(stage, to_metric, unit, path)
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
    )
    asset = _with_handle(asset, stage, to_metric)
    T = _canonical_transform(asset)
    return asset if np.allclose(T, np.eye(4), atol=1e-6) else asset.transformed(T)


def _find_joint(
    stage: Any, to_metric: Array, unit: float, path: Path
) -> tuple[Joint, frozenset[str], frozenset[str]]:
    """The single revolute or prismatic joint of a stage, and the prim paths of the bodies that move and of all.

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
    joint = _metric_joint(stage, prim, child, bodies, to_metric, unit, path)
    return joint, frozenset(_fixed_to(bodies[child], prims)), frozenset(rigid)


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


def _root_attribute(stage: Any, name: str) -> Any | None:
    root = stage.GetDefaultPrim()
    attribute = root.GetAttribute(f"{NAMESPACE}:{name}") if root else None
    return attribute.Get() if attribute else None


def _with_handle(asset: ArticulatedAsset, stage: Any, to_metric: Array) -> ArticulatedAsset:
    from pxr import UsdGeom

    point, axis = _root_attribute(stage, "handle_point"), _root_attribute(stage, "handle_axis")
    if point is None or axis is None:
        guessed, direction = guess_handle(asset.moving, asset.joint)
        return replace(asset, handle_point=guessed, handle_axis=direction)
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetDefaultPrim())).T
    place = to_metric @ matrix
    direction = place[:3, :3] @ np.array(axis, np.float64)
    return replace(
        asset,
        handle_point=apply(place, np.array(point, np.float64)),
        handle_axis=direction / np.linalg.norm(direction),
    )


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
    rng = np.random.default_rng(0)
    meshes = named or link.meshes
    share = max(1, SAMPLES // len(meshes))
    points = np.concatenate([sample_surface(mesh.vertices, mesh.faces, share, rng)[0] for mesh in meshes])
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


def _canonical_transform(asset: ArticulatedAsset) -> Array:
    """Rigid transform (4, 4) to the asset frame: front towards -y, on z = 0, centred in x and y.

    The front is turned by whole quarter turns, as files are drawn along their axes; a part that
    opens upwards (a lid) keeps its heading. Where the file names its handle, the face that
    carries it is the front. An asset that stands so already gives the identity.
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
    return transform(R, offset)
