"""What a USD material looks like: base color, texture, roughness, metallic."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from aomgen.assets.procedural.shapes import NO_TEXTURE, Material
from aomgen.conventions import srgb_from_linear
from aomgen.errors import (
    AssetError,
    LimitExceededError,
    MalformedFileError,
    MissingFileError,
    UnsafePathError,
)
from aomgen.io.images import MAX_PIXELS, read_image

# Input names of UsdPreviewSurface first, then of Omniverse's MDL shaders (OmniPBR, OmniGlass).
_COLOR_INPUTS = (
    "diffuseColor",
    "diffuse_color_constant",
    "diffuse_reflection_color",
    "glass_color",
    "base_color",
)
_TEXTURE_INPUTS = ("diffuse_texture", "albedo_texture", "diffuse_reflection_color_image")
_ROUGHNESS_INPUTS = ("roughness", "reflection_roughness_constant")
_METALLIC_INPUTS = ("metallic", "metallic_constant")


def plain_material(color_linear: Any) -> Material:
    """One linear color (3,)."""
    color = np.clip(srgb_from_linear(np.asarray(color_linear, np.float64)[:3]), 0.0, 1.0)
    r, g, b = color.astype(np.float64).tolist()
    return Material(color_srgb=(r, g, b))


def read_material(material: Any, folder: Path, fallback: Material) -> Material:
    """A bound UsdShade.Material; what it does not say is taken from `fallback`.

    Args:
        material: Valid material, UsdPreviewSurface or MDL.
        folder: Textures must lie inside it (or inside the same .usdz package).

    Raises:
        UnsafePathError, MissingFileError, MalformedFileError, LimitExceededError: For textures.
    """
    shader = _surface(material)
    if shader is None:
        return fallback
    color = _value(shader, _COLOR_INPUTS)
    roughness, metallic = _value(shader, _ROUGHNESS_INPUTS), _value(shader, _METALLIC_INPUTS)
    return Material(
        texture_srgb=_texture(shader, folder),
        color_srgb=fallback.color_srgb if color is None else plain_material(color).color_srgb,
        roughness=fallback.roughness if roughness is None else float(roughness),
        metallic=fallback.metallic if metallic is None else float(metallic),
    )


def _surface(material: Any) -> Any | None:
    for context in ((), ("mdl",)):
        shader = material.ComputeSurfaceSource(*context)[0]
        if shader:
            return shader
    return None


def _value(shader: Any, names: tuple[str, ...]) -> Any | None:
    for name in names:
        item = shader.GetInput(name)
        value = item.Get() if item else None
        if value is not None:
            return value
    return None


def _texture(shader: Any, folder: Path) -> NDArray[np.uint8]:
    from pxr import UsdShade

    for name in _TEXTURE_INPUTS:
        item = shader.GetInput(name)
        if item and item.Get() is not None and item.Get().path:
            return _read_texture(item.Get(), folder)
    item = shader.GetInput("diffuseColor")
    sources = item.GetConnectedSources()[0] if item else []
    for source in sources:
        node = UsdShade.Shader(source.source.GetPrim())
        file = node.GetInput("file") if node else None
        if file and file.Get() is not None:
            return _read_texture(file.Get(), folder)
    return NO_TEXTURE


def _read_texture(asset_path: Any, folder: Path) -> NDArray[np.uint8]:
    """Texture (H, W, 3) of an Sdf.AssetPath, which must not leave `folder`."""
    if "[" in (asset_path.resolvedPath or asset_path.path):
        return _packaged(asset_path, folder)
    given = Path(asset_path.resolvedPath or asset_path.path)
    place = (given if given.is_absolute() else folder / given).resolve()
    _require_inside(place, folder, asset_path.path)
    return read_image(place)


def _require_inside(place: Path, folder: Path, name: str) -> None:
    if not place.is_relative_to(folder.resolve()):
        raise UnsafePathError(name, "lies outside the asset's folder", "copy it beside the asset")


def _packaged(asset_path: Any, folder: Path) -> NDArray[np.uint8]:
    from pxr import Ar

    resolved = asset_path.resolvedPath
    _require_inside(Path(resolved.split("[")[0] or "/").resolve(), folder, asset_path.path)
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved)) if resolved else None
    if not asset:
        raise MissingFileError(asset_path.path, "is missing in the package", "export the package again")
    try:
        image = Image.open(io.BytesIO(bytes(asset.GetBuffer())))
        if not image.width * image.height <= MAX_PIXELS:
            raise LimitExceededError(asset_path.path, f"has {image.width} x {image.height} pixels")
        return np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, ValueError) as error:
        raise MalformedFileError(asset_path.path, "is not an image", "export the package again") from error


def check_layers(stage: Any, folder: Path) -> None:
    """Refuse a stage that was composed from files outside `folder`, or of which a layer cannot be found."""
    for layer in stage.GetUsedLayers():
        if layer.anonymous or not layer.realPath:
            continue
        _require_inside(Path(layer.realPath.split("[")[0]).resolve(), folder, layer.identifier)
    problems = stage.GetCompositionErrors()
    if problems:
        raise AssetError(
            stage.GetRootLayer().identifier, f"does not compose ({problems[0]})", "repair its references"
        )
