"""Read articulated objects in URDF and MJCF, with meshes, colors and textures, by MuJoCo."""

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

# Number of folder levels above a model's folder that may hold its meshes: `../meshes` or `package://cabinet/meshes`.
ROOT_LEVELS: Final = 2
SUFFIXES = (".urdf", ".xml", ".mjcf")
_COLOR_ROLES = [mujoco.mjtTextureRole.mjTEXROLE_RGB.value, mujoco.mjtTextureRole.mjTEXROLE_RGBA.value]
_OPENING = (mujoco.mjtJoint.mjJNT_HINGE.value, mujoco.mjtJoint.mjJNT_SLIDE.value)


def read_mjcf_model(
    path: Path, joint_name: str, *, scale: float = 1.0, limited: bool = True
) -> ArticulatedAsset:
    """Read an object in the pose and frame of its file, without a handle; see `normalization.complete`.

    The colliders of a link are boxes that cover the collision geoms of the file; without such geoms, the link has no
    colliders.

    Args:
        path: URDF or MJCF file.
        joint_name: Name of the joint that moves; may be empty if there is only one.
        scale: Factor on all lengths; masses follow the volume.
        limited: Refuse a joint without limits; otherwise such a joint gets the placeholder limits 0 .. 1.

    Raises:
        InputError: The file or a file it refers to cannot be used; the subclass states the reason.
        AssetError: There is no joint, no joint of that name or no choice among several; a link has no meshes; the joint
            has no limits.
    """
    xml = read_robot_xml(path, model_root(path))
    spec = parse_spec(xml)
    spec.compiler.boundmass, spec.compiler.boundinertia = LEAST_MASS, LEAST_INERTIA
    # MuJoCo requires a convex hull for collision meshes, which flat meshes do not have. The model is not simulated, so
    # contacts are disabled, and the priority marks the collision geoms.
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
        static=_link(model, data, ~moved, seen, "static", scale, path),
        moving=_link(model, data, moved, seen, "moving", scale, path),
        joint=_joint(model, data, number, path, limited).move(np.diag([scale] * 3 + [1.0])),
        handle_point=np.zeros(3),
        handle_axis=np.array([0.0, 0.0, 1.0]),
    )


def model_root(path: Path) -> Path:
    """Return the folder that must contain all files to which a model refers.

    It is up to two levels above the model's folder, as ROS packages require, but never the file system's root or a
    user's home folder.
    """
    folder = path.resolve().parent
    for _ in range(ROOT_LEVELS):
        if folder.parent in (Path(folder.anchor), Path.home()):
            break
        folder = folder.parent
    return folder


def _joint_name(model: mujoco.MjModel, number: int) -> str:
    """Return the name of a joint, or of the body that it moves if the joint has no name."""
    return model.joint(number).name or model.body(int(model.jnt_bodyid[number])).name or f"joint_{number}"


def _descendants(model: mujoco.MjModel, body: int) -> NDArray[np.bool_]:
    """Return the mask (B,) of a body and its descendants."""
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
    scale: float,
    path: Path,
) -> AssetLink:
    """Build a link from the visible geoms and collision geoms of some bodies, world frame, scaled."""
    mine = bodies[model.geom_bodyid]
    colliding = model.geom_priority > 0
    meshes = [_mesh(model, data, int(geom), scale) for geom in np.flatnonzero(mine & seen)]
    if not meshes:
        raise AssetError(
            path, f"has no visible meshes on its {name} link", "check which bodies the joint moves"
        )
    colliders: list[BoxCollider] = []
    for geom in np.flatnonzero(mine & colliding):
        colliders += _boxes(model, data, int(geom), scale)
    mass = scale**3 * float(model.body_mass[bodies].sum())
    return AssetLink(name=name, meshes=tuple(meshes), colliders=tuple(colliders), mass=mass)


def _boxes(model: mujoco.MjModel, data: mujoco.MjData, geom: int, scale: float) -> list[BoxCollider]:
    """Cover a scaled collision geom with boxes; a box geom is used as it is."""
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_BOX:
        return box_cover([_mesh(model, data, geom, scale)])
    pose = transform(data.geom_xmat[geom].reshape(3, 3), scale * data.geom_xpos[geom])
    half = scale * model.geom_size[geom]
    return [BoxCollider(name=_geom_name(model, geom), T_asset_box=pose, half_extents=half)]


def _geom_name(model: mujoco.MjModel, geom: int) -> str:
    """Combine the name of a geom's body, which may be the only one named handle, with that of the geom or its mesh."""
    number = int(model.geom_dataid[geom])
    meshed = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
    own = model.geom(geom).name or (model.mesh(number).name if meshed else "") or f"geom_{geom}"
    return "_".join(filter(None, [model.body(int(model.geom_bodyid[geom])).name, own]))


def _seen(model: mujoco.MjModel, urdf: bool) -> NDArray[np.bool_]:
    """Return the mask (G,) of the geoms that are visible, including those fixed to the world.

    Collision geoms are included if their body has no visible geom, or if they share a group with visible geoms and no
    mesh represents their body.
    """
    colliding = model.geom_priority > 0
    shown = find_visible_geoms(model, colliding)
    # Some models represent a link by collision geoms only. The root link of a URDF file becomes MuJoCo's world body,
    # whereas the world body of an MJCF file holds the surroundings.
    bare = ~np.isin(model.geom_bodyid, model.geom_bodyid[shown]) & (model.geom_group < SHOWN_GROUPS)
    shown |= bare & colliding & (model.geom_rgba[:, 3] > 0) & (urdf | (model.geom_bodyid > 0))
    drawn = shown & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    beside = np.isin(model.geom_group, model.geom_group[shown & ~colliding]) & (model.geom_rgba[:, 3] > 0)
    shown |= colliding & beside & ~np.isin(model.geom_bodyid, model.geom_bodyid[drawn])
    return shown | ((model.geom_bodyid == 0) & ~colliding & (model.geom_rgba[:, 3] > 0))


def _mesh(model: mujoco.MjModel, data: mujoco.MjData, geom: int, scale: float) -> Mesh:
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
    return surface.mesh(_geom_name(model, geom), scale * apply(place, vertices), faces, uvs)


def _material(rgba: NDArray[np.float32], texture: NDArray[np.uint8]) -> Material:
    """Build a material from a color (4,), 0..1, which multiplies the texture (H, W, 3 or 4) if there is one."""
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
    """Return the color texture (H, W, 3 or 4) of a material, or the first face of a cube texture."""
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
    if model.tex_type[number] != mujoco.mjtTexture.mjTEXTURE_2D:
        pixels = pixels[:width]
    return np.ascontiguousarray(pixels if channels >= 3 else np.repeat(pixels[..., :1], 3, -1))


def _uvs(model: mujoco.MjModel, mesh: int) -> Array:
    """Return the texture coordinates (F, 3, 2) of a mesh, v up; empty if the mesh has none."""
    start, count = int(model.mesh_texcoordadr[mesh]), int(model.mesh_texcoordnum[mesh])
    if start < 0 or not count:
        return np.zeros((0, 3, 2))
    first, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    corners = model.mesh_facetexcoord[first : first + faces]
    uvs = model.mesh_texcoord[start : start + count][corners].astype(np.float64)
    return np.stack([uvs[..., 0], 1 - uvs[..., 1]], -1)
