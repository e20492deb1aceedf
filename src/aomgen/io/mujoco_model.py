"""Reading of URDF and MJCF files, with checked references, into MuJoCo models."""

# MuJoCo has no type stubs, so its classes are unknown to the type checker.
# pyright: reportUnknownParameterType=false

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final, Literal
from xml.etree import ElementTree
from xml.parsers import expat

import mujoco

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.paths import find_inside

# Mass, [kg], and inertia, [kg m^2], of links without mass: less than those of any real link, but sufficient for the solver.
LEAST_MASS, LEAST_INERTIA = 1e-3, 1e-6
# Largest description that is read, [bytes]; common ones have about 100 kB.
MAX_BYTES: Final = 16 << 20
# Largest mesh of a robot, [bytes]: an STL file of more than 2 million triangles.
MAX_MESH_BYTES: Final = 128 << 20
# Largest number of files of a description with includes.
MAX_INCLUDES: Final = 64
MESH_SUFFIXES: Final = (".obj", ".stl", ".msh")
PACKAGE: Final = "package://"
# Compiler option with the folder of the files that an element refers to, by the element's tag.
FOLDER_OPTIONS: Final = {"mesh": "meshdir", "skin": "meshdir", "texture": "texturedir", "hfield": ""}


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotXml:
    """A robot description whose references have been checked.

    Attributes:
        path: File of the description.
        name: Name of the robot in the description, or that of the file if the description has none.
        kind: "urdf" or "mjcf".
        text: Text of a URDF for MuJoCo, in which each mesh is renamed to a key of `meshes`; empty for an MJCF.
        meshes: Mesh files of a URDF by their names in `text`; empty for an MJCF.
        references: All other files that the description needs.
    """

    path: Path
    name: str
    kind: Literal["urdf", "mjcf"]
    text: str
    meshes: Mapping[str, Path]
    references: tuple[Path, ...]


def read_robot_xml(path: Path, root: Path) -> RobotXml:
    """Read a URDF or MJCF and find all files that it refers to inside `root`.

    A URDF refers to a mesh by a path relative to its own file, or as `package://NAME/REST`. In the second case, REST and
    NAME/REST are searched for in the folder of the file and in the folders above it, up to `root`.

    Args:
        path: URDF or MJCF file.
        root: Folder that the references must not leave.

    Raises:
        MissingFileError: The file, or one that it refers to, is missing.
        UnsafePathError: A reference leaves `root`.
        LimitExceededError: A file is too large, or too many files are included.
        MalformedFileError: The file is not XML, is neither a URDF nor a complete MJCF, holds xacro macros, attaches other
            models, or has a mesh in a format that MuJoCo cannot read.
    """
    tree = _parse(path)
    if tree.tag == "robot":
        return _urdf(path, tree, root)
    if tree.tag == "mujoco":
        references = _mjcf_references(path, tree, root)
        name = tree.get("model") or path.stem
        return RobotXml(path=path, name=name, kind="mjcf", text="", meshes={}, references=references)
    if tree.tag == "mujocoinclude":
        raise MalformedFileError(
            path,
            "is a fragment of an MJCF",
            "write a file <mujoco> that includes it and the file of its assets",
        )
    raise MalformedFileError(path, f"is a '{tree.tag}' file", "give a URDF (<robot>) or an MJCF (<mujoco>)")


def _parse(path: Path) -> ElementTree.Element:
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check robot.urdf or robot.mjcf")
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"is larger than {MAX_BYTES} bytes")
    data = path.read_bytes()
    # XML entities can expand without limit or read other files, and no robot description needs them.
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise MalformedFileError(path, "declares a document type", "remove the DOCTYPE")
    builder = ElementTree.TreeBuilder()
    # Namespaces are not processed: many URDFs use undeclared prefixes, which other parsers accept.
    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise MalformedFileError(path, f"is not XML ({error})", "correct that line") from error
    return builder.close()


def _urdf(path: Path, tree: ElementTree.Element, root: Path) -> RobotXml:
    if any("xacro" in str(element.tag) for element in tree.iter()):
        raise MalformedFileError(path, "holds xacro macros", "expand it with `xacro FILE > robot.urdf`")
    meshes: dict[str, Path] = {}
    for mesh in tree.iter("mesh"):
        file = _urdf_file(path, mesh.get("filename", ""), root)
        _check_mesh(path, file)
        # Two folders may hold files of the same name, which MuJoCo would treat as one mesh.
        known = next((name for name, other in meshes.items() if other == file), "")
        name = known or f"m{len(meshes)}_{file.stem}{file.suffix.lower()}"
        meshes[name] = file
        mesh.set("filename", name)
    _name_once(tree)
    for own in tree.findall("mujoco"):
        tree.remove(own)
    options = ElementTree.SubElement(ElementTree.SubElement(tree, "mujoco"), "compiler")
    for key in ("discardvisual", "strippath", "fusestatic"):
        options.set(key, "false")
    return RobotXml(
        path=path,
        name=tree.get("name") or path.stem,
        kind="urdf",
        text=ElementTree.tostring(tree, encoding="unicode"),
        meshes=meshes,
        references=tuple(meshes.values()),
    )


