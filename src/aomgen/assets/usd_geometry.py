"""Read the meshes and colliders of the static and the moving link from a USD stage."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.box_cover import box_cover
from aomgen.assets.procedural.shapes import Material
from aomgen.assets.usd_material import plain_material, read_material
from aomgen.core.asset import AssetLink, BoxCollider
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import apply, transform
from aomgen.core.values import Array
from aomgen.errors import AssetError, LimitExceededError, MalformedFileError
from aomgen.io.geom_surface import Shape, hull_surface, outer_points

# Largest number of faces of an asset, which bounds the memory; usual assets have far fewer.
MAX_FACES = 3_000_000


@dataclass(slots=True)
class _Collected:
    """Parts of one link that are collected during the traversal of a stage."""

    name: str
    meshes: list[Mesh] = field(default_factory=list)
    boxes: list[BoxCollider] = field(default_factory=list)
    collision_meshes: list[Mesh] = field(default_factory=list)
    mass: float = 0.0
    named: bool = False


def read_links(
    stage: Any, moving_bodies: frozenset[str], all_bodies: frozenset[str], to_metric: Array, path: Path
) -> tuple[AssetLink, AssetLink]:
    """Read the static and the moving link of a stage, in meters, Z up.

    Box colliders (UsdGeom.Cube with CollisionAPI) are used unchanged, other collision shapes are covered by boxes, see
    `box_cover`. A link without collision shapes has no colliders.

    Args:
        stage: Open Usd.Stage.
        moving_bodies: Prim paths of the bodies that the joint moves.
        all_bodies: Prim paths of all bodies.
        to_metric: Transform (4, 4) from stage coordinates to meters, Z up.
        path: File of the stage; its folder must contain the textures.

    Raises:
        MalformedFileError: A mesh has indices out of range, inconsistent counts or values that are not finite.
        LimitExceededError: The stage has more than MAX_FACES faces.
        AssetError: A box collider is sheared.
        UnsafePathError, MissingFileError: A texture is outside the folder or missing.
    """
    from pxr import Usd, UsdGeom, UsdPhysics

    links = {False: _Collected(name="static"), True: _Collected(name="moving")}
    cache = UsdGeom.XformCache()
    count = 0
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        link = links[_owner(prim, all_bodies) in moving_bodies]
        if str(prim.GetPath()) in all_bodies and not link.named:
            link.name, link.named = str(prim.GetDisplayName() or prim.GetName()), True
        if prim.HasAPI(UsdPhysics.MassAPI):
            link.mass += max(0.0, float(UsdPhysics.MassAPI(prim).GetMassAttr().Get() or 0.0))
        if not prim.IsA(UsdGeom.Gprim):
            continue
        place = to_metric @ np.array(cache.GetLocalToWorldTransform(prim)).T
        collides = prim.HasAPI(UsdPhysics.CollisionAPI)
        name = str(prim.GetDisplayName() or prim.GetName())
        seen = _visible(prim)
        if collides and prim.IsA(UsdGeom.Cube):
            link.boxes.append(_box(prim, place, name))
            if not seen:
                continue
        if not (seen or collides):
            continue
        folder = path.resolve().parent
        whole = prim.IsA(UsdGeom.Mesh)
        meshes = _meshes(prim, place, name, folder) if whole else _primitive(prim, place, name, folder)
        count += sum(len(mesh.faces) for mesh in meshes)
        if not count <= MAX_FACES:
            raise LimitExceededError(
                prim.GetPath(),
                f"increases the size of the asset to more than {MAX_FACES} faces",
                "simplify it",
            )
        link.meshes += meshes if seen else []
        link.collision_meshes += meshes if collides and not prim.IsA(UsdGeom.Cube) else []
    kilograms = float(UsdPhysics.GetStageKilogramsPerUnit(stage))
    static, moving = (
        AssetLink(
            name=link.name,
            meshes=tuple(link.meshes),
            colliders=tuple([*link.boxes, *box_cover(link.collision_meshes)]),
            mass=link.mass * kilograms,
        )
        for link in links.values()
    )
    return static, moving


def _owner(prim: Any, bodies: frozenset[str]) -> str:
    while prim and not prim.IsPseudoRoot():
        if str(prim.GetPath()) in bodies:
            return str(prim.GetPath())
        prim = prim.GetParent()
    return ""


def _visible(prim: Any) -> bool:
    from pxr import UsdGeom

    item = UsdGeom.Imageable(prim)
    drawn = item.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
    return drawn and item.ComputeVisibility() != UsdGeom.Tokens.invisible


def _box(prim: Any, place: Array, name: str) -> BoxCollider:
    from pxr import UsdGeom

    lengths = np.linalg.norm(place[:3, :3], axis=0)
    R = place[:3, :3] / np.maximum(lengths, 1e-12)
    if not np.allclose(R.T @ R, np.eye(3), atol=1e-4):
        raise AssetError(prim.GetPath(), "is a sheared collision box", "author it without shear")
    if np.linalg.det(R) < 0:
        R = R * np.array([1.0, 1.0, -1.0])
    half = 0.5 * float(UsdGeom.Cube(prim).GetSizeAttr().Get()) * lengths
    return BoxCollider(name=name, T_asset_box=transform(R, place[:3, 3]), half_extents=half)


def _primitive(prim: Any, place: Array, name: str, folder: Path) -> list[Mesh]:
    """Build the surface of a cube, sphere, cylinder, capsule or cone; the list is empty for other shapes."""
    from pxr import UsdShade

    points = _primitive_points(prim)
    if points is None:
        return []
    base = _base_material(prim)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    surface = read_material(material, folder, base) if material else base
    vertices, faces = hull_surface(apply(place, points))
    return [surface.mesh(name, vertices, faces, np.zeros((0, 3, 2)))]


def _primitive_points(prim: Any) -> Array | None:
    """Return points (N, 3) whose convex hull is the primitive, in its own coordinates; None for other shapes."""
    from pxr import UsdGeom

    if prim.IsA(UsdGeom.Cube):
        return outer_points("box", np.full(3, 0.5 * float(UsdGeom.Cube(prim).GetSizeAttr().Get())))
    if prim.IsA(UsdGeom.Sphere):
        return outer_points("sphere", np.full(3, float(UsdGeom.Sphere(prim).GetRadiusAttr().Get())))
    schemas: dict[Shape, Any] = {
        "cylinder": UsdGeom.Cylinder,
        "capsule": UsdGeom.Capsule,
        "cone": UsdGeom.Cone,
    }
    for kind, schema in schemas.items():
        if prim.IsA(schema):
            item = schema(prim)
            half = 0.5 * float(item.GetHeightAttr().Get())
            points = outer_points(kind, np.array([float(item.GetRadiusAttr().Get()), half, 0.0]))
            # The points are computed for the z axis; cyclic permutation of the coordinates is a rotation to the prim's axis.
            return np.roll(points, {"X": 1, "Y": 2, "Z": 0}[str(item.GetAxisAttr().Get())], axis=1)
    return None


def _meshes(prim: Any, place: Array, name: str, folder: Path) -> list[Mesh]:
    """Read the triangles of a mesh prim as one mesh for each material of its face subsets."""
    from pxr import UsdGeom, UsdShade

    item = UsdGeom.Mesh(prim)
    points = np.array(item.GetPointsAttr().Get() or np.zeros((0, 3)), np.float64).reshape(-1, 3)
    counts = np.array(item.GetFaceVertexCountsAttr().Get() or [], np.int64)
    indices = np.array(item.GetFaceVertexIndicesAttr().Get() or [], np.int64)
    if not len(counts) or not len(points):
        return []
    valid = np.isfinite(points).all() and counts.min() >= 0 and counts.sum() == len(indices)
    if not (valid and indices.min() >= 0 and indices.max() < len(points)):
        raise MalformedFileError(prim.GetPath(), "has faces that do not fit its points", "export it again")
    corners, owners = _fan(counts)
    mirrored = np.linalg.det(place[:3, :3]) < 0
    if mirrored != (item.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded):
        corners = corners[:, ::-1]
    uvs = _corner_uvs(prim, corners, indices, len(points))
    vertices = apply(place, points)
    base = _base_material(prim)
    meshes = []
    for suffix, bound, chosen in _pieces(prim, owners):
        material, _ = UsdShade.MaterialBindingAPI(bound).ComputeBoundMaterial()
        surface = read_material(material, folder, base) if material else base
        used, faces = np.unique(indices[corners[chosen]], return_inverse=True)
        uvs_of_faces = uvs[chosen] if len(uvs) else uvs
        meshes.append(surface.mesh(name + suffix, vertices[used], faces.reshape(-1, 3), uvs_of_faces))
    return meshes


def _pieces(prim: Any, owners: NDArray[np.int64]) -> list[tuple[str, Any, NDArray[np.bool_]]]:
    """List the name suffix, the prim that carries the material, and the triangle mask of every material subset.

    Args:
        prim: Mesh prim.
        owners: Polygon number of every triangle (F,).
    """
    from pxr import UsdGeom, UsdShade

    pieces, rest = [], np.ones(len(owners), bool)
    for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
        faces = np.array(UsdGeom.Subset(subset).GetIndicesAttr().Get() or [], np.int64)
        chosen = np.isin(owners, faces) & rest
        if chosen.any():
            pieces.append((f"_{subset.GetPrim().GetName()}", subset.GetPrim(), chosen))
            rest &= ~chosen
    return [*pieces, ("", prim, rest)] if rest.any() else pieces


def _fan(counts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangulate polygons with the given numbers of corners as fans; return corner (F, 3) and polygon numbers (F,)."""
    starts = np.cumsum(counts) - counts
    triangles = np.maximum(counts - 2, 0)
    owners = np.repeat(np.arange(len(counts)), triangles)
    steps = np.arange(len(owners)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    first = starts[owners]
    return np.stack([first, first + steps + 1, first + steps + 2], 1), owners


def _corner_uvs(prim: Any, corners: NDArray[np.int64], indices: NDArray[np.int64], points: int) -> Array:
    """Read the texture coordinates (F, 3, 2) of a mesh; empty if it has none with a matching count."""
    from pxr import UsdGeom

    api = UsdGeom.PrimvarsAPI(prim)
    for name in ("st", "st0", "st_0", "UVMap", "uv"):
        primvar = api.FindPrimvarWithInheritance(name)
        if not primvar or not primvar.HasValue():
            continue
        values = np.array(primvar.ComputeFlattened(), np.float64).reshape(-1, 2)
        if len(values) == len(indices):
            return values[corners]
        if len(values) == points:
            return values[indices[corners]]
    return np.zeros((0, 3, 2))


def _base_material(prim: Any) -> Material:
    """Build the material of a prim's displayColor, which is used if no material is bound."""
    from pxr import UsdGeom

    colors = UsdGeom.Gprim(prim).GetDisplayColorAttr().Get()
    return plain_material(
        np.mean(np.array(colors), 0) if colors is not None and len(colors) else (0.5, 0.5, 0.5)
    )
