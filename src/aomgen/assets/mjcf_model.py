"""Articulated objects in URDF and MJCF: MuJoCo reads them, with their meshes, colors and textures."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.normalization import choose_joint
from aomgen.assets.procedural.shapes import NO_TEXTURE, Material
from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import apply, matrix_from_quat, transform
from aomgen.core.values import Array
from aomgen.errors import AssetError
from aomgen.io.geom_surface import find_visible_geoms, geom_surface
from aomgen.io.mujoco_model import LEAST_INERTIA, LEAST_MASS, compile_model, parse_spec
from aomgen.io.robot_xml import read_robot_xml

SUFFIXES = (".urdf", ".xml", ".mjcf")
_COLOR_ROLES = [mujoco.mjtTextureRole.mjTEXROLE_RGB.value, mujoco.mjtTextureRole.mjTEXROLE_RGBA.value]
_OPENING = (mujoco.mjtJoint.mjJNT_HINGE.value, mujoco.mjtJoint.mjJNT_SLIDE.value)


def read_mjcf_model(path: Path, joint_name: str) -> ArticulatedAsset:
    """The object of a file as it is drawn: neither closed, nor turned, nor with a handle.

    Links have the boxes that collide in the file, and none where other shapes do.

    Raises:
        InputError: The file or what it names cannot be used; of the kind that fits.
        AssetError: No joint, or several and none named; a link without meshes; no limits.
    """
    xml = read_robot_xml(path, path.parent)
    spec = parse_spec(xml)
    # Makers give masses to collision shapes alone, or to nothing.
    spec.compiler.inertiagrouprange = [0, 5]
    spec.compiler.boundmass, spec.compiler.boundinertia = LEAST_MASS, LEAST_INERTIA
    model = compile_model(spec, path)
    hinges = {model.joint(k).name: k for k in range(model.njnt) if model.jnt_type[k] in _OPENING}
    number = choose_joint(hinges, joint_name, path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    moved = _descendants(model, int(model.jnt_bodyid[number]))
    return ArticulatedAsset(
        name=xml.name if len(hinges) == 1 else f"{xml.name}-{model.joint(number).name}",
        category=xml.name,
        static=_link(model, data, ~moved, "static", path),
        moving=_link(model, data, moved, "moving", path),
        joint=_joint(model, data, number, path),
        handle_point=np.zeros(3),
        handle_axis=np.array([0.0, 0.0, 1.0]),
    )


def _descendants(model: mujoco.MjModel, body: int) -> NDArray[np.bool_]:
    """Which bodies (B,) hang on a body, itself included."""
    found = np.arange(model.nbody) == body
    for number in range(body + 1, model.nbody):
        found[number] = found[model.body_parentid[number]]
    return found


def _joint(model: mujoco.MjModel, data: mujoco.MjData, number: int, path: Path) -> Joint:
    lower, upper = model.jnt_range[number].tolist()
    if not (model.jnt_limited[number] and lower < upper):
        raise AssetError(path, f"has no limits at joint '{model.joint(number).name}'", "give it a range")
    start = float(model.qpos0[model.jnt_qposadr[number]])
    return Joint(
        type="revolute" if model.jnt_type[number] == _OPENING[0] else "prismatic",
        axis=data.xaxis[number],
        origin=data.xanchor[number],
        lower=lower - start,
        upper=upper - start,
    )


def _link(
    model: mujoco.MjModel, data: mujoco.MjData, bodies: NDArray[np.bool_], name: str, path: Path
) -> AssetLink:
    """What of the visible and colliding shapes belongs to some bodies, world frame."""
    mine = bodies[model.geom_bodyid]
    colliding = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    boxes = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    meshes = [_mesh(model, data, int(geom)) for geom in np.flatnonzero(mine & _seen(model))]
    if not meshes:
        raise AssetError(
            path, f"has no visible meshes on its {name} link", "check which bodies the joint moves"
        )
    only_boxes = boxes[mine & colliding].all()
    colliders = [
        BoxCollider(
            name=f"collider_{geom}",
            T_asset_box=transform(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]),
            half_extents=model.geom_size[geom],
        )
        for geom in np.flatnonzero(mine & colliding & boxes)
    ]
    mass = float(model.body_mass[bodies].sum())
    return AssetLink(
        name=name, meshes=_numbered(meshes), colliders=tuple(colliders if only_boxes else ()), mass=mass
    )


def _seen(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Also what a file fixes to the world: an object's body is often part of it."""
    shown = find_visible_geoms(model)
    return shown | ((model.geom_bodyid == 0) & (model.geom_contype == 0) & (model.geom_rgba[:, 3] > 0))


