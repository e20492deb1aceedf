"""Articulated objects in URDF and MJCF: MuJoCo reads them, with their meshes, colors and textures."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.box_cover import box_cover
from aomgen.assets.normalization import choose_joint
from aomgen.assets.procedural.shapes import NO_TEXTURE, Material
from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import apply, matrix_from_quat, transform
from aomgen.core.values import Array
from aomgen.errors import AssetError
from aomgen.io.geom_surface import SHOWN_GROUPS, find_visible_geoms, geom_surface
from aomgen.io.mujoco_model import LEAST_INERTIA, LEAST_MASS, compile_model, parse_spec, read_robot_xml

# Folders above a model's own that may hold its meshes: `../meshes`, `package://cabinet/meshes` from `cabinet/urdf`.
ROOT_LEVELS: Final = 2
SUFFIXES = (".urdf", ".xml", ".mjcf")
_COLOR_ROLES = [mujoco.mjtTextureRole.mjTEXROLE_RGB.value, mujoco.mjtTextureRole.mjTEXROLE_RGBA.value]
_OPENING = (mujoco.mjtJoint.mjJNT_HINGE.value, mujoco.mjtJoint.mjJNT_SLIDE.value)


def read_mjcf_model(path: Path, joint_name: str, *, limited: bool = True) -> ArticulatedAsset:
    """Read the object of a file as it is modelled: neither closed, nor turned, nor with a handle.

    Links have boxes that cover the colliding shapes of the file, and none without such shapes.

    Args:
        limited: Refuse a joint without limits; otherwise it gets 0 .. 1, to be replaced.

    Raises:
        InputError: The file or what it names cannot be used; of the kind that fits.
        AssetError: No joint, or several and none named; a link without meshes; no limits.
    """
    xml = read_robot_xml(path, model_root(path))
    spec = parse_spec(xml)
    spec.compiler.boundmass, spec.compiler.boundinertia = LEAST_MASS, LEAST_INERTIA
    # Flat collision meshes have no hull, which MuJoCo would insist on; nothing is simulated here.
    for geom in spec.geoms:
        geom.priority = int(bool(geom.contype or geom.conaffinity))
        geom.contype = geom.conaffinity = 0
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    model = compile_model(spec, path)
    hinges = {_joint_name(model, k): k for k in range(model.njnt) if model.jnt_type[k] in _OPENING}
    number = choose_joint(hinges, joint_name, path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    moved = _descendants(model, int(model.jnt_bodyid[number]))
    seen = _seen(model, xml.kind == "urdf")
    return ArticulatedAsset(
        name=xml.name if len(hinges) == 1 else f"{xml.name}-{_joint_name(model, number)}",
        category=xml.name,
        static=_link(model, data, ~moved, seen, "static", path),
        moving=_link(model, data, moved, seen, "moving", path),
        joint=_joint(model, data, number, path, limited),
        handle_point=np.zeros(3),
        handle_axis=np.array([0.0, 0.0, 1.0]),
    )


def model_root(path: Path) -> Path:
    """The folder that must contain all files that a model names: two above its own, as packages are organized.

    It is never the root of the disk or a user's home.
    """
    folder = path.resolve().parent
    for _ in range(ROOT_LEVELS):
        if folder.parent in (Path(folder.anchor), Path.home()):
            break
        folder = folder.parent
    return folder


def _joint_name(model: mujoco.MjModel, number: int) -> str:
    """Name of the joint, or else of the body that it moves."""
    return model.joint(number).name or model.body(int(model.jnt_bodyid[number])).name or f"joint_{number}"


def _descendants(model: mujoco.MjModel, body: int) -> NDArray[np.bool_]:
    """Mask (B,) of a body and its descendants."""
    found = np.arange(model.nbody) == body
    for number in range(body + 1, model.nbody):
        found[number] = found[model.body_parentid[number]]
    return found


def _joint(model: mujoco.MjModel, data: mujoco.MjData, number: int, path: Path, limited: bool) -> Joint:
    lower, upper = model.jnt_range[number].tolist()
    if not (model.jnt_limited[number] and lower < upper):
        if limited:
            raise AssetError(
                path,
                f"has no limits at joint '{_joint_name(model, number)}'",
                "state its limits: --limits 0 1.57 (rad or m)",
            )
        lower, upper = 0.0, 1.0
    start = float(model.qpos0[model.jnt_qposadr[number]])
    return Joint(
        type="revolute" if model.jnt_type[number] == _OPENING[0] else "prismatic",
        axis=data.xaxis[number],
        origin=data.xanchor[number],
        lower=lower - start,
        upper=upper - start,
    )


def _link(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    bodies: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    name: str,
    path: Path,
) -> AssetLink:
    """Build a link from the visible and colliding shapes of some bodies, world frame."""
    mine = bodies[model.geom_bodyid]
    colliding = model.geom_priority > 0
    meshes = [_mesh(model, data, int(geom)) for geom in np.flatnonzero(mine & seen)]
    if not meshes:
        raise AssetError(
            path, f"has no visible meshes on its {name} link", "check which bodies the joint moves"
        )
    colliders: list[BoxCollider] = []
    for geom in np.flatnonzero(mine & colliding):
        colliders += _boxes(model, data, int(geom))
    mass = float(model.body_mass[bodies].sum())
    return AssetLink(name=name, meshes=_make_names_unique(meshes), colliders=tuple(colliders), mass=mass)


def _boxes(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> list[BoxCollider]:
    """Boxes that cover a colliding shape, the shape itself where it is one."""
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_BOX:
        return box_cover([_mesh(model, data, geom)])
    pose = transform(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom])
    return [BoxCollider(name=_geom_name(model, geom), T_asset_box=pose, half_extents=model.geom_size[geom])]


def _geom_name(model: mujoco.MjModel, geom: int) -> str:
    """Name of the shape or its mesh, after that of its body, as sometimes only the body is named handle."""
    number = int(model.geom_dataid[geom])
    meshed = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
    own = model.geom(geom).name or (model.mesh(number).name if meshed else "") or f"geom_{geom}"
    return "_".join(filter(None, [model.body(int(model.geom_bodyid[geom])).name, own]))


def _seen(model: mujoco.MjModel, urdf: bool) -> NDArray[np.bool_]:
    """Mask of the visible geoms, also of those fixed to the world, and of colliding shapes in addition to
    visible ones of the same group, unless meshes represent the body.
    """
    colliding = model.geom_priority > 0
    shown = find_visible_geoms(model, colliding)
    # Some makers draw a link by its collision shapes alone. The root of a URDF is MuJoCo's world, that of an MJCF
    # holds the room.
    bare = ~np.isin(model.geom_bodyid, model.geom_bodyid[shown]) & (model.geom_group < SHOWN_GROUPS)
    shown |= bare & colliding & (model.geom_rgba[:, 3] > 0) & (urdf | (model.geom_bodyid > 0))
    drawn = shown & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    beside = np.isin(model.geom_group, model.geom_group[shown & ~colliding]) & (model.geom_rgba[:, 3] > 0)
    shown |= colliding & beside & ~np.isin(model.geom_bodyid, model.geom_bodyid[drawn])
    return shown | ((model.geom_bodyid == 0) & ~colliding & (model.geom_rgba[:, 3] > 0))


def _make_names_unique(meshes: list[Mesh]) -> tuple[Mesh, ...]:
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
    uvs = _uvs(model, number) if meshed else np.zeros((0, 3, 2))
    surface = _material(rgba, _texture(model, material))
    return surface.mesh(_geom_name(model, geom), apply(place, vertices), faces, uvs)


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
