"""Read articulated objects in OBJ, with a JSON file that states the joints and the groups that they move."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from aomgen.assets.box_cover import face_components
from aomgen.assets.normalization import choose_joint
from aomgen.assets.procedural.shapes import NO_TEXTURE, Material
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import Joint
from aomgen.core.mesh import NORMAL_MAP, Mesh
from aomgen.errors import AssetError, LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.artifact import read_json
from aomgen.io.images import opacity_of, read_image
from aomgen.io.paths import find_inside
from aomgen.io.schema import complaint

# Largest accepted OBJ file, [bytes]; this corresponds to about 3 million triangles.
MAX_BYTES = 256 << 20
# Selector of the connected components of a group on one side of a plane, for example GROUP#component:min_x<-140.
COMPONENT = "#component:min_"
# Transform from Y up to Z up (4, 4), which turns the front from +z to -y.
_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
# MTL keywords in lower case, and the material properties that they set.
_NUMBERS = {"d": "opacity", "pr": "roughness", "pm": "metallic"}
_MAPS = {"map_d": "opacity", "map_pr": "roughness", "map_pm": "metallic", "norm": NORMAL_MAP}
Three = Annotated[tuple[FiniteFloat, ...], Field(min_length=3, max_length=3)]


class JointEntry(BaseModel):
    """A joint in the coordinates of the OBJ file; the pose in the file is joint value 0."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    name: str
    type: Literal["revolute", "prismatic"]
    groups: tuple[str, ...]
    axis: Three
    origin: Three = (0.0, 0.0, 0.0)
    lower: FiniteFloat | None = None
    upper: FiniteFloat | None = None
    lower_deg: FiniteFloat | None = None
    upper_deg: FiniteFloat | None = None

    def limits(self) -> tuple[float, float] | None:
        """Return the lower and upper limit in radians or in the file's unit of length; None if they are not given."""
        if self.type == "revolute" and self.lower_deg is not None and self.upper_deg is not None:
            return float(np.radians(self.lower_deg)), float(np.radians(self.upper_deg))
        if self.type == "prismatic" and self.lower is not None and self.upper is not None:
            return self.lower, self.upper
        return None


