"""Read the properties of USD materials: base color, opacity, roughness, metallic and normals, as numbers or textures."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.procedural.shapes import NO_TEXTURE, Material
from aomgen.conventions import srgb_from_linear
from aomgen.core.mesh import NORMAL_MAP, NUMBERS
from aomgen.errors import AssetError, MissingFileError, UnsafePathError
from aomgen.io.images import decode_image, opacity_of, read_image

# Opacity that is assumed for OmniGlass, Omniverse's glass shader, which has no such input.
GLASS_OPACITY: Final = 0.2
COLOR: Final = "color"
# Placeholder for the channel that `opacity_of` selects.
MONO: Final = "mono"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Slot:
    """The shader inputs that hold one property of a material.

    Attributes:
        preview: Input of UsdPreviewSurface; a texture is connected to it.
        numbers: Inputs of Omniverse's MDL shaders (OmniPBR, OmniGlass) that hold a value for the whole surface.
        textures: Inputs of these shaders that name a texture, with the channels that are read.
        influence: Input of these shaders that holds the weight of the texture relative to the number.
    """

    preview: str
    numbers: tuple[str, ...] = ()
    textures: Mapping[str, str] = field(default_factory=dict)
    influence: str = ""


_SLOTS: Final = {
    COLOR: _Slot(
        preview="diffuseColor",
        numbers=("diffuse_color_constant", "diffuse_reflection_color", "glass_color", "base_color"),
        textures=dict.fromkeys(
            ("diffuse_texture", "albedo_texture", "diffuse_reflection_color_image"), "rgb"
        ),
    ),
    "opacity": _Slot(preview="opacity", numbers=("opacity_constant",), textures={"opacity_texture": MONO}),
    "roughness": _Slot(
        preview="roughness",
        numbers=("reflection_roughness_constant", "frosting_roughness"),
        textures={"ORM_texture": "g", "reflectionroughness_texture": "r"},
        influence="reflection_roughness_texture_influence",
    ),
    "metallic": _Slot(
        preview="metallic",
        numbers=("metallic_constant",),
        textures={"ORM_texture": "b", "metallic_texture": "r"},
        influence="metallic_texture_influence",
    ),
    NORMAL_MAP: _Slot(preview="normal", textures={"normalmap_texture": "rgb"}, influence="bump_factor"),
}
# Inputs that are ignored if the other input, a switch, is off.
_SWITCHES: Final = {
    "opacity_constant": "enable_opacity",
    "opacity_texture": "enable_opacity",
    "ORM_texture": "enable_ORM_texture",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Texture:
    """A texture file, given as Sdf.AssetPath, and its conversion to values in 0..1: channels times scale plus bias."""

    file: Any
    channels: str
    scale: Any = 1.0
    bias: Any = 0.0


def plain_material(color_linear: Any) -> Material:
    """Build a material of one linear color (3,), 0..1."""
    color = np.clip(srgb_from_linear(np.asarray(color_linear, np.float64)[:3]), 0.0, 1.0)
    r, g, b = color.astype(np.float64).tolist()
    return Material(color_srgb=(r, g, b))


def read_material(material: Any, folder: Path, fallback: Material) -> Material:
    """Read a bound UsdShade.Material.

    Args:
        material: Valid material, UsdPreviewSurface or MDL.
        folder: Folder that must contain the textures (or the .usdz package with them).
        fallback: Material whose values are used for properties that `material` does not state.

    Raises:
        UnsafePathError, MissingFileError, MalformedFileError, LimitExceededError: A texture cannot be used.
        AssetError: An unsupported output of a texture is connected.
    """
    shader = _surface(material)
    if shader is None:
        return fallback
    color = _value(shader, _SLOTS[COLOR])
    is_glass = str(shader.GetSourceAssetSubIdentifier("mdl")).startswith("OmniGlass")
    base = replace(fallback, opacity=GLASS_OPACITY) if is_glass else fallback
    found = {name: _value(shader, _SLOTS[name]) for name in NUMBERS}
    numbers = {name: float(getattr(base, name) if value is None else value) for name, value in found.items()}
    images = {name: _read_slot(shader, name, numbers, folder) for name in _SLOTS}
    numbers["opacity"], images["opacity"] = _cut_out(shader, numbers["opacity"], images["opacity"])
    maps = {name: image for name, image in images.items() if image is not None}
    texture = maps.pop(COLOR, NO_TEXTURE)
    return replace(
        fallback,
        texture_srgb=texture,
        color_srgb=fallback.color_srgb if color is None else plain_material(color).color_srgb,
        maps=maps,
        **numbers,
    )


def _surface(material: Any) -> Any | None:
    for context in ((), ("mdl",)):
        shader = material.ComputeSurfaceSource(*context)[0]
        if shader:
            return shader
    return None


def _input(shader: Any, name: str) -> Any | None:
    """Return the value of an input; None if there is none or it is switched off."""
    switch = _SWITCHES.get(name)
    if switch is not None and _input(shader, switch) in (False, 0):
        return None
    item = shader.GetInput(name) if name else None
    return item.Get() if item else None


def _value(shader: Any, slot: _Slot) -> Any | None:
    found = (_input(shader, name) for name in (slot.preview, *slot.numbers))
    return next((value for value in found if value is not None), None)


def _find_texture(shader: Any, name: str, number: float) -> _Texture | None:
    """Find the texture of a property, with its blend with `number` or, for normal maps, with the unperturbed normal."""
    from pxr import UsdShade

    slot = _SLOTS[name]
    for key, channels in slot.textures.items():
        file = _input(shader, key)
        if file is not None and file.path:
            influence = _input(shader, slot.influence)
            share = np.array(1.0 if influence is None else influence)
            alone = np.array([0.5, 0.5, 1.0]) if name == NORMAL_MAP else number
            return _Texture(file=file, channels=channels, scale=share, bias=(1 - share) * alone)
    item = shader.GetInput(slot.preview)
    for source in item.GetConnectedSources()[0] if item else []:
        node = UsdShade.Shader(source.source.GetPrim())
        file = _input(node, "file") if node else None
        if file is not None:
            return _read_uv_texture(node, file, name, str(source.sourceName))
    return None


def _read_uv_texture(node: Any, file: Any, name: str, output: str) -> _Texture:
    """Describe the texture of a property that is connected to an output of a UsdUVTexture."""
    if name == COLOR:
        return _Texture(file=file, channels="rgb")
    normal = name == NORMAL_MAP
    channels = "rgb" if normal else output[:1]
    if not channels or channels not in "rgba":
        raise AssetError(node.GetPath(), f"gives {name} its output '{output}'", "connect r, g, b or a")
    scale, bias = _input(node, "scale"), _input(node, "bias")
    if normal and scale is None:
        return _Texture(file=file, channels=channels)
    picked = ["rgba".index(channel) for channel in channels]
    factor = np.array((1, 1, 1, 1) if scale is None else scale, np.float64)[picked]
    offset = np.array((0, 0, 0, 0) if bias is None else bias, np.float64)[picked]
    if normal:
        factor, offset = factor / 2, (offset + 1) / 2
    return _Texture(file=file, channels=channels, scale=factor, bias=offset)


def _read_slot(
    shader: Any, name: str, numbers: Mapping[str, float], folder: Path
) -> NDArray[np.uint8] | None:
    """Read the image (H, W) or (H, W, 3) of a property; None if it has no texture."""
    texture = _find_texture(shader, name, numbers.get(name, 0.0))
    if texture is None:
        return None
    image = _read_texture(texture.file, folder)
    if texture.channels == MONO:
        values = opacity_of(image)[..., None]
    else:
        values = image[..., ["rgba".index(channel) for channel in texture.channels]]
    if np.any(texture.scale != 1) or np.any(texture.bias != 0):
        values = (values * texture.scale + 255 * texture.bias).clip(0, 255).round().astype(np.uint8)
    return values if values.shape[-1] > 1 else values[..., 0]


def _cut_out(
    shader: Any, number: float, image: NDArray[np.uint8] | None
) -> tuple[float, NDArray[np.uint8] | None]:
    """Threshold opacity to 0 or 1 if the material states a threshold; the image becomes None if it is opaque throughout."""
    limit = _input(shader, "opacityThreshold") or _input(shader, "opacity_threshold") or 0.0
    if limit > 0:
        number = float(number >= limit)
        image = None if image is None else np.where(image >= 255 * limit, 255, 0).astype(np.uint8)
    return (1.0, None) if image is not None and image.min() == 255 else (number, image)


def _read_texture(asset_path: Any, folder: Path) -> NDArray[np.uint8]:
    """Read the texture (H, W, 4) of an Sdf.AssetPath, which must be inside `folder`."""
    if "[" in (asset_path.resolvedPath or asset_path.path):
        return _read_packaged(asset_path, folder)
    given = Path(asset_path.resolvedPath or asset_path.path)
    place = (given if given.is_absolute() else folder / given).resolve()
    _require_inside(place, folder, asset_path.path)
    return read_image(place, "RGBA")


def _read_packaged(asset_path: Any, folder: Path) -> NDArray[np.uint8]:
    from pxr import Ar

    resolved = asset_path.resolvedPath
    _require_inside(Path(resolved.split("[")[0] or "/").resolve(), folder, asset_path.path)
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved)) if resolved else None
    if not asset:
        raise MissingFileError(asset_path.path, "is missing in the package", "export the package again")
    return decode_image(bytes(asset.GetBuffer()), Path(asset_path.path), "RGBA")


def _require_inside(place: Path, folder: Path, name: str) -> None:
    if not place.is_relative_to(folder.resolve()):
        raise UnsafePathError(name, "is outside the asset's folder", "copy it to the folder of the asset")


def check_layers(stage: Any, folder: Path) -> None:
    """Check that all layers of a stage were found and are inside `folder`.

    Raises:
        UnsafePathError: A layer is outside the folder.
        AssetError: The stage has composition errors, for example a missing layer.
    """
    for layer in stage.GetUsedLayers():
        if layer.anonymous or not layer.realPath:
            continue
        _require_inside(Path(layer.realPath.split("[")[0]).resolve(), folder, layer.identifier)
    problems = stage.GetCompositionErrors()
    if problems:
        raise AssetError(
            stage.GetRootLayer().identifier, f"does not compose ({problems[0]})", "repair its references"
        )
