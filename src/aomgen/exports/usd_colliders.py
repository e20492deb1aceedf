"""Export of the collision shapes of a MuJoCo model as UsdPhysics colliders, with friction and excluded pairs."""

from collections.abc import Mapping
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.usd_write import make_identifier
from aomgen.io.geom_surface import find_colliding_geoms, geom_surface

MATERIALS: Final = "/World/PhysicsMaterials"
WORLD_COLLIDERS: Final = "/World/Surroundings"


def add_colliders(stage: Any, model: mujoco.MjModel, bodies: Mapping[int, str]) -> None:
    """Write the colliding shapes below the prims of their bodies, and static ones below the surroundings.

    Boxes, spheres, capsules and cylinders are kept, other shapes become convex hulls. All have the purpose "guide", so
    that they are not rendered.

    Args:
        stage: The stage under construction.
        model: Compiled scene.
        bodies: Prim path of each body (id) that is a rigid body.
    """
    from pxr import UsdGeom, UsdPhysics

    UsdGeom.Xform.Define(stage, WORLD_COLLIDERS)
    UsdGeom.Scope.Define(stage, MATERIALS)
    for geom in np.flatnonzero(find_colliding_geoms(model)):
        home = bodies.get(int(model.geom_bodyid[geom]), WORLD_COLLIDERS)
        folder = UsdGeom.Scope.Define(stage, f"{home}/collision").GetPath()
        name = make_identifier(model.geom(geom).name or f"shape_{geom}")
        shape = _add_shape(stage, model, int(geom), f"{folder}/{name}")
        shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
        _bind_friction(stage, shape.GetPrim(), model.geom_friction[geom])


def exclude_contacts(stage: Any, model: mujoco.MjModel, bodies: Mapping[int, str]) -> None:
    """Write the pairs of bodies that the model excludes from contacts; the world body is the surroundings."""
    from pxr import UsdPhysics

    for signature in model.exclude_signature:
        first, second = (
            bodies.get(int(body), WORLD_COLLIDERS) for body in (signature >> 16, signature & 0xFFFF)
        )
        if first == WORLD_COLLIDERS:
            first, second = second, first
        filtered = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(first))
        filtered.CreateFilteredPairsRel().AddTarget(second)


def _add_shape(stage: Any, model: mujoco.MjModel, geom: int, path: str) -> Any:
    """Define the prim of a geom, in the frame of its body."""
    from pxr import UsdGeom

    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), [float(x) for x in model.geom_size[geom]]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        shape = UsdGeom.Cube.Define(stage, path)
        shape.CreateSizeAttr(2.0)
        _place(shape, model, geom, scale=size)
    elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        shape = UsdGeom.Sphere.Define(stage, path)
        shape.CreateRadiusAttr(size[0])
        _place(shape, model, geom)
    elif kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
        capsule = kind == mujoco.mjtGeom.mjGEOM_CAPSULE
        shape = (UsdGeom.Capsule if capsule else UsdGeom.Cylinder).Define(stage, path)
        shape.CreateAxisAttr(UsdGeom.Tokens.z)
        shape.CreateRadiusAttr(size[0])
        shape.CreateHeightAttr(2 * size[1])
        _place(shape, model, geom)
    else:
        return _add_hull(stage, model, geom, path)
    shape.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(shape, 0))
    return shape


def _place(shape: Any, model: mujoco.MjModel, geom: int, scale: list[float] | None = None) -> None:
    from pxr import Gf, UsdGeom

    shape.AddTranslateOp().Set(Gf.Vec3d(*(float(x) for x in model.geom_pos[geom])))
    quat = Gf.Quatd(*(float(x) for x in model.geom_quat[geom]))
    shape.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(quat)
    if scale is not None:
        shape.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*scale))


def _add_hull(stage: Any, model: mujoco.MjModel, geom: int, path: str) -> Any:
    """Define a mesh in the frame of the body; its convex hull is the collider, as in MuJoCo."""
    from pxr import UsdGeom, UsdPhysics, Vt

    surface = geom_surface(model, geom)
    if surface is None:
        raise ValueError(f"geom {geom} is a plane or a height field, which scenes of ours do not have")
    vertices, faces = surface
    shape = UsdGeom.Mesh.Define(stage, path)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertices, np.float32))
    shape.CreatePointsAttr(points)
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel().astype(np.int32)))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    hull = UsdPhysics.MeshCollisionAPI.Apply(shape.GetPrim())
    hull.CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
    return shape


def _bind_friction(stage: Any, prim: Any, friction: NDArray[np.float64]) -> None:
    """Bind the physics material of a friction coefficient; shapes with equal friction share it."""
    from pxr import UsdPhysics, UsdShade

    sliding = float(friction[0])
    path = f"{MATERIALS}/friction_{round(1000 * sliding):04d}"
    if not stage.GetPrimAtPath(path):
        material = UsdPhysics.MaterialAPI.Apply(UsdShade.Material.Define(stage, path).GetPrim())
        material.CreateStaticFrictionAttr(sliding)
        material.CreateDynamicFrictionAttr(sliding)
        material.CreateRestitutionAttr(0.0)
    bound = UsdShade.Material(stage.GetPrimAtPath(path))
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(bound, UsdShade.Tokens.fallbackStrength, "physics")
