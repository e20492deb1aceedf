"""Write articulated assets as self-contained USD with UsdGeom, UsdPreviewSurface and UsdPhysics.

The joint resistance and contact friction that verification assumes are written to the attributes that importers read:
joint resistance to those of MuJoCo's `MjcJointAPI` and of PhysX's `PhysxJointAxisAPI`, contact friction to a physics
material with `MjcMaterialAPI`. usd-core contains none of these schemas, so their attributes are written by name.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import (
    ARMATURE,
    CONTACT_FRICTION,
    HOLDING_SOLIMP,
    RESISTANCES,
    holding_friction,
)
from aomgen.conventions import linear_from_srgb
from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.mesh import NORMAL_MAP, NUMBERS, Mesh
from aomgen.core.transforms import make_tangent_basis, quat_from_matrix
from aomgen.core.values import Array
from aomgen.errors import ConfigError
from aomgen.io.atomic import write_bytes
from aomgen.io.images import encode_png
from aomgen.io.usd import export_stage, new_stage

# Namespace of custom attributes, for properties that UsdPhysics does not define.
NAMESPACE = "aomgen"
# Script that replays episodes in Isaac Sim; it does not depend on AOMGen.
REPLAY_SCRIPT = Path(__file__).with_name("replay_in_isaac_sim.py")
CONTACT_MATERIAL = "contact"
Named = TypeVar("Named", AssetLink, BoxCollider, Mesh)


def write_usd(asset: ArticulatedAsset, path: Path) -> None:
    """Write an asset as one USD file and a folder of textures next to it.

    The stage shows the closed asset (joint value 0) in meters, Z up, with joint limits in degrees (revolute) or meters and
    linear colors. Texture paths are relative: `<stem>_textures/<link>_<mesh>.png`, and `<link>_<mesh>.<map>.png` for maps.
    Handle point, handle axis, category and credit are custom attributes of the root, `aomgen:handle_point` etc. The joint
    has the nominal resistance of `mjcf.RESISTANCES`; the resistances that verification varies are listed in
    `aomgen:verified_damping` and `aomgen:verified_frictionloss`.

    Args:
        asset: Asset in the asset frame.
        path: File with the suffix .usda (text) or .usdc (binary).

    Raises:
        ConfigError: The suffix is not supported.
        StorageError: Writing to the disk failed.
    """
    from pxr import Sdf, UsdGeom, UsdPhysics

    if path.suffix == ".usdz":
        raise ConfigError(path, "would hold no textures", "choose one of .usda, .usdc")
    stage = new_stage(path)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, f"/{make_identifier(asset.name)}")
    stage.SetDefaultPrim(root.GetPrim())
    UsdPhysics.ArticulationRootAPI.Apply(root.GetPrim())
    root.GetPrim().SetDisplayName(asset.name)
    writer = _Writer(stage, str(root.GetPath()), path.parent / f"{path.stem}_textures")
    writer.contact_material()
    static, moving = (writer.link(link) for link in make_names_unique((asset.static, asset.moving)))
    writer.joint(asset, static, moving)
    for name, kind, value in (
        ("category", Sdf.ValueTypeNames.String, asset.category),
        ("credit", Sdf.ValueTypeNames.String, asset.credit),
        ("handle_point", Sdf.ValueTypeNames.Double3, _vector(asset.handle_point)),
        ("handle_axis", Sdf.ValueTypeNames.Double3, _vector(asset.handle_axis)),
    ):
        root.GetPrim().CreateAttribute(f"{NAMESPACE}:{name}", kind).Set(value)
    export_stage(stage, path)


def write_for_replay(asset: ArticulatedAsset, path: Path) -> None:
    """Write an asset by `write_usd`, and next to it the script that replays its episodes in Isaac Sim."""
    write_usd(asset, path)
    write_bytes(path.with_name(REPLAY_SCRIPT.name), REPLAY_SCRIPT.read_bytes())


class _Writer:
    """Writer of one stage; `root` is the prim path of the asset, `textures` a folder next to the file."""

    def __init__(self, stage: Any, root: str, textures: Path) -> None:
        self.stage, self.root, self.textures = stage, root, textures

    def link(self, link: AssetLink) -> str:
        """Add a link with meshes, materials and colliders; return its prim path."""
        from pxr import UsdGeom, UsdPhysics

        path = f"{self.root}/{make_identifier(link.name)}"
        prim = UsdGeom.Xform.Define(self.stage, path).GetPrim()
        UsdPhysics.RigidBodyAPI.Apply(prim)
        UsdPhysics.MassAPI.Apply(prim).CreateMassAttr(float(link.mass))
        prim.SetDisplayName(link.name)
        UsdGeom.Scope.Define(self.stage, f"{path}/visual")
        UsdGeom.Scope.Define(self.stage, f"{path}/collision")
        UsdGeom.Scope.Define(self.stage, f"{path}/materials")
        for mesh in link.meshes:
            self._mesh(mesh, path, link.name)
        for collider in link.colliders:
            self._collider(collider, path)
        return path

    def _mesh(self, mesh: Mesh, link_path: str, link_name: str) -> None:
        from pxr import Sdf, UsdGeom, UsdShade, Vt

        name = make_identifier(mesh.name)
        item = UsdGeom.Mesh.Define(self.stage, f"{link_path}/visual/{name}")
        points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.vertices, np.float32))
        item.CreatePointsAttr(points)
        item.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
        item.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.ravel().astype(np.int32)))
        item.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        item.CreateDoubleSidedAttr(True)
        item.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
        item.GetPrim().SetDisplayName(mesh.name)
        if len(mesh.uvs):
            primvar = UsdGeom.PrimvarsAPI(item).CreatePrimvar(
                "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
            )
            primvar.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uvs.reshape(-1, 2), np.float32)))
        files = f"{make_identifier(link_name)}_{name}"
        material = self._material(mesh, f"{link_path}/materials/{name}", files)
        UsdShade.MaterialBindingAPI.Apply(item.GetPrim()).Bind(material)

    def _material(self, mesh: Mesh, path: str, files: str) -> Any:
        """Add a UsdPreviewSurface; the names of its texture files begin with `files`."""
        from pxr import Gf, Sdf, UsdShade

        kinds = Sdf.ValueTypeNames
        material = UsdShade.Material.Define(self.stage, path)
        shader = UsdShade.Shader.Define(self.stage, f"{path}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        inputs = {name: shader.CreateInput(name, kinds.Float) for name in NUMBERS}
        for name, item in inputs.items():
            item.Set(float(getattr(mesh, name)))
        diffuse = shader.CreateInput("diffuseColor", kinds.Color3f)
        diffuse.Set(Gf.Vec3f(*(float(c) for c in linear_from_srgb(mesh.color_srgb))))
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        if len(mesh.uvs):
            reader = UsdShade.Shader.Define(self.stage, f"{path}/st")
            reader.CreateIdAttr("UsdPrimvarReader_float2")
            reader.CreateInput("varname", kinds.String).Set("st")
        if mesh.texture_srgb.size:
            texture = self._texture(mesh.texture_srgb, path, "texture", files)
            texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
            diffuse.ConnectToSource(texture.ConnectableAPI(), "rgb")
        for name, image in mesh.maps.items():
            texture = self._texture(image, path, name, f"{files}.{name}")
            texture.CreateInput("sourceColorSpace", kinds.Token).Set("raw")
            if name == NORMAL_MAP:
                texture.CreateInput("scale", kinds.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
                texture.CreateInput("bias", kinds.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
                inputs[name] = shader.CreateInput(name, kinds.Normal3f)
            inputs[name].ConnectToSource(texture.ConnectableAPI(), "rgb" if name == NORMAL_MAP else "r")
        return material

    def _texture(self, image: NDArray[np.uint8], path: str, name: str, file: str) -> Any:
        """Write an image to the texture folder, and add a node that reads it."""
        from pxr import Sdf, UsdShade

        kinds = Sdf.ValueTypeNames
        write_bytes(self.textures / f"{file}.png", encode_png(image))
        node = UsdShade.Shader.Define(self.stage, f"{path}/{name}")
        node.CreateIdAttr("UsdUVTexture")
        node.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(f"./{self.textures.name}/{file}.png"))
        node.CreateInput("wrapS", kinds.Token).Set("repeat")
        node.CreateInput("wrapT", kinds.Token).Set("repeat")
        reader = UsdShade.Shader(self.stage.GetPrimAtPath(f"{path}/st"))
        node.CreateInput("st", kinds.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        return node

    def _collider(self, collider: BoxCollider, link_path: str) -> None:
        from pxr import Gf, UsdGeom, UsdPhysics, UsdShade

        cube = UsdGeom.Cube.Define(self.stage, f"{link_path}/collision/{make_identifier(collider.name)}")
        cube.CreateSizeAttr(2.0)
        cube.CreatePurposeAttr(UsdGeom.Tokens.guide)
        cube.GetPrim().SetDisplayName(collider.name)
        T = collider.T_asset_box
        w, x, y, z = (float(c) for c in quat_from_matrix(T[:3, :3]))
        cube.AddTranslateOp().Set(_vector(T[:3, 3]))
        cube.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
        cube.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(_vector(collider.half_extents))
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
        material = UsdShade.Material(self.stage.GetPrimAtPath(f"{self.root}/{CONTACT_MATERIAL}"))
        UsdShade.MaterialBindingAPI.Apply(cube.GetPrim()).Bind(
            material, UsdShade.Tokens.fallbackStrength, "physics"
        )

    def contact_material(self) -> None:
        """Add the physics material that all colliders share."""
        from pxr import UsdPhysics, UsdShade

        sliding, torsional, rolling = CONTACT_FRICTION
        prim = UsdShade.Material.Define(self.stage, f"{self.root}/{CONTACT_MATERIAL}").GetPrim()
        material = UsdPhysics.MaterialAPI.Apply(prim)
        material.CreateStaticFrictionAttr(sliding)
        material.CreateDynamicFrictionAttr(sliding)
        material.CreateRestitutionAttr(0.0)
        prim.AddAppliedSchema("MjcMaterialAPI")
        set_attribute(prim, "mjc:torsionalfriction", torsional)
        set_attribute(prim, "mjc:rollingfriction", rolling)

    def joint(self, asset: ArticulatedAsset, static: str, moving: str) -> None:
        """Add the joint of an asset between two links, given by their prim paths."""
        from pxr import Gf, UsdPhysics

        joint = asset.joint
        kind = UsdPhysics.RevoluteJoint if joint.type == "revolute" else UsdPhysics.PrismaticJoint
        unit = 180.0 / np.pi if joint.type == "revolute" else 1.0
        item = kind.Define(self.stage, f"{self.root}/joint")
        item.CreateBody0Rel().SetTargets([static])
        item.CreateBody1Rel().SetTargets([moving])
        item.CreateAxisAttr("X")
        item.CreateLowerLimitAttr(float(joint.lower * unit))
        item.CreateUpperLimitAttr(float(joint.upper * unit))
        quat = Gf.Quatf(*(float(c) for c in quat_from_x(joint.axis)))
        position = Gf.Vec3f(*(float(c) for c in joint.origin))
        for create_position, create_rotation in (
            (item.CreateLocalPos0Attr, item.CreateLocalRot0Attr),
            (item.CreateLocalPos1Attr, item.CreateLocalRot1Attr),
        ):
            create_position(position)
            create_rotation(quat)
        set_resistance(item.GetPrim(), asset)


def set_resistance(prim: Any, asset: ArticulatedAsset) -> None:
    """Write damping, dry friction and armature of a joint prim for MuJoCo and PhysX.

    The resistances that verification varies are recorded in attributes of AOMGen. PhysX uses degrees per second for
    revolute joints. Its older `physxJoint:jointFriction` is a dimensionless coefficient that does not correspond to a
    torque, so it is not written.
    """
    tried, holding = RESISTANCES[asset.joint.type], holding_friction(asset)
    frictions = [friction + holding for _, friction in tried]
    dampings = [damping for damping, _ in tried]
    prim.AddAppliedSchema("MjcJointAPI")
    set_attribute(prim, "mjc:damping", dampings[0])
    set_attribute(prim, "mjc:frictionloss", frictions[0])
    set_attribute(prim, "mjc:armature", ARMATURE)
    if holding:
        set_attribute(prim, "mjc:solimpfriction", HOLDING_SOLIMP)
    revolute = asset.joint.type == "revolute"
    axis = "angular" if revolute else "linear"
    prim.AddAppliedSchema(f"PhysxJointAxisAPI:{axis}")
    for name, value in (
        ("staticFrictionEffort", frictions[0]),
        ("dynamicFrictionEffort", frictions[0]),
        ("viscousFrictionCoefficient", dampings[0] * (np.pi / 180 if revolute else 1.0)),
        ("armature", ARMATURE),
    ):
        set_attribute(prim, f"physxJointAxis:{axis}:{name}", value)
    set_attribute(prim, f"{NAMESPACE}:verified_damping", dampings)
    set_attribute(prim, f"{NAMESPACE}:verified_frictionloss", frictions)


def set_attribute(prim: Any, name: str, value: float | bool | Sequence[float]) -> None:
    """Write an attribute of a schema that usd-core does not contain.

    Args:
        prim: Prim that gets the attribute.
        name: Name with its namespace; `physx...` attributes are varying floats, all others uniform doubles.
        value: Flag, number or list of numbers.
    """
    from pxr import Sdf

    kinds, physx = Sdf.ValueTypeNames, name.startswith("physx")
    single = kinds.Float if physx else kinds.Double
    kind = (
        kinds.Bool if isinstance(value, bool) else single if isinstance(value, float) else kinds.DoubleArray
    )
    variability = Sdf.VariabilityVarying if physx else Sdf.VariabilityUniform
    prim.CreateAttribute(name, kind, name.startswith(NAMESPACE), variability).Set(value)


def quat_from_x(axis: Array) -> Array:
    """Compute a quaternion wxyz (4,) that rotates the x axis to a unit direction (3,)."""
    return quat_from_matrix(np.stack([axis, *make_tangent_basis(axis)], 1))


def _vector(values: Array) -> Any:
    from pxr import Gf

    return Gf.Vec3d(*(float(v) for v in values))


def make_names_unique(items: Iterable[Named]) -> tuple[Named, ...]:
    """Append numbers to names that convert to the same USD identifier as an earlier name."""
    numbers = Counter[str]()
    found = []
    for item in items:
        name, first = item.name, make_identifier(item.name)
        while (identifier := make_identifier(name)) in numbers:
            numbers[first] += 1
            name = f"{item.name}_{numbers[first]}"
        numbers[identifier] = 1
        found.append(replace(item, name=name))
    return tuple(found)


def make_identifier(name: str) -> str:
    """Convert a name to a valid name of a USD prim."""
    from pxr import Tf

    return str(Tf.MakeValidIdentifier(name))
