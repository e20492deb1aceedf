"""Opacity, roughness, metallic and normals of USD materials, as numbers and as textures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from aomgen.assets.choice import make_asset
from aomgen.assets.procedural.shapes import Material
from aomgen.assets.usd_material import GLASS_OPACITY, read_material
from aomgen.assets.usd_read import read_usd
from aomgen.assets.usd_write import write_usd
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.mesh import NUMBERS
from aomgen.errors import AssetError, MissingFileError, UnsafePathError

pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdShade

KINDS = Sdf.ValueTypeNames
# Of every pixel of `orm.png`.
ORM = (10, 100, 200, 60)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With a texture beside an asset's file."""
    inside = tmp_path / "asset"
    inside.mkdir()
    Image.new("RGBA", (4, 4), ORM).save(inside / "orm.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    return inside


def preview(folder: Path, name: str, file: str, output: str, **inputs) -> Material:
    """A UsdPreviewSurface of which a texture gives one input."""
    stage = Usd.Stage.CreateInMemory()
    material = UsdShade.Material.Define(stage, "/m")
    shader, node = (UsdShade.Shader.Define(stage, path) for path in ("/m/surface", "/m/texture"))
    shader.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    node.CreateInput("file", KINDS.Asset).Set(Sdf.AssetPath(file))
    for key in ("scale", "bias"):
        if key in inputs:
            node.CreateInput(key, KINDS.Float4).Set(Gf.Vec4f(*inputs[key]))
    shader.CreateInput("opacityThreshold", KINDS.Float).Set(inputs.get("threshold", 0.0))
    shader.CreateInput(name, KINDS.Float).ConnectToSource(node.ConnectableAPI(), output)
    return read_material(material, folder, Material())


def omniverse(folder: Path, shader_name: str, **inputs: float | bool | str) -> Material:
    """An MDL material; texts are texture files."""
    stage = Usd.Stage.CreateInMemory()
    material = UsdShade.Material.Define(stage, "/m")
    shader = UsdShade.Shader.Define(stage, "/m/shader")
    shader.SetSourceAsset(Sdf.AssetPath(f"{shader_name}.mdl"), "mdl")
    shader.SetSourceAssetSubIdentifier(shader_name, "mdl")
    material.CreateSurfaceOutput("mdl").ConnectToSource(shader.ConnectableAPI(), "out")
    for name, value in inputs.items():
        kind = {bool: KINDS.Bool, str: KINDS.Asset, float: KINDS.Float}[type(value)]
        shader.CreateInput(name, kind).Set(Sdf.AssetPath(value) if isinstance(value, str) else value)
    return read_material(material, folder, Material())


def test_a_texture_is_read_from_its_channel_with_scale_and_bias(folder: Path) -> None:
    for output, value in zip("rgba", ORM, strict=True):
        assert preview(folder, "roughness", "orm.png", output).maps["roughness"][0, 0] == value
    halved = preview(folder, "metallic", "orm.png", "b", scale=(1, 1, 0.5, 1), bias=(0, 0, 0.1, 0))
    assert halved.maps["metallic"][0, 0] == round(200 * 0.5 + 25.5)
    flipped = preview(folder, "normal", "orm.png", "rgb", scale=(2, -2, 2, 1), bias=(-1, 1, -1, 0))
    assert flipped.maps["normal"][0, 0].tolist() == [10, 155, 200]


def test_a_threshold_cuts_out(folder: Path) -> None:
    assert preview(folder, "opacity", "orm.png", "a", threshold=0.5).maps["opacity"].max() == 0
    # Nothing shows through: not worth a map.
    kept = preview(folder, "opacity", "orm.png", "a", threshold=0.1)
    assert (kept.maps, kept.opacity) == ({}, 1.0)


def test_omniverse_reads_packed_textures_switches_and_glass(folder: Path) -> None:
    packed = omniverse(folder, "OmniPBR", ORM_texture="orm.png", metallic_texture_influence=0.5)
    assert (packed.maps["roughness"][0, 0], packed.maps["metallic"][0, 0]) == (100, 100)
    off = omniverse(folder, "OmniPBR", opacity_constant=0.3, enable_opacity=False)
    on = omniverse(folder, "OmniPBR", opacity_constant=0.3, enable_opacity=True)
    assert (off.opacity, on.opacity) == (1.0, pytest.approx(0.3))
    assert omniverse(folder, "OmniPBR", opacity_texture="orm.png").maps["opacity"][0, 0] == 60
    assert omniverse(folder, "OmniGlass").opacity == GLASS_OPACITY


@pytest.mark.parametrize("name", ["diffuseColor", "opacity", "roughness", "metallic", "normal"])
def test_what_a_material_names_must_be_in_its_folder(folder: Path, name: str) -> None:
    with pytest.raises(MissingFileError, match=r"nowhere\.png"):
        preview(folder, name, "nowhere.png", "r")
    with pytest.raises(UnsafePathError, match="secret"):
        preview(folder, name, "../secret.png", "r")


def test_an_output_that_textures_do_not_have_is_refused(folder: Path) -> None:
    with pytest.raises(AssetError, match=r"'out'.*connect r, g, b or a"):
        preview(folder, "roughness", "orm.png", "out")


def test_a_round_trip_keeps_opacity_and_every_map(tmp_path: Path) -> None:
    asset, rng = make_asset("microwave", 1), np.random.default_rng(0)
    maps = {name: rng.integers(0, 255, (6, 5), np.uint8) for name in NUMBERS}
    maps["normal"] = rng.integers(0, 255, (4, 4, 3), np.uint8)
    mapped, clear, *rest = asset.static.meshes
    mapped = replace(mapped, maps=maps, **{name: float(maps[name].mean() / 255) for name in NUMBERS})
    meshes = (mapped, replace(clear, opacity=0.25), *rest)
    write_usd(replace(asset, static=replace(asset.static, meshes=meshes)), tmp_path / "a.usda")
    back: ArticulatedAsset = read_usd(tmp_path / "a.usda")
    for ours, theirs in zip(meshes, back.static.meshes, strict=True):
        assert [getattr(theirs, n) for n in NUMBERS] == pytest.approx([getattr(ours, n) for n in NUMBERS])
        assert theirs.maps.keys() == ours.maps.keys()
        assert all(np.array_equal(theirs.maps[name], image) for name, image in ours.maps.items())
