"""Relighting of rotating surfaces, with residual colors that were observed in some orientations."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import srgb_from_linear
from aomgen.core.light import Light, rotate_radiance
from aomgen.core.values import Array, freeze_arrays, require_indices

# Weights below this are set to 0.
NEGLIGIBLE: Final = 1e-3
# Number of colors in a block of surfaces in all states; a block fits into the processor's cache.
BLOCK: Final = 8192
# Number of quantization steps of linear light; the darkest step is a tenth of a gray level.
LEVELS: Final = 1 << 14
# The residual fades out if the sum of the views' weights is less than this.
FULL_WEIGHT: Final = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualAppearance:
    """Residual colors of a body's R surfaces in K observed orientations, relative to diffuse shading.

    They represent specular light and shadows between links. They are applied if the orientation of the body is close to an
    observed one, and fade out with the angle between the two.

    Attributes:
        body: Index into the twin's `body_names`.
        rows: Relit surfaces of that body, as rows of `Relit` (R,).
        Rs_world_body: Observed orientations (K, 3, 3).
        difference_srgb: Observed minus relit colors (K, R, 3), sRGB.
        reach_rad: Angle over which a residual fades out, [rad]: standard deviation of its weight.
    """

    body: int
    rows: Annotated[NDArray[np.int64], "R"]
    Rs_world_body: Annotated[Array, "K 3 3"]
    difference_srgb: Annotated[NDArray[np.float32], "K R 3"]
    reach_rad: float

    __post_init__ = freeze_arrays

    def weights(self, Rs_world_body: Array) -> Array:
        """Compute the weights (T, K) of the observed orientations at orientations (T, 3, 3); close to one, their sum is 1."""
        return orientation_weights(self.Rs_world_body, Rs_world_body, self.reach_rad)


@dataclass(frozen=True, slots=True, kw_only=True)
class Relit:
    """M surfaces whose colors depend on their orientation in the light.

    Attributes:
        indices: Indices of the surfaces among the Gaussians of the twin (M,).
        albedo_linear: Linear albedo (M, 3), >= 0.
        transfer: Transfer harmonics (M, 9) in the frame of the body; see `core.light`.
        light_of: Index into `lights` (M,).
        lights: Lights, world frame. Materials that are not purely diffuse, for example metal, have separate lights.
        residuals: Residual colors, at most one entry for each body.
    """

    indices: Annotated[NDArray[np.int64], "M"]
    albedo_linear: Annotated[NDArray[np.float32], "M 3"]
    transfer: Annotated[NDArray[np.float32], "M 9"]
    light_of: Annotated[NDArray[np.int32], "M"]
    lights: tuple[Light, ...]
    residuals: tuple[ResidualAppearance, ...] = ()

    def __post_init__(self) -> None:
        freeze_arrays(self)
        require_indices(self.light_of, len(self.lights))
        for residual in self.residuals:
            require_indices(residual.rows, len(self.indices))

    def select(self, which: NDArray[np.bool_]) -> "Relit":
        """Select the surfaces and residuals of those of the twin's N Gaussians that a mask (N,) selects."""
        kept = which[self.indices]
        row = np.cumsum(kept) - 1
        residuals = []
        for item in self.residuals:
            mine = kept[item.rows]
            difference = item.difference_srgb[:, mine]
            residuals.append(replace(item, rows=row[item.rows[mine]], difference_srgb=difference))
        return Relit(
            indices=(np.cumsum(which) - 1)[self.indices[kept]],
            albedo_linear=self.albedo_linear[kept],
            transfer=self.transfer[kept],
            light_of=self.light_of[kept],
            lights=self.lights,
            residuals=tuple(residuals),
        )

    def colors_srgb(self, owners: NDArray[np.int32], Ts_world_body: Array) -> NDArray[np.float32]:
        """Compute the colors (T, M, 3), sRGB 0..1, in T states.

        Args:
            owners: Body of every surface (M,).
            Ts_world_body: Body poses (T, B, 4, 4).
        """
        lit = Relighting(self, owners)
        colors = np.empty((len(Ts_world_body), len(owners), 3), np.float32)
        colors[:, lit.order] = lit.colors_srgb(Ts_world_body)
        return colors


