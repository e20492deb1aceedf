"""Colors of the robot's surface that depend on the orientation of its links, fitted to all images.

The color of a disc is the color of its material for the disc's normal (nine harmonics in the world frame, so the light does not
rotate with the links), times the ratio of the disc to its material, plus the residual that was observed near this orientation of
its link, plus a specular term that depends on the direction of view.
"""

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.appearance.surfel_observations import SurfelObservations
from aomgen.conventions import linear_from_srgb, srgb_from_linear
from aomgen.core.gaussians import Gaussians
from aomgen.core.light import light_from_harmonics, open_transfer
from aomgen.core.sh import sh_basis
from aomgen.core.values import Array, freeze_arrays
from aomgen.twin.relighting import NEGLIGIBLE, Relit, ResidualAppearance, orientation_weights

# Rotation over which the weight of an observed residual decreases. The highlights of a link move twice as fast as the link. On
# images between the fitted ones, half and twice this value were worse or no better.
REACH_RAD: Final = float(np.radians(10.0))
# Distance between the orientations at which residual colors are stored, as a share of REACH_RAD.
SPACING: Final = 1.5
# Alternations of the least-squares fits.
ROUNDS: Final = 4
# Linear colors below this are treated as black; otherwise the slope of sRGB would give them too much weight.
BLACK: Final = 0.003
# Regularization of a disc towards its material, in observations of one pixel.
DISC_PULL: Final = 1.0
# Regularization of a material towards all others, relative to the data: it determines only unobserved directions.
MATERIAL_PULL: Final = 1e-3
# Largest ratio of the brightness of a disc to that of its material, and of its inverse.
MAX_RATIO: Final = 5.0
# Number of nearest observed discs whose mean is the color of an unobserved disc.
NEIGHBORS: Final = 6
# Regularization of the specular term towards zero, in observations (their weight is the root of their pixels).
SPECULAR_PULL: Final = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotDiscs:
    """M discs on the robot's surface, body frames.

    Attributes:
        bodies: Body of every disc, index into the twin's `body_names`.
        materials: Material of every disc, 0..P-1.
    """

    gaussians: Annotated[Gaussians, "M"]
    normals: Annotated[Array, "M 3"]
    bodies: Annotated[NDArray[np.int32], "M"]
    materials: Annotated[NDArray[np.int32], "M"]

    __post_init__ = freeze_arrays


def fit_robot_colors(observations: SurfelObservations, discs: RobotDiscs) -> tuple[Relit, Array]:
    """Fit colors of M discs to observations.

    Returns:
        The discs' diffuse appearance with one light for each material and indices 0..M-1; and harmonics of bands 1 and 2
        (M, 8, 3) that add the specular term to the color, body frames.
    """
    R = observations.Ts_world_body[observations.image_index, discs.bodies[observations.disc], :3, :3]
    answers = open_transfer(np.einsum("nij,nj->ni", R, discs.normals[observations.disc])).astype(np.float64)
    seen = np.asarray(linear_from_srgb(observations.color_srgb), np.float64)
    ratio, radiance, lit = _fit(observations, discs, answers, seen)
    # The colors are lit as in the twin and clipped to the range of an image.
    predicted = np.asarray(srgb_from_linear(np.clip(ratio[observations.disc] * lit, 0, 1)))
    difference = observations.color_srgb - predicted
    views = sh_basis(observations.directions_body, 2)[:, 1:]
    specular, remembered = np.zeros((len(discs.bodies), 8, 3)), ()
    for _ in range(ROUNDS):
        from_specular = np.einsum("nk,nkc->nc", views, specular[observations.disc])
        remembered = _fit_residual_colors(observations, discs, difference - from_specular)
        left = difference - _predict_residual_colors(observations, discs, remembered)
        specular = _fit_specular(observations, views, left, len(discs.bodies))
    seen_discs = np.bincount(observations.disc, minlength=len(discs.bodies)) > 0
    relit = Relit(
        indices=np.arange(len(discs.bodies)),
        albedo_linear=_spread(ratio, seen_discs, discs).astype(np.float32),
        transfer=open_transfer(discs.normals),
        light_of=discs.materials,
        lights=tuple(light_from_harmonics(item) for item in radiance),
        residuals=remembered,
    )
    return relit, specular