def _numbered(meshes: list[Mesh]) -> tuple[Mesh, ...]:
    """Every name once."""
    names = Counter[str]()
    found = []
    for mesh in meshes:
        names[mesh.name] += 1
        suffix = f"_{names[mesh.name]}" if names[mesh.name] > 1 else ""
        found.append(replace(mesh, name=mesh.name + suffix))
    return tuple(found)


def _mesh(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Mesh:
    material, number = int(model.geom_matid[geom]), int(model.geom_dataid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    surface = geom_surface(model, geom)
    if surface is None:
        raise AssetError(model.geom(geom).name or f"geom {geom}", "is a plane or height field", "use a mesh")
    vertices, faces = surface
    body = int(model.geom_bodyid[geom])
    place = transform(matrix_from_quat(data.xquat[body]), data.xpos[body])
    meshed = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
    name = model.mesh(number).name if meshed else model.geom(geom).name
    uvs = _uvs(model, number) if meshed else np.zeros((0, 3, 2))
    surface = _material(rgba, _texture(model, material))
    return surface.mesh(name or f"geom_{geom}", apply(place, vertices), faces, uvs)


def _material(rgba: NDArray[np.float32], texture: NDArray[np.uint8]) -> Material:
    """A color (4,), 0..1, which multiplies a texture (H, W, 3 or 4) if there is one."""
    if not texture.size:
        r, g, b, opacity = np.clip(rgba, 0, 1).tolist()
        return Material(color_srgb=(r, g, b), opacity=opacity)
    channels = texture.shape[-1]
    pixels = (texture * np.clip(rgba[:channels], 0, 1)).round().astype(np.uint8)
    opacity = float(np.clip(rgba[3], 0, 1))
    if channels == 4 and pixels[..., 3].min() < 255:
        return Material(texture_srgb=pixels[..., :3], maps={"opacity": pixels[..., 3]})
    return Material(texture_srgb=pixels[..., :3], opacity=opacity)


def _texture(model: mujoco.MjModel, material: int) -> NDArray[np.uint8]:
    """The color texture (H, W, 3 or 4) of a material; of a cube its first face."""
    if material < 0:
        return NO_TEXTURE
    number = int(model.mat_texid[material, _COLOR_ROLES].max())
    if number < 0:
        return NO_TEXTURE
    width, height, channels = (
        int(a[number]) for a in (model.tex_width, model.tex_height, model.tex_nchannel)
    )
    start = int(model.tex_adr[number])
    pixels = model.tex_data[start : start + width * height * channels].reshape(height, width, channels)
    color = pixels[:width] if channels >= 3 else np.repeat(pixels[:width, :, :1], 3, -1)
    return np.ascontiguousarray(color)


def _uvs(model: mujoco.MjModel, mesh: int) -> Array:
    """Texture coordinates (F, 3, 2), v up; empty where the mesh has none."""
    start, count = int(model.mesh_texcoordadr[mesh]), int(model.mesh_texcoordnum[mesh])
    if start < 0 or not count:
        return np.zeros((0, 3, 2))
    first, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    corners = model.mesh_facetexcoord[first : first + faces]
    uvs = model.mesh_texcoord[start : start + count][corners].astype(np.float64)
    return np.stack([uvs[..., 0], 1 - uvs[..., 1]], -1)
