"""Add assets to MuJoCo models: bodies, box colliders, textured meshes, assumed joint resistance and friction."""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import JointType
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import apply, quat_from_matrix
from aomgen.io.images import resize

# Gravity of MuJoCo's default options, [m/s^2].
GRAVITY: Final = 9.81
# Inertia added to the joint, which keeps the simulation of light doors stable, [kg m^2] or [kg].
ARMATURE: Final = 0.005
# Sliding [1], torsional and rolling [m] friction coefficients of the colliders, for plastic on rubber pads.
CONTACT_FRICTION: Final = (0.8, 0.01, 0.0005)
# Ratio of a friction hinge's torque to the largest torque of the weight, so that a lid stays at every angle.
HOLDS: Final = 1.3
# Solver impedance of dry friction under load; with MuJoCo's default, a loaded joint creeps by degrees per second.
HOLDING_SOLIMP: Final = (0.9999, 0.9999, 0.001, 0.5, 2.0)
# A smaller load is attributed to the rounding of the joint axis in a file, [N m] or [N].
NO_LOAD: Final = 1e-3
# MuJoCo's usual geom groups: group 2 is visible, group 3 holds hidden collision geoms.
VISUAL_GROUP, COLLIDER_GROUP = 2, 3
# Alpha of a material's color; MuJoCo uses the alpha channel of a texture only if it is below 1.
BLENDED: Final = 0.99


# Nominal, low and high resistance of an object's joint: damping [N m s/rad] or [N s/m], and dry friction in addition to
# `holding_friction`, [N m] or [N]. The nominal run gives the states of an episode, and its values are written to USD files.
# Empty drawers and new hinges have low resistance; a loaded drawer takes about 20 N, a stiff oven or microwave 1 to 2 N m.
RESISTANCES: Final[dict[JointType, tuple[tuple[float, float], ...]]] = {
    "revolute": ((0.3, 0.15), (0.02, 0.02), (2.0, 1.5)),
    "prismatic": ((4.0, 2.0), (1.0, 0.3), (30.0, 15.0)),
}


