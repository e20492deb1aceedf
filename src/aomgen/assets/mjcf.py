"""Assets in MuJoCo: bodies, joint, box colliders and, on request, textured meshes."""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import JointType
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import apply, quat_from_matrix, transform

# Standard gravity as MuJoCo's default has it, [m/s^2].
GRAVITY: Final = 9.81
# Keeps light doors stable in the solver, [kg m^2] or [kg].
ARMATURE: Final = 0.005
# Sliding [1], torsional and rolling [m] coefficients of the colliders: plastic on rubber pads.
CONTACT_FRICTION: Final = (0.8, 0.01, 0.0005)
# A friction hinge holds a lid wherever it is left: it bears this many times its weight.
HOLDS: Final = 1.3
# MuJoCo's default dry friction creeps by degrees a second under a load; this solver impedance stands still.
HOLDING_SOLIMP: Final = (0.9999, 0.9999, 0.001, 0.5, 2.0)
# A smaller load comes from the rounding of an axis in a file, [N m] or [N].
NO_LOAD: Final = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class JointResistance:
    """Passive resistance of an object's joint in one simulated run.

    Attributes:
        name: Key in the verdict.
        damping: [N m s/rad] or [N s/m].
        frictionloss: Dry friction beyond `holding_friction`, [N m] or [N].
    """

    name: str
    damping: float
    frictionloss: float


# The first is nominal: its run gives an episode's states, and its values are written into the USD.
RESISTANCES: Final[dict[JointType, tuple[JointResistance, ...]]] = {
    "revolute": (
        JointResistance(name="nominal", damping=0.3, frictionloss=0.15),
        JointResistance(name="light", damping=0.05, frictionloss=0.02),
        JointResistance(name="heavy", damping=1.2, frictionloss=0.8),
    ),
    "prismatic": (
        JointResistance(name="nominal", damping=4.0, frictionloss=2.0),
        JointResistance(name="light", damping=1.0, frictionloss=0.3),
        JointResistance(name="heavy", damping=16.0, frictionloss=8.0),
    ),
}


def holding_friction(asset: ArticulatedAsset) -> float:
    """Dry friction that keeps the moving part where it is left, against its weight, [N m] or [N].

    Enough for every value in the joint's range; 0 for upright hinges and level slides. The
    asset stands upright.
    """
    joint, colliders = asset.joint, asset.moving.colliders
    volumes = np.array([box.half_extents.prod() for box in colliders])
    middle = volumes @ np.array([box.T_asset_box[:3, 3] for box in colliders]) / volumes.sum()
    weight = np.array([0.0, 0.0, -GRAVITY * asset.moving.mass])
    if joint.type == "prismatic":
        load = abs(float(weight @ joint.axis))
    else:
        arms = apply(joint.motion(np.linspace(joint.lower, joint.upper, 40)), middle) - joint.origin
        load = float(np.abs(np.cross(arms, weight) @ joint.axis).max())
    return HOLDS * load if load > NO_LOAD else 0.0


# MuJoCo's usual geom groups: 2 is drawn, 3 is for collision only and hidden.
COLLIDER_GROUP = 3
# See above.
VISUAL_GROUP = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class AssetNames:
    """Names of what was added to the MjSpec.

    Attributes:
        static_body, moving_body: Bodies; both frames are the asset frame at joint value 0.
        joint: The passive joint, positive in the opening direction.
        free_joint: Joint of the whole object; empty when it is bolted to the world.
        static_geoms, moving_geoms: Box colliders, handle included.
        handle_geoms: Those of the moving colliders that are handle.
        visual_geoms: Textured meshes; empty without `visual`.
    """

    static_body: str
    moving_body: str
    joint: str
    free_joint: str
    static_geoms: tuple[str, ...]
    moving_geoms: tuple[str, ...]
    handle_geoms: tuple[str, ...]
    visual_geoms: tuple[str, ...]