class Relighting:
    """Relighting of surfaces in many states, with an error of at most a tenth of a gray level.

    Args:
        relit: M surfaces.
        owners: Body of every surface (M,).

    Attributes:
        order: Indices (M,) of the surfaces in the order of the colors; surfaces of one body and light are contiguous.
    """

    def __init__(self, relit: Relit, owners: NDArray[np.int32]) -> None:
        groups = owners.astype(np.int64) * len(relit.lights) + relit.light_of
        self.order = np.argsort(groups, kind="stable")
        self._count, self._bodies = len(owners), np.unique(owners).tolist()
        self._radiance = LEVELS * np.concatenate(
            [np.zeros((9, 0)), *(light.radiance_sh for light in relit.lights)], 1
        )
        found, starts = np.unique(groups[self.order], return_index=True)
        ends = [*starts[1:].tolist(), self._count]
        # Each group holds a body, a light, the index of its first surface, and transfer times albedo by channel (3, R, 9).
        self._groups = [
            (*divmod(group, len(relit.lights)), start, _compute_color_transfer(relit, self.order[start:end]))
            for group, start, end in zip(found.tolist(), starts.tolist(), ends, strict=True)
        ]
        place = np.empty(self._count, np.int64)
        place[self.order] = np.arange(self._count)
        # Each entry holds a residual, its surfaces in the order of the colors, and their observed differences (K, 3 R).
        self._residuals = []
        for residual in relit.residuals:
            rows = place[residual.rows]
            sorting = np.argsort(rows)
            difference = residual.difference_srgb[:, sorting]
            self._residuals.append((residual, rows[sorting], difference.reshape(len(difference), -1)))

    def colors_srgb(self, Ts_world_body: Array) -> NDArray[np.float32]:
        """Compute the colors (T, M, 3), sRGB 0..1, for body poses (T, B, 4, 4); the surfaces are in the order of `order`."""
        Rs, size = Ts_world_body[..., :3, :3], max(BLOCK // len(Ts_world_body), 1)
        colors = np.empty((len(Rs), self._count, 3), np.float32)
        # Equal consecutive orientations are evaluated once, for all lights together.
        new = np.concatenate([np.ones((1, Rs.shape[1]), bool), (Rs[1:] != Rs[:-1]).any((2, 3))])
        turns = [Rs[new[:, body], body] for body in self._bodies]
        firsts = dict(zip(self._bodies, np.cumsum([0, *map(len, turns)]).tolist(), strict=False))
        seen = rotate_radiance(self._radiance, np.concatenate([np.zeros((0, 3, 3)), *turns]))
        seen = np.ascontiguousarray(np.moveaxis(seen, -1, 0), np.float32)
        for body, light, start, transfer in self._groups:
            state_of = np.cumsum(new[:, body]) - 1
            lights = seen[3 * light : 3 * light + 3, firsts[body] : firsts[body] + state_of[-1] + 1]
            for first in range(0, transfer.shape[1], size):
                lit = _compute_block_colors(transfer[:, first : first + size], lights)
                block = slice(start + first, start + first + lit.shape[1])
                colors[:, block] = lit if len(lit) == len(Rs) else lit[state_of]
        for residual, rows, seen_srgb in self._residuals:
            weights = residual.weights(Rs[:, residual.body]).astype(np.float32)
            weights[weights <= NEGLIGIBLE] = 0
            for start in range(0, len(rows), size):
                block = _as_slice(rows[start : start + size])
                more = weights @ seen_srgb[:, 3 * start : 3 * (start + size)]
                more = more.reshape(len(Rs), -1, 3) + colors[:, block]
                colors[:, block] = np.clip(more, 0, 1, out=more)
        return colors


def _compute_color_transfer(relit: Relit, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Compute the product of transfer and albedo (3, R, 9) of some surfaces."""
    return relit.transfer[rows] * relit.albedo_linear[rows].T[..., None]


def _compute_block_colors(transfer: NDArray[np.float32], lights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the sRGB colors (T, R, 3) of diffuse surfaces, quantized to `LEVELS`.

    Matrix products of this size are not divided among threads, so that they always have the same rounding errors.

    Args:
        transfer: Transfer times albedo (3, R, 9).
        lights: Harmonics of the light in the frame of the surfaces (3, T, 9), times `LEVELS`.
    """
    levels = lights @ transfer.swapaxes(1, 2)
    levels += np.float32(0.5)
    return np.moveaxis(_srgb_table().take(levels.astype(np.int64), mode="clip"), 0, -1)


@cache
def _srgb_table() -> NDArray[np.float32]:
    return srgb_from_linear(np.arange(LEVELS + 1) / LEVELS).astype(np.float32)


def _as_slice(rows: NDArray[np.int64]) -> NDArray[np.int64] | slice:
    """Convert row indices to a slice if they are contiguous, because slicing is several times faster."""
    first, last = int(rows[0]), int(rows[-1])
    return slice(first, last + 1) if (np.diff(rows) == 1).all() else rows


def join_relit(first: Relit | None, second: Relit) -> Relit:
    """Concatenate two sets of surfaces, whose indices must refer to the same twin."""
    if first is None:
        return second
    moved = (replace(item, rows=item.rows + len(first.indices)) for item in second.residuals)
    return Relit(
        indices=np.concatenate([first.indices, second.indices]),
        albedo_linear=np.concatenate([first.albedo_linear, second.albedo_linear]),
        transfer=np.concatenate([first.transfer, second.transfer]),
        light_of=np.concatenate([first.light_of, second.light_of + len(first.lights)]),
        lights=(*first.lights, *second.lights),
        residuals=(*first.residuals, *moved),
    )


def orientation_weights(Rs_seen: Array, Rs: Array, reach_rad: float) -> Array:
    """Compute the weights (T, K) of K observed orientations (K, 3, 3) at T orientations (T, 3, 3).

    Args:
        Rs_seen: Observed orientations (K, 3, 3).
        Rs: Orientations (T, 3, 3).
        reach_rad: Standard deviation of the weights, [rad].
    """
    cosines = (np.einsum("tij,kij->tk", Rs, Rs_seen) - 1) / 2
    turns = np.arccos(np.clip(cosines, -1, 1))
    weights = np.exp(-0.5 * (turns / reach_rad) ** 2)
    return weights / np.maximum(weights.sum(-1, keepdims=True), FULL_WEIGHT)