def _name_once(tree: ElementTree.Element) -> None:
    """Number geometries that share a name, because MuJoCo drops repeated names, and handles are found by name."""
    seen = Counter[str]()
    for element in (*tree.iter("visual"), *tree.iter("collision")):
        name = element.get("name", "")
        seen[name] += 1
        if name and seen[name] > 1:
            element.set("name", f"{name}_{seen[name]}")


def _urdf_file(path: Path, name: str, root: Path) -> Path:
    if not name.startswith(PACKAGE):
        return find_inside(root, [path.parent], [name], named_by=path)
    parts = PurePosixPath(name.removeprefix(PACKAGE)).parts
    names = ["/".join(parts[1:]), "/".join(parts)]
    return find_inside(root, _folders_up(path.parent, root), names, named_by=path)


def _folders_up(folder: Path, root: Path) -> Iterator[Path]:
    folder, root = folder.resolve(), root.resolve()
    while folder.is_relative_to(root):
        yield folder
        if folder == root:
            return
        folder = folder.parent


def _check_mesh(path: Path, file: Path) -> None:
    if file.suffix.lower() not in MESH_SUFFIXES:
        raise MalformedFileError(
            path,
            f"names {file.name}, a mesh format that MuJoCo does not read",
            f"convert it to one of {', '.join(MESH_SUFFIXES)}",
        )
    if not file.stat().st_size <= MAX_MESH_BYTES:
        raise LimitExceededError(file, f"is larger than {MAX_MESH_BYTES} bytes")


def _mjcf_references(path: Path, tree: ElementTree.Element, root: Path) -> tuple[Path, ...]:
    documents = _include(path, tree, root)
    options = [element for document in documents.values() for element in document.iter("compiler")]
    references = [file for file in documents if file != path]
    for current, document in documents.items():
        for element in document.iter():
            if element.tag == "model" and element.get("file"):
                raise MalformedFileError(path, "attaches other models", "save it as one model")
            folders = _asset_folders(path, str(element.tag), options)
            for attribute, name in element.attrib.items():
                if element.tag != "include" and attribute.startswith("file") and name:
                    names = [name, PurePosixPath(name).name]
                    file = find_inside(root, folders, names, named_by=current)
                    if element.tag == "mesh":
                        _check_mesh(current, file)
                    references.append(file)
    return tuple(dict.fromkeys(references))


def _include(path: Path, tree: ElementTree.Element, root: Path) -> dict[Path, ElementTree.Element]:
    """Parse the files that a document includes, directly or indirectly; return all documents by file."""
    documents = {path: tree}
    waiting = [path]
    while waiting:
        current = waiting.pop()
        for element in documents[current].iter("include"):
            folders = [path.parent, current.parent]
            file = find_inside(root, folders, [element.get("file", "")], named_by=current)
            if file not in documents:
                documents[file] = _parse(file)
                waiting.append(file)
            if not len(documents) <= MAX_INCLUDES:
                raise LimitExceededError(path, f"includes more than {MAX_INCLUDES} files")
    return documents


def _asset_folders(path: Path, tag: str, options: list[ElementTree.Element]) -> list[Path]:
    keys = (FOLDER_OPTIONS.get(tag, ""), "assetdir")
    named = [option.get(key, "") for option in options for key in keys if key]
    return [*(path.parent / name for name in named if name), path.parent]


def parse_spec(xml: RobotXml) -> mujoco.MjSpec:
    """Parse a description into an editable model, without changes.

    Raises:
        MalformedFileError: MuJoCo cannot read the description.
    """
    try:
        if xml.kind == "mjcf":
            return mujoco.MjSpec.from_file(str(xml.path))
        meshes = {name: file.read_bytes() for name, file in xml.meshes.items()}
        return mujoco.MjSpec.from_string(xml.text, assets=meshes)
    except (ValueError, RuntimeError) as error:
        raise MalformedFileError(xml.path, f"cannot be read by MuJoCo ({error})", "correct it") from error


def compile_model(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """Compile a model; `path` is its file, for messages.

    Raises:
        MalformedFileError: MuJoCo refuses the model.
    """
    try:
        return spec.compile()
    except (ValueError, RuntimeError) as error:
        raise MalformedFileError(path, f"cannot be used by MuJoCo ({error})", "correct it") from error