def _fit_specular(observations: SurfelObservations, views: Array, left: Array, count: int) -> Array:
    """Fit harmonics (M, 8, 3) to the residuals (N, 3), separately for each disc and regularized towards zero."""
    weights, disc = np.sqrt(observations.pixels), observations.disc
    normal, right = np.empty((count, 8, 8)), np.empty((count, 8, 3))
    for i in range(8):
        for j in range(i + 1):
            moment = np.bincount(disc, weights * views[:, i] * views[:, j], count)
            normal[:, i, j] = normal[:, j, i] = moment
        right[:, i] = _per_disc(disc, (weights * views[:, i])[:, None] * left, count)
    return np.asarray(np.linalg.solve(normal + SPECULAR_PULL * np.eye(8), right), np.float64)


def _predict_residual_colors(
    observations: SurfelObservations, discs: RobotDiscs, memories: tuple[ResidualAppearance, ...]
) -> Array:
    """Compute the colors (N, 3) that stored residuals add to the observations."""
    result = np.zeros((len(observations.disc), 3))
    owners = discs.bodies[observations.disc]
    for memory in memories:
        mine = np.flatnonzero(owners == memory.body)
        Rs = observations.Ts_world_body[:, memory.body, :3, :3]
        weights = orientation_weights(memory.Rs_world_body, Rs, REACH_RAD)[observations.image_index[mine]]
        column = np.searchsorted(memory.rows, observations.disc[mine])
        for k in range(len(memory.Rs_world_body)):
            near = np.flatnonzero(weights[:, k] > NEGLIGIBLE)
            result[mine[near]] += weights[near, k, None] * memory.difference_srgb[k, column[near]]
    return result


def _fit(
    observations: SurfelObservations, discs: RobotDiscs, answers: Array, seen: Array
) -> tuple[Array, Array, Array]:
    """Fit ratios (M, 3), radiance (P, 9, 3) and lit colors (N, 3) by alternating weighted least squares.

    Errors are weighted by the slope of sRGB, so that they are differences of sRGB values.
    """
    disc, pixels = observations.disc, observations.pixels[:, None]
    materials = discs.materials[disc]
    ratio = np.ones((len(discs.bodies), 3))
    predicted, radiance = seen, np.zeros((int(discs.materials.max()) + 1, 9, 3))
    lit = np.zeros_like(seen)
    for _ in range(ROUNDS):
        weights = _srgb_slope(predicted) ** 2 * pixels
        common = _radiance(answers, ratio[disc], seen, weights, np.zeros((9, 3)))
        for material in range(len(radiance)):
            mine = materials == material
            if not mine.any():
                radiance[material] = common
                continue
            near = common * (seen[mine].mean() / max(float((answers[mine] @ common).mean()), BLACK))
            radiance[material] = _radiance(answers[mine], ratio[disc[mine]], seen[mine], weights[mine], near)
            lit[mine] = np.maximum(answers[mine] @ radiance[material], BLACK / 10)
        above = _per_disc(disc, weights * seen * lit, len(ratio))
        below = _per_disc(disc, weights * lit**2, len(ratio))
        pull = DISC_PULL * np.median((weights * lit**2) / pixels, 0)
        ratio = np.clip((above + pull) / (below + pull), 1 / MAX_RATIO, MAX_RATIO)
        predicted = ratio[disc] * lit
    return ratio, radiance, lit