def add_asset(
    spec: mujoco.MjSpec,
    asset: ArticulatedAsset,
    T_world_asset: ArrayLike,
    *,
    damping: float,
    frictionloss: float,
    visual: bool = False,
    bolted: bool = True,
    prefix: str = "object_",
) -> AssetNames:
    """Add an asset with a passive joint to a model under construction.

    Args:
        spec: Receives bodies, joint, geoms, an exclude between both links (MuJoCo's own parent
            filter does not hold for links welded to the world) and, with `visual`, meshes,
            textures and materials. Must count angles in radians (`spec.compiler.degree = False`).
        asset: Closed at joint value 0.
        T_world_asset: Rigid pose (4, 4) of the asset frame.
        damping: Of the joint, [N m s/rad] or [N s/m].
        frictionloss: Dry friction of the joint beyond `holding_friction`, [N m] or [N].
        visual: Also add what is seen (group 2, no contacts). Colliders are in group 3.
        bolted: Weld the static link to the world; otherwise it gets a free joint.
        prefix: Start of every name that is added.

    Returns:
        The names that were added.

    Raises:
        ValueError: `spec` counts in degrees; a programming error.
    """
    if spec.compiler.degree:
        raise ValueError("spec.compiler.degree must be False before an asset is added")
    T = np.asarray(T_world_asset, np.float64)
    static = spec.worldbody.add_body(name=f"{prefix}static", pos=T[:3, 3], quat=quat_from_matrix(T[:3, :3]))
    free_joint = "" if bolted else f"{prefix}free"
    if free_joint:
        static.add_freejoint(name=free_joint)
    moving = static.add_body(name=f"{prefix}moving")
    _add_joint(moving, asset, f"{prefix}joint", damping, frictionloss)
    static_geoms = _add_colliders(static, asset.static, f"{prefix}static_")
    moving_geoms = _add_colliders(moving, asset.moving, f"{prefix}moving_")
    spec.add_exclude(name=f"{prefix}exclude", bodyname1=f"{prefix}static", bodyname2=f"{prefix}moving")
    visuals: tuple[str, ...] = ()
    if visual:
        for body, link, part in ((static, asset.static, "static"), (moving, asset.moving, "moving")):
            visuals += tuple(
                add_visual_mesh(spec, body, m, f"{prefix}{part}_visual_{m.name}") for m in link.meshes
            )
    return AssetNames(
        static_body=f"{prefix}static",
        moving_body=f"{prefix}moving",
        joint=f"{prefix}joint",
        free_joint=free_joint,
        static_geoms=static_geoms,
        moving_geoms=moving_geoms,
        handle_geoms=tuple(name for name in moving_geoms if name.startswith(f"{prefix}moving_handle")),
        visual_geoms=visuals,
    )


def add_visual_mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, mesh: Mesh, name: str) -> str:
    """Add one textured mesh without contacts or mass to a body; vertices are in the body frame."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    textured = mesh.texture_srgb.size > 0
    coordinates = {}
    if textured:
        # MuJoCo's v points down.
        flat = np.stack([mesh.uvs[..., 0], 1.0 - mesh.uvs[..., 1]], -1).reshape(-1, 2)
        coordinates = {"usertexcoord": flat.ravel().astype(np.float32)}
    item = spec.add_mesh(
        name=name, uservert=corners.ravel(), userface=faces.ravel().astype(np.int32), **coordinates
    )
    item.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    material = spec.add_material(name=name, rgba=[1, 1, 1, 1] if textured else [*mesh.color_srgb, 1.0])
    material.specular = float(0.15 + 0.35 * mesh.metallic)
    material.shininess = float(1.0 - mesh.roughness) * 0.6
    if textured:
        add_texture(spec, name, mesh.texture_srgb)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    add_visual_geom(body, name)
    return name


def add_visual_geom(body: mujoco.MjsBody, name: str) -> None:
    """Show the mesh and material of a name on a body, without contacts or mass."""
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        contype=0,
        conaffinity=0,
        group=VISUAL_GROUP,
        mass=0.0,
    )


def add_texture(spec: mujoco.MjSpec, name: str, texture_srgb: NDArray[np.uint8]) -> None:
    """Add a 2D texture (H, W, 3) uint8 from memory."""
    height, width, channels = texture_srgb.shape
    item = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=channels
    )
    item.data = np.ascontiguousarray(texture_srgb).tobytes()


def _add_joint(
    body: mujoco.MjsBody, asset: ArticulatedAsset, name: str, damping: float, frictionloss: float
) -> None:
    joint, holding = asset.joint, holding_friction(asset)
    hinge = joint.type == "revolute"
    item = body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE if hinge else mujoco.mjtJoint.mjJNT_SLIDE,
        pos=joint.origin,
        axis=joint.axis,
        range=[joint.lower, joint.upper],
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        damping=[damping, 0.0, 0.0],
        frictionloss=frictionloss + holding,
        armature=ARMATURE,
    )
    if holding:
        item.solimp_friction = HOLDING_SOLIMP


def _add_colliders(body: mujoco.MjsBody, link: AssetLink, prefix: str) -> tuple[str, ...]:
    """Box geoms that share the link's mass by volume."""
    volumes = np.array([box.half_extents.prod() for box in link.colliders])
    names = []
    for box, share in zip(link.colliders, volumes / volumes.sum(), strict=True):
        T = transform(box.T_asset_box[:3, :3], box.T_asset_box[:3, 3])
        body.add_geom(
            name=prefix + box.name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=T[:3, 3],
            quat=quat_from_matrix(T[:3, :3]),
            size=box.half_extents,
            mass=float(link.mass * share),
            friction=CONTACT_FRICTION,
            group=COLLIDER_GROUP,
        )
        names.append(prefix + box.name)
    return tuple(names)
