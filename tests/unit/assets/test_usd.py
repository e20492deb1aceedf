"""USD: what is written comes back; what cannot be used is refused by name."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.assets.asset_check import check_asset
from aomgen.assets.box_cover import box_cover
from aomgen.assets.choice import make_asset
from aomgen.assets.handle_search import find_handle
from aomgen.assets.usd_parse import parse_usd
from aomgen.assets.usd_read import read_usd
from aomgen.assets.usd_write import make_identifier, make_names_unique, write_usd
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import AssetError, ConfigError, MalformedFileError, MissingFileError, UnsafePathError
from aomgen.io.artifact import load_artifact, save_artifact

UsdGeom = pytest.importorskip("pxr.UsdGeom")
from pxr import Gf, Sdf, Usd, UsdPhysics, UsdShade  # noqa: E402


@pytest.fixture(scope="module")
def microwave() -> ArticulatedAsset:
    return make_asset("microwave", 1)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, microwave: ArticulatedAsset) -> Path:
    """The folder of a written asset; read only."""
    path = tmp_path_factory.mktemp("written") / "asset" / "microwave-1.usda"
    write_usd(microwave, path)
    return path.parent


@pytest.fixture
def usd(tmp_path: Path, written: Path) -> Path:
    """A written asset that a test may change."""
    return Path(shutil.copytree(written, tmp_path / "asset")) / "microwave-1.usda"


def assert_same(a: ArticulatedAsset, b: ArticulatedAsset, tolerance: float = 2e-6) -> None:
    assert (a.name, a.category, a.joint.type) == (b.name, b.category, b.joint.type)
    for name in ("axis", "origin", "lower", "upper"):
        assert getattr(b.joint, name) == pytest.approx(getattr(a.joint, name), abs=tolerance), name
    assert b.handle_point == pytest.approx(a.handle_point, abs=tolerance)
    assert b.handle_axis == pytest.approx(a.handle_axis, abs=tolerance)
    for x, y in ((a.static, b.static), (a.moving, b.moving)):
        assert (x.name, len(x.meshes)) == (y.name, len(y.meshes))
        assert y.mass == pytest.approx(x.mass, rel=1e-6)
        assert [box.name for box in x.colliders] == [box.name for box in y.colliders]
        for p, q in zip(x.colliders, y.colliders, strict=True):
            assert q.T_asset_box == pytest.approx(p.T_asset_box, abs=tolerance)
            assert q.half_extents == pytest.approx(p.half_extents, abs=tolerance)
        for p, q in zip(x.meshes, y.meshes, strict=True):
            assert p.name == q.name
            assert q.vertices[q.faces] == pytest.approx(p.vertices[p.faces], abs=tolerance)
            assert q.uvs == pytest.approx(p.uvs, abs=1e-6)
            assert np.array_equal(p.texture_srgb, q.texture_srgb)
            assert q.color_srgb == pytest.approx(p.color_srgb, abs=1e-3)
            assert (q.roughness, q.metallic) == pytest.approx((p.roughness, p.metallic), abs=1e-6)


def test_text_round_trip(usd: Path, microwave: ArticulatedAsset) -> None:
    assert_same(microwave, read_usd(usd))
    assert "textures/" in usd.read_text()
    assert str(usd.parent) not in usd.read_text()


def test_binary_round_trip_of_a_scaled_drawer(tmp_path: Path) -> None:
    asset = make_asset("drawer", 2).transform(np.diag([0.8, 0.8, 0.8, 1.0]))
    write_usd(asset, tmp_path / "drawer.usdc")
    assert_same(asset, parse_usd(tmp_path / "drawer.usdc"))


@pytest.mark.parametrize(("category", "seed"), [("cabinet", 0), ("laptop", 1), ("toolbox", 1)])
def test_round_trip_keeps_the_heading_of_every_kind(tmp_path: Path, category: str, seed: int) -> None:
    """A panel that slides sideways still faces -y, although its motion does not point there."""
    asset = make_asset(category, seed)
    write_usd(asset, tmp_path / "asset.usda")
    assert_same(asset, parse_usd(tmp_path / "asset.usda"))


def test_centimetres_y_up_and_negative_limits(usd: Path, microwave: ArticulatedAsset, tmp_path: Path) -> None:
    """The same object as another tool would export it gives the same asset."""
    other = usd.parent / "exported.usda"
    stage = Usd.Stage.CreateNew(str(other))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    root = UsdGeom.Xform.Define(stage, "/export")
    # From our metres, Z up, to centimetres, Y up: scale by 100, then turn -90 degrees about x.
    root.AddRotateXOp().Set(-90.0)
    root.AddScaleOp().Set(Gf.Vec3f(100, 100, 100))
    stage.OverridePrim("/export/thing").GetReferences().AddReference("./microwave-1.usda")
    joint = UsdPhysics.RevoluteJoint(stage.GetPrimAtPath("/export/thing/joint"))
    joint.GetLowerLimitAttr().Set(-float(np.rad2deg(microwave.joint.upper)))
    joint.GetUpperLimitAttr().Set(0.0)
    # Turned by 180 degrees about its own y axis, the joint's x axis points the other way.
    for attribute in (joint.GetLocalRot0Attr(), joint.GetLocalRot1Attr()):
        attribute.Set(attribute.Get() * Gf.Quatf(0, 0, 1, 0))
    stage.SetDefaultPrim(root.GetPrim())
    stage.GetRootLayer().Save()
    asset = parse_usd(other)
    assert asset.joint.axis == pytest.approx(microwave.joint.axis, abs=1e-5)
    assert asset.joint.origin == pytest.approx(microwave.joint.origin, abs=1e-4)
    assert (asset.joint.lower, asset.joint.upper) == pytest.approx((0, microwave.joint.upper), abs=1e-5)
    door, ours = asset.moving.meshes[0], microwave.moving.meshes[0]
    assert door.vertices[door.faces] == pytest.approx(ours.vertices[ours.faces], abs=1e-4)
    # The root of this file names no handle, so it is guessed.
    assert asset.handle_point == pytest.approx(microwave.handle_point, abs=0.008)
    assert check_asset(asset) == []


def test_a_file_of_another_unit_is_scaled_before_its_handle_is_found(tmp_path: Path) -> None:
    asset = make_asset("drawer", 2)
    path = tmp_path / "drawer.usda"
    write_usd(asset.transform(np.diag([100.0, 100.0, 100.0, 1.0])), path)
    assert_same(asset, parse_usd(path, scale=0.01), tolerance=1e-5)
    stage = Usd.Stage.Open(str(path))
    stage.GetDefaultPrim().RemoveProperty("aomgen:handle_point")
    stage.GetRootLayer().Save()
    found = read_usd(path, scale=0.01, limits=(0, 20))
    assert found.handle_point == pytest.approx(asset.handle_point, abs=0.008)
    assert (found.moving.mass, found.joint.upper) == pytest.approx((asset.moving.mass, 0.2))
    assert check_asset(found) == []


def test_repeated_names_lose_no_geometry(usd: Path) -> None:
    stage = Usd.Stage.Open(str(usd))
    layer = stage.GetRootLayer()
    for group in ("visual", "collision"):
        link = f"/microwave_1/door/{group}"
        kept = str(stage.GetPrimAtPath(link).GetChildren()[0].GetName())
        for number, name in enumerate([f"{kept}_1", f"{kept}_2", kept]):
            UsdGeom.Scope.Define(stage, f"{link}/copy_{number}")
            Sdf.CopySpec(layer, f"{link}/{kept}", layer, f"{link}/copy_{number}/{name}")
            stage.GetPrimAtPath(f"{link}/copy_{number}/{name}").SetDisplayName(name.replace("_", " "))
    stage.GetPrimAtPath("/microwave_1/door").SetDisplayName("body")
    layer.Save()
    asset = parse_usd(usd)
    write_usd(asset, usd.with_name("again.usda"))
    again = parse_usd(usd.with_name("again.usda"))
    assert [sum(len(mesh.faces) for mesh in link.meshes) for link in (again.static, again.moving)] == [
        sum(len(mesh.faces) for mesh in link.meshes) for link in (asset.static, asset.moving)
    ]
    for parts, others in (
        (asset.moving.meshes, again.moving.meshes),
        (asset.moving.colliders, again.moving.colliders),
    ):
        assert [item.name for item in parts] == [item.name for item in others]
        assert len({make_identifier(item.name) for item in parts}) == len(parts)


def test_a_number_is_appended_until_the_name_is_unused(microwave: ArticulatedAsset) -> None:
    names = ["Cube", "Cube_1", "Cube_2", "Cube", "Cube 2", "Cube"]
    meshes = make_names_unique(replace(microwave.static.meshes[0], name=name) for name in names)
    assert [mesh.name for mesh in meshes] == ["Cube", "Cube_1", "Cube_2", "Cube_3", "Cube 2_2", "Cube_4"]


@pytest.mark.parametrize("category", ["microwave", "drawer"])
@pytest.mark.parametrize("seed", [0, 3])
def test_bar_is_guessed_from_shape_alone(category: str, seed: int) -> None:
    asset = make_asset(category, seed, "classic")
    unnamed = replace(
        asset.moving, meshes=tuple(replace(m, name=f"part_{i}") for i, m in enumerate(asset.moving.meshes))
    )
    boxes = tuple(replace(box, name=f"box_{i}") for i, box in enumerate(asset.moving.colliders))
    found = find_handle(replace(asset, moving=replace(unnamed, colliders=boxes)))
    assert found.handle_point == pytest.approx(asset.handle_point, abs=0.008)
    assert abs(found.handle_axis @ asset.handle_axis) > 0.99


def test_boxes_are_made_where_none_are_authored(usd: Path) -> None:
    stage = Usd.Stage.Open(str(usd))
    for link in ("body", "door"):
        stage.RemovePrim(f"/microwave_1/{link}/collision")
    stage.GetRootLayer().Save()
    asset = parse_usd(usd)
    assert len(asset.moving.colliders) >= 4
    assert check_asset(asset) == []


@pytest.mark.parametrize("seed", [1, 2])
def test_cover_of_a_drawer_keeps_its_gaps_open(seed: int) -> None:
    asset = make_asset("drawer", seed)
    static = replace(asset.static, colliders=tuple(box_cover(asset.static.meshes)))
    moving = replace(asset.moving, colliders=tuple(box_cover(asset.moving.meshes)))
    covered = replace(asset, static=static, moving=moving)
    assert len(static.colliders) < 80
    assert check_asset(covered) == []


def _edit(usd: Path) -> Usd.Stage:
    return Usd.Stage.Open(str(usd))


def test_no_joint_is_refused(usd: Path) -> None:
    stage = _edit(usd)
    stage.RemovePrim("/microwave_1/joint")
    stage.GetRootLayer().Save()
    with pytest.raises(AssetError, match="no revolute or prismatic joint"):
        parse_usd(usd)


def test_two_joints_are_listed(usd: Path) -> None:
    stage = _edit(usd)
    UsdPhysics.PrismaticJoint.Define(stage, "/microwave_1/tray_slide")
    stage.GetRootLayer().Save()
    with pytest.raises(AssetError, match=r"/microwave_1/joint.*/microwave_1/tray_slide"):
        parse_usd(usd)


def test_texture_outside_the_folder_is_refused(usd: Path) -> None:
    outside = usd.parent.parent / "secret.png"
    outside.write_bytes(next(usd.parent.glob("*_textures/*.png")).read_bytes())
    stage = _edit(usd)
    for prim in stage.Traverse():
        if prim.IsA(UsdShade.Shader) and UsdShade.Shader(prim).GetIdAttr().Get() == "UsdUVTexture":
            UsdShade.Shader(prim).GetInput("file").Set(Sdf.AssetPath("../secret.png"))
    stage.GetRootLayer().Save()
    with pytest.raises(UnsafePathError, match="secret"):
        read_usd(usd)


def test_layer_outside_the_folder_is_refused(usd: Path) -> None:
    (usd.parent.parent / "other.usda").write_text('#usda 1.0\ndef Xform "extra" {}\n')
    stage = _edit(usd)
    stage.GetRootLayer().subLayerPaths.append("../other.usda")
    stage.GetRootLayer().Save()
    with pytest.raises(UnsafePathError, match="other"):
        parse_usd(usd)


def test_missing_texture_is_named(usd: Path) -> None:
    victim = next(usd.parent.glob("*_textures/*keypad.png"))
    victim.unlink()
    with pytest.raises(MissingFileError, match="keypad"):
        parse_usd(usd)


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_truncated_file_is_malformed(tmp_path: Path, microwave: ArticulatedAsset, suffix: str) -> None:
    path = tmp_path / f"cut{suffix}"
    write_usd(microwave, path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(MalformedFileError):
        read_usd(path)


def test_parser_that_hangs_or_is_no_usd(tmp_path: Path, usd: Path) -> None:
    (tmp_path / "noise.usdc").write_bytes(np.random.default_rng(0).bytes(4000))
    with pytest.raises(MalformedFileError):
        read_usd(tmp_path / "noise.usdc")
    with pytest.raises(MalformedFileError, match="not parsed within"):
        read_usd(usd, timeout_s=0.05)
    with pytest.raises(MissingFileError):
        read_usd(tmp_path / "nowhere.usda")
    with pytest.raises(ConfigError, match="suffix"):
        write_usd(make_asset("drawer", 0), tmp_path / "x.obj")


def test_faces_out_of_range_are_malformed(usd: Path) -> None:
    stage = _edit(usd)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/microwave_1/body/visual/shell"))
    mesh.GetFaceVertexIndicesAttr().Set([0, 1, 100_000])
    mesh.GetFaceVertexCountsAttr().Set([3])
    stage.GetRootLayer().Save()
    with pytest.raises(MalformedFileError, match="shell"):
        read_usd(usd)


def test_artifact_of_an_asset_is_exact(tmp_path: Path, microwave: ArticulatedAsset) -> None:
    save_artifact(tmp_path, "a", microwave)
    assert_same(microwave, load_artifact(tmp_path, "a", ArticulatedAsset), tolerance=0.0)
    (tmp_path / "a.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:1000])
    with pytest.raises(MalformedFileError):
        load_artifact(tmp_path, "a", ArticulatedAsset)