def _radiance(answers: Array, ratio: Array, seen: Array, weights: Array, near: Array) -> Array:
    """Fit the radiance (9, 3) that explains observed colors (N, 3), regularized towards the radiance `near`."""
    result = np.empty((9, 3))
    for channel in range(3):
        A = answers * ratio[:, channel : channel + 1]
        weighted = A * weights[:, channel : channel + 1]
        normal = weighted.T @ A
        pull = MATERIAL_PULL * np.trace(normal) / 9
        right = weighted.T @ seen[:, channel] + pull * near[:, channel]
        result[:, channel] = np.linalg.solve(normal + pull * np.eye(9), right)
    return result


def _fit_residual_colors(
    observations: SurfelObservations, discs: RobotDiscs, difference: Array
) -> tuple[ResidualAppearance, ...]:
    """Average the residuals of every body's observations near a few of its orientations."""
    memories = []
    owners = discs.bodies[observations.disc]
    for body in np.unique(discs.bodies):
        rows = np.flatnonzero(discs.bodies == body)
        mine = np.flatnonzero(owners == body)
        if not len(mine):
            continue
        Rs = observations.Ts_world_body[:, body, :3, :3]
        chosen = _select_spaced(Rs, SPACING * REACH_RAD)
        # The weights are not normalized: an image far from all selected orientations contributes to none of them.
        kernel = orientation_weights(Rs[chosen], Rs, REACH_RAD)
        column = np.searchsorted(rows, observations.disc[mine])
        weights = kernel[observations.image_index[mine]] * observations.pixels[mine, None]
        remembered = np.zeros((len(chosen), len(rows), 3))
        for k in range(len(chosen)):
            below = np.bincount(column, weights[:, k], len(rows)) + DISC_PULL
            above = _per_disc(column, weights[:, k, None] * difference[mine], len(rows))
            remembered[k] = above / below[:, None]
        memories.append(
            ResidualAppearance(
                body=int(body),
                rows=rows,
                Rs_world_body=Rs[chosen],
                difference_srgb=remembered.astype(np.float32),
                reach_rad=REACH_RAD,
            )
        )
    return tuple(memories)


def _select_spaced(Rs: Array, spacing_rad: float) -> NDArray[np.int64]:
    """Select from orientations (T, 3, 3) the first, then repeatedly the one farthest from all selected, until all are near one."""
    chosen = [0]
    nearest = _turn(Rs, Rs[0])
    while nearest.max() > spacing_rad:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, _turn(Rs, Rs[chosen[-1]]))
    return np.array(chosen)


def _turn(Rs: Array, R: Array) -> Array:
    return np.arccos(np.clip((np.einsum("tij,ij->t", Rs, R) - 1) / 2, -1, 1))


def _spread(ratio: Array, seen: NDArray[np.bool_], discs: RobotDiscs) -> Array:
    """Fill the ratios (M, 3) of unobserved discs with the mean of their nearest observed neighbors."""
    result, means = ratio.copy(), discs.gaussians.means.astype(np.float64)
    groups = np.stack([discs.bodies, discs.materials], 1)
    for body, material in np.unique(groups[~seen], axis=0):
        mine = (discs.bodies == body) & (discs.materials == material)
        known, unknown = np.flatnonzero(mine & seen), np.flatnonzero(mine & ~seen)
        if len(known):
            k = min(NEIGHBORS, len(known))
            _, nearest = cKDTree(means[known]).query(means[unknown], k=k)
            result[unknown] = ratio[known][nearest.reshape(-1, k)].mean(1)
    return result


def _srgb_slope(linear: Array) -> Array:
    """Compute the derivative of sRGB with respect to linear light."""
    step = 1e-4
    at = np.clip(linear, BLACK, 1)
    return (np.asarray(srgb_from_linear(at + step)) - np.asarray(srgb_from_linear(at))) / step


def _per_disc(disc: NDArray[np.int64], values: Array, count: int) -> Array:
    return np.stack([np.bincount(disc, values[:, c], count).astype(np.float64) for c in range(3)], 1)