class ModelEntry(BaseModel):
    """Description of a model with Y up and its front toward +z."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    category: str = "object"
    creator: str = ""
    license: str = ""
    unit_to_m: FiniteFloat = 1.0
    joints: tuple[JointEntry, ...]


def read_obj_model(path: Path, joints_file: Path, joint_name: str) -> ArticulatedAsset:
    """Read an object in the pose of its file, Z up, in meters, without colliders and handle; see `normalization.complete`.

    Args:
        path: OBJ file.
        joints_file: JSON file that describes its joints.
        joint_name: Name of the joint that moves; may be empty if there is only one.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError, UnsafePathError: A file cannot be used.
        AssetError: The file describes no joint, no joint of that name, or several to choose from; the joint has no limits;
            its groups contain no mesh or all meshes.
    """
    entry = _entry(path, joints_file)
    item = choose_joint({joint.name: joint for joint in entry.joints}, joint_name, joints_file)
    limits = item.limits()
    if limits is None:
        want = "lower_deg and upper_deg" if item.type == "revolute" else "lower and upper"
        raise AssetError(joints_file, f"gives joint '{item.name}' no limits", f"give it {want}")
    static, moving = _split_meshes(_read_meshes(path), item.groups)
    if not moving or not static:
        missing = "moves" if static else "stands still"
        raise AssetError(joints_file, f"has groups of which nothing {missing} in {path.name}", "correct them")
    axis = np.array(item.axis) / np.linalg.norm(item.axis)
    drawn = ArticulatedAsset(
        name=path.stem if len(entry.joints) == 1 else f"{path.stem}-{item.name}",
        category=entry.category,
        static=AssetLink(name="static", meshes=tuple(static), colliders=(), mass=0.0),
        moving=AssetLink(name="moving", meshes=tuple(moving), colliders=(), mass=0.0),
        joint=Joint(
            type=item.type, axis=axis, origin=np.array(item.origin), lower=limits[0], upper=limits[1]
        ),
        handle_point=np.zeros(3),
        handle_axis=np.array([0.0, 0.0, 1.0]),
        credit=", ".join(filter(None, [entry.creator, entry.license])),
    )
    return drawn.transform(_Z_UP @ np.diag([entry.unit_to_m] * 3 + [1.0]))


def _entry(path: Path, joints_file: Path) -> ModelEntry:
    """Read the description of a model: the entry of `models` that names its folder or file, or the whole file."""
    data: Any = read_json(joints_file)
    if isinstance(data, dict) and "models" in data:
        models = data["models"]
        folder = path.resolve().parent
        names = [n for n in models if (joints_file.resolve().parent / n) in (folder, path.resolve())]
        if not names:
            raise AssetError(
                joints_file, f"does not describe {path.name}", f"it describes {', '.join(models)}"
            )
        data = models[names[0]]
    try:
        return ModelEntry.model_validate(data)
    except ValidationError as error:
        raise MalformedFileError(joints_file, *complaint(error, ModelEntry)) from error


def _read_meshes(path: Path) -> list[Mesh]:
    """Read one mesh for every material of every group, in the coordinates of the file."""
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the path of the asset")
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"is larger than {MAX_BYTES} bytes")
    textures = _find_textures(path)
    try:
        scene = trimesh.load_scene(path, split_objects=True, split_groups=True, process=False)
    except (ValueError, IndexError, KeyError, NotImplementedError) as error:
        raise MalformedFileError(path, f"is not an OBJ file ({error})", "export it again") from error
    meshes = [
        _mesh(name, item, textures)
        for name, item in scene.geometry.items()
        if isinstance(item, trimesh.Trimesh)
    ]
    if not meshes:
        raise MalformedFileError(path, "has no triangles", "export it again")
    return meshes


def _find_textures(path: Path) -> dict[str, Path]:
    """Find the files of all textures, by the last word of the statement that names them.

    Raises:
        UnsafePathError, MissingFileError: A material or texture file is outside the folder or missing; trimesh ignores
            such files.
    """
    folder, found = path.parent, dict[str, Path]()
    for library in _read_names(path, "mtllib"):
        file = find_inside(folder, [folder], [library], named_by=path)
        for texture in [name for keyword in ("map_", "norm") for name in _read_names(file, keyword)]:
            last = texture.split()[-1]
            found[last] = find_inside(folder, [folder], [texture, last], named_by=file)
    return found


def _read_names(path: Path, keyword: str) -> list[str]:
    """List the arguments of all lines that begin with a keyword."""
    lines = [line.split(None, 1) for line in path.read_text("utf-8", errors="replace").splitlines()]
    return [words[1].strip() for words in lines if len(words) > 1 and words[0].startswith(keyword)]


def _split_meshes(meshes: list[Mesh], groups: tuple[str, ...]) -> tuple[list[Mesh], list[Mesh]]:
    """Split meshes into static and moving ones; meshes move if their names begin with one of the groups."""
    static, moving = [], []
    for mesh in meshes:
        whole = [group for group in groups if COMPONENT not in group and mesh.name.startswith(group)]
        parts = [
            group for group in groups if COMPONENT in group and mesh.name.startswith(group.split("#")[0])
        ]
        if whole or not parts:
            (moving if whole else static).append(mesh)
            continue
        condition = parts[0].split(COMPONENT)[1]
        axis, limit = "xyz".index(condition[0]), float(condition[2:])
        owners, lowest = face_components(mesh), mesh.vertices[mesh.faces][..., axis].min(1)
        lows = np.full(owners.max() + 1, np.inf)
        np.minimum.at(lows, owners, lowest)
        lows = lows[owners]
        for part, chosen in ((static, lows >= limit), (moving, lows < limit)):
            if chosen.any():
                part.append(_with_faces(mesh, chosen))
    return static, moving


def _with_faces(mesh: Mesh, chosen: NDArray[np.bool_]) -> Mesh:
    used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    uvs = mesh.uvs[chosen] if len(mesh.uvs) else mesh.uvs
    return replace(mesh, vertices=mesh.vertices[used], faces=faces.reshape(-1, 3), uvs=uvs)


def _mesh(name: str, item: trimesh.Trimesh, textures: dict[str, Path]) -> Mesh:
    used, faces = np.unique(item.faces, return_inverse=True)
    material, uv = getattr(item.visual, "material", None), getattr(item.visual, "uv", None)
    image = getattr(material, "image", None)
    color = np.array(getattr(material, "diffuse", (128, 128, 128, 255)), np.float64)[:3] / 255
    surface = Material(
        texture_srgb=NO_TEXTURE if image is None or uv is None else np.asarray(image.convert("RGB")),
        color_srgb=(color[0], color[1], color[2]),
        **_read_values(getattr(material, "kwargs", {}), textures),
    )
    uvs = np.zeros((0, 3, 2)) if uv is None else np.asarray(uv, np.float64)[item.faces]
    return surface.mesh(name, np.asarray(item.vertices, np.float64)[used], faces.reshape(-1, 3), uvs)


def _read_values(statements: Mapping[str, list[str]], textures: dict[str, Path]) -> dict[str, Any]:
    """Convert MTL statements (words by keyword) to arguments of a `Material`: opacity, roughness, metallic and maps."""
    values: dict[str, Any] = {"maps": {}}
    for keyword, name in _NUMBERS.items():
        if keyword in statements:
            values[name] = _number(keyword, statements[keyword][-1])
    if "tr" in statements and "d" not in statements:
        values["opacity"] = 1 - _number("tr", statements["tr"][-1])
    for keyword, name in _MAPS.items():
        if keyword in statements:
            image = read_image(textures[statements[keyword][-1]], "RGBA")
            picked = {"opacity": opacity_of(image), NORMAL_MAP: image[..., :3]}
            values["maps"][name] = picked.get(name, image[..., 0])
    return values


def _number(keyword: str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not 0 <= value <= 1:
        raise MalformedFileError(f"{keyword} {word}", "is not a number from 0 to 1", "correct the MTL file")
    return value
