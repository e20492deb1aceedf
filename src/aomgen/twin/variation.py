"""Change the light of a twin, or the material or size of its object."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import illuminate_srgb, linear_from_srgb, srgb_from_linear
from aomgen.core.plan import LightChange, MaterialChange
from aomgen.core.transforms import matrix_from_rotvec
from aomgen.core.values import Array
from aomgen.twin.relighting import Relit, ResidualAppearance
from aomgen.twin.twin import OBJECT, PART, TwinModel

# Matrix from XYZ to linear sRGB. Source: IEC 61966-2-1.
RGB_OF_XYZ: Final = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))


def change_appearance(twin: TwinModel, light: LightChange, material: MaterialChange) -> TwinModel:
    """Change the light of a twin and the material of its object.

    Intensity and temperature change all colors, as in a camera with fixed exposure and white balance. A rotation of the light
    changes the relit surfaces and the shadows of moving bodies; other scanned surfaces keep their shading.

    Args:
        twin: Twin to be changed.
        light: Difference from the recorded light.
        material: Difference from the colors of the object.

    Returns:
        The changed twin, or the same one if nothing changes.
    """
    gains = light_gains(light)
    if material != MaterialChange():
        twin = _with_material(twin, material_matrix(material))
    if light.turn:
        twin = _with_turned_light(twin, matrix_from_rotvec([0.0, 0.0, light.turn]))
    return twin if (gains == 1).all() else _with_gains(twin, gains)


def scale_object(twin: TwinModel, factor: float) -> TwinModel:
    """Scale the object of a twin, including its joint, about the origin of the object frame."""
    if factor == 1:
        return twin
    S = np.diag([factor, factor, factor, 1.0])
    mine = np.isin(twin.bodies, [twin.body(OBJECT), twin.body(PART)])
    own, g = twin.gaussians.select(mine).transform(S), twin.gaussians
    means, scales = np.array(g.means), np.array(g.scales)
    means[mine], scales[mine] = own.means, own.scales
    theta = twin.scan_state.theta * (factor if twin.joint.type == "prismatic" else 1.0)
    return replace(
        twin,
        gaussians=replace(g, means=means, scales=scales),
        joint=twin.joint.move(S),
        scan_state=replace(twin.scan_state, theta=theta),
    )


def light_gains(light: LightChange) -> Array:
    """Compute the factors (3,) on linear colors; a change of the temperature alone keeps the luminance of white."""
    if light.temperature_k == LightChange().temperature_k:
        return np.full(3, light.intensity)
    tint = _blackbody_rgb(light.temperature_k) / _blackbody_rgb(LightChange().temperature_k)
    luminance = np.linalg.inv(RGB_OF_XYZ)[1] @ tint
    return light.intensity * tint / luminance


def material_matrix(material: MaterialChange) -> Array:
    """Compute the matrix (3, 3) that changes the hue, saturation and brightness of linear colors.

    Colors are rotated about the gray axis by the hue, [rad], their distance from this axis is multiplied by the saturation,
    and the result is multiplied by the brightness.
    """
    grey = np.full((3, 3), 1 / 3)
    turn = matrix_from_rotvec(material.hue * np.ones(3) / np.sqrt(3))
    return material.brightness * (grey + material.saturation * turn @ (np.eye(3) - grey))


def _blackbody_rgb(temperature_k: float) -> Array:
    """Compute the linear sRGB color (3,) of a black body at 1667 to 25 000 K, with luminance Y = 1.

    Source: Kim et al. 2002, "Design of advanced color temperature control system for HDTV applications".
    """
    if not 1667 <= temperature_k <= 25_000:
        raise ValueError(f"a color temperature of {temperature_k:g} K, expected 1667 to 25000")
    t = 1e3 / temperature_k
    warm = temperature_k <= 4000
    x = np.polyval(
        (-0.2661239, -0.2343589, 0.8776956, 0.179910)
        if warm
        else (-3.0258469, 2.1070379, 0.2226347, 0.240390),
        t,
    )
    if temperature_k <= 2222:
        y = np.polyval((-1.1063814, -1.34811020, 2.18555832, -0.20219683), x)
    elif warm:
        y = np.polyval((-0.9549476, -1.37418593, 2.09137015, -0.16748867), x)
    else:
        y = np.polyval((3.0817580, -5.87338670, 3.75112997, -0.37001483), x)
    return np.array(RGB_OF_XYZ) @ np.array([x / y, 1.0, (1 - x - y) / y])


def _with_gains(twin: TwinModel, gains: Array) -> TwinModel:
    relit = twin.relit
    if relit is not None:
        residuals = tuple(_scale_residual(relit, item, gains) for item in relit.residuals)
        relit = replace(
            relit, lights=tuple(light.scale_by(gains) for light in relit.lights), residuals=residuals
        )
    return replace(twin, gaussians=twin.gaussians.illuminate(gains), relit=relit)


def _scale_residual(relit: Relit, item: ResidualAppearance, gains: Array) -> ResidualAppearance:
    """Compute the residual colors after observed and relit colors are multiplied by factors (3,), linear."""
    rows, lit = item.rows, np.empty(item.difference_srgb.shape)
    radiance = np.stack([light.view_from(item.Rs_world_body) for light in relit.lights])
    for number, seen_light in enumerate(radiance):
        mine = relit.light_of[rows] == number
        lit[:, mine] = relit.albedo_linear[rows[mine]] * (relit.transfer[rows[mine]] @ seen_light)
    seen = np.clip(srgb_from_linear(np.minimum(lit, 1)) + item.difference_srgb, 0, 1)
    difference = illuminate_srgb(seen, gains) - srgb_from_linear(np.minimum(lit * gains, 1))
    return replace(item, difference_srgb=difference.astype(np.float32))


def _with_turned_light(twin: TwinModel, R: Array) -> TwinModel:
    """Rotate all light by R (3, 3), including the observed orientations of residual colors."""
    relit, directional = twin.relit, twin.directional_light
    if relit is not None:
        relit = replace(
            relit,
            lights=tuple(light.turn(R) for light in relit.lights),
            residuals=tuple(replace(item, Rs_world_body=R @ item.Rs_world_body) for item in relit.residuals),
        )
    if directional is not None:
        directional = replace(directional, directions=directional.directions @ R.T)
    return replace(twin, relit=relit, directional_light=directional)


def _with_material(twin: TwinModel, matrix: Array) -> TwinModel:
    bodies, colors = [twin.body(OBJECT), twin.body(PART)], twin.gaussians.colors_srgb
    mine = np.isin(twin.bodies, bodies)
    colors[mine] = srgb_from_linear(linear_from_srgb(np.maximum(colors[mine], 0)) @ matrix.T)
    relit = _with_albedo(twin.relit, np.isin(twin.relit_bodies, bodies), matrix)
    return replace(twin, gaussians=twin.gaussians.recolor(colors), relit=relit)


def _with_albedo(relit: Relit | None, rows: NDArray[np.bool_], matrix: Array) -> Relit | None:
    if relit is None:
        return None
    albedo = np.array(relit.albedo_linear)
    albedo[rows] = np.clip(albedo[rows] @ matrix.T, 0, 1)
    return replace(relit, albedo_linear=albedo)