def holding_friction(asset: ArticulatedAsset) -> float:
    """Compute the dry friction that keeps the moving link in place against its weight, [N m] or [N].

    The value is sufficient over the whole range of the joint; it is 0 for vertical hinges and horizontal slides. The z
    axis of the asset is assumed to be vertical.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class AssetNames:
    """Names of the elements that `add_asset` adds to an MjSpec.

    Attributes:
        static_body, moving_body: Bodies; the frames of both are the asset frame at joint value 0.
        joint: The passive joint, positive in the opening direction.
        free_joint: Free joint of the whole object; empty if the object is fixed to the world.
        static_geoms, moving_geoms: Box colliders, including the handle.
    """

    static_body: str = "object_static"
    moving_body: str = "object_moving"
    joint: str = "object_joint"
    free_joint: str
    static_geoms: tuple[str, ...]
    moving_geoms: tuple[str, ...]

    @property
    def handle_geoms(self) -> tuple[str, ...]:
        """Names of the moving colliders that belong to the handle."""
        return tuple(name for name in self.moving_geoms if name.startswith(f"{self.moving_body}_handle"))


def add_asset(
    spec: mujoco.MjSpec,
    asset: ArticulatedAsset,
    T_world_asset: ArrayLike,
    *,
    damping: float,
    frictionloss: float,
    visual: bool = False,
    bolted: bool = True,
) -> AssetNames:
    """Add an asset with a passive joint to a model specification that uses radians.

    Contacts between the two links are excluded explicitly, because MuJoCo's filter of parents does not apply to links
    that are fixed to the world. Colliders are in geom group 3.

    Args:
        spec: Model specification, changed in place.
        asset: Asset to be added.
        T_world_asset: Pose of the asset frame (4, 4).
        damping: Damping of the joint, [N m s/rad] or [N s/m].
        frictionloss: Dry friction of the joint in addition to `holding_friction`, [N m] or [N].
        visual: Also add the visual meshes (group 2, no contacts).
        bolted: Fix the static link to the world; otherwise it gets a free joint.

    Returns:
        Names of the added elements.

    Raises:
        ValueError: `spec` uses degrees; a programming error.
    """
    if spec.compiler.degree:
        raise ValueError("spec.compiler.degree must be False before an asset is added")
    T = np.asarray(T_world_asset, np.float64)
    static = spec.worldbody.add_body(name="object_static", pos=T[:3, 3], quat=quat_from_matrix(T[:3, :3]))
    free_joint = "" if bolted else "object_free"
    if free_joint:
        static.add_freejoint(name=free_joint)
    moving = static.add_body(name="object_moving")
    _add_joint(moving, asset, "object_joint", damping, frictionloss)
    names = AssetNames(
        free_joint=free_joint,
        static_geoms=_add_colliders(static, asset.static),
        moving_geoms=_add_colliders(moving, asset.moving),
    )
    spec.add_exclude(name="object_exclude", bodyname1=names.static_body, bodyname2=names.moving_body)
    for body, link in ((static, asset.static), (moving, asset.moving)):
        for mesh in link.meshes if visual else ():
            add_visual_mesh(spec, body, mesh, f"{body.name}_visual_{mesh.name}")
    return names


def add_visual_mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, mesh: Mesh, name: str) -> None:
    """Add one textured mesh without contacts or mass to a body; vertices are in the body frame."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    texture = _color_texture(mesh)
    textured = texture.size > 0
    coordinates = {}
    if textured:
        # MuJoCo's v points down.
        flat = np.stack([mesh.uvs[..., 0], 1.0 - mesh.uvs[..., 1]], -1).reshape(-1, 2)
        coordinates = {"usertexcoord": flat.ravel().astype(np.float32)}
    item = spec.add_mesh(
        name=name, uservert=corners.ravel(), userface=faces.ravel().astype(np.int32), **coordinates
    )
    item.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    opacity = BLENDED if "opacity" in mesh.maps else mesh.opacity
    material = spec.add_material(name=name, rgba=[*([1, 1, 1] if textured else mesh.color_srgb), opacity])
    material.specular = float(0.15 + 0.35 * mesh.metallic)
    material.shininess = float(1.0 - mesh.roughness) * 0.6
    material.metallic, material.roughness = mesh.metallic, mesh.roughness
    if textured:
        height, width, channels = texture.shape
        kind = mujoco.mjtTexture.mjTEXTURE_2D
        image = spec.add_texture(name=name, type=kind, width=width, height=height, nchannel=channels)
        image.data = np.ascontiguousarray(texture).tobytes()
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    add_visual_geom(body, name)


def _color_texture(mesh: Mesh) -> NDArray[np.uint8]:
    """Return the texture (H, W, 3), (H, W, 4) if there is an opacity map, or an empty one without texture and map."""
    opacity = mesh.maps.get("opacity")
    if opacity is None:
        return mesh.texture_srgb
    height, width = np.maximum(mesh.texture_srgb.shape[:2], opacity.shape)
    plain = np.round(255 * mesh.color_srgb).astype(np.uint8).reshape(1, 1, 3)
    color = mesh.texture_srgb if mesh.texture_srgb.size else plain
    return np.dstack([resize(np.ascontiguousarray(image), width, height) for image in (color, opacity)])


def add_visual_geom(body: mujoco.MjsBody, name: str) -> None:
    """Add a visual geom with the mesh and the material of this name to a body, without contacts or mass."""
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name,
        contype=0, conaffinity=0, group=VISUAL_GROUP, mass=0.0,
    )  # fmt: skip


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


def _add_colliders(body: mujoco.MjsBody, link: AssetLink) -> tuple[str, ...]:
    """Add box geoms among which the link's mass is distributed by volume; return their names."""
    volumes = np.array([box.half_extents.prod() for box in link.colliders])
    for box, share in zip(link.colliders, volumes / volumes.sum(), strict=True):
        body.add_geom(
            name=f"{body.name}_{box.name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.T_asset_box[:3, 3],
            quat=quat_from_matrix(box.T_asset_box[:3, :3]),
            size=box.half_extents,
            mass=float(link.mass * share),
            friction=CONTACT_FRICTION,
            group=COLLIDER_GROUP,
        )
    return tuple(f"{body.name}_{box.name}" for box in link.colliders)
