"""Surfaces that are lit anew as they turn, and what a camera has seen of them before."""

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.light import Light, shaded_srgb
from aomgen.core.values import Array, freeze_arrays, require_indices

# Weights below this are as good as none.
NEGLIGIBLE: Final = 1e-3
# Where the views' weights add up to less than this, the residual fades out.
FULL_WEIGHT: Final = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualAppearance:
    """How a body's surfaces looked in orientations that were seen, beyond what diffuse light explains.

    Specular light, and the shadow that one link throws on the next, return where the body comes back to an
    orientation and fade out away from it.

    Attributes:
        body: Index into the twin's `body_names`.
        rows: Relit surfaces (R,) of that body, as rows of `Relit`.
        Rs_world_body: Orientations that were seen (K, 3, 3).
        difference_srgb: Seen minus lit colors (K, R, 3).
        reach_rad: Rotation over which a residual fades: the standard deviation of its weight.
    """

    body: int
    rows: Annotated[NDArray[np.int64], "R"]
    Rs_world_body: Annotated[Array, "K 3 3"]
    difference_srgb: Annotated[NDArray[np.float32], "K R 3"]
    reach_rad: float

    __post_init__ = freeze_arrays

    def weights(self, R_world_body: Array) -> Array:
        """Weight (K,) of every orientation seen from one (3, 3); they add up to 1 near any of them."""
        return orientation_weights(self.Rs_world_body, R_world_body[None], self.reach_rad)[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Relit:
    """Surfaces whose color follows the light as they turn.

    Attributes:
        indices: Which Gaussians of the twin (M,).
        albedo_linear: (M, 3), >= 0.
        transfer: (M, 9), in the body's frame; see `core.light`.
        light_of: (M,) index into `lights`.
        lights: What they are lit by, world frame. Materials that do not only scatter light, like
            metal, have their own.
        residuals: Seen colors, at most one entry a body.
    """

    indices: Annotated[NDArray[np.int64], "M"]
    albedo_linear: Annotated[NDArray[np.float32], "M 3"]
    transfer: Annotated[NDArray[np.float32], "M 9"]
    light_of: Annotated[NDArray[np.int32], "M"]
    lights: tuple[Light, ...]
    residuals: tuple[ResidualAppearance, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.indices)
        freeze_arrays(self)
        require_indices(self.light_of, len(self.lights))
        for residual in self.residuals:
            require_indices(residual.rows, count)

    def select(self, which: NDArray[np.bool_]) -> "Relit":
        """What is left when a twin keeps a part of its N Gaussians, boolean mask (N,)."""
        kept = which[self.indices]
        row = np.cumsum(kept) - 1
        return Relit(
            indices=(np.cumsum(which) - 1)[self.indices[kept]],
            albedo_linear=self.albedo_linear[kept],
            transfer=self.transfer[kept],
            light_of=self.light_of[kept],
            lights=self.lights,
            residuals=tuple(
                ResidualAppearance(
                    body=item.body,
                    rows=row[item.rows[kept[item.rows]]],
                    Rs_world_body=item.Rs_world_body,
                    difference_srgb=item.difference_srgb[:, kept[item.rows]],
                    reach_rad=item.reach_rad,
                )
                for item in self.residuals
            ),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LitSurface:
    """Relit Gaussians of one body under one light.

    Attributes:
        body: Index into the twin's `body_names`.
        rows: Which rows of `Relit` (M,).
        albedo_linear, transfer: (M, 3) and (M, 9).
        light: What lights them, world frame.
        residual: Seen colors of exactly these rows, or None.
    """

    body: int
    rows: NDArray[np.int64]
    albedo_linear: NDArray[np.float32]
    transfer: NDArray[np.float32]
    light: Light
    residual: ResidualAppearance | None

    def colors_srgb(self, R_world_body: Array) -> Array:
        """Colors (M, 3), sRGB 0..1, in an orientation (3, 3) of the body."""
        colors = shaded_srgb(self.albedo_linear, self.transfer, self.light.seen_from(R_world_body))
        if self.residual is None:
            return colors
        for weight, difference in zip(
            self.residual.weights(R_world_body), self.residual.difference_srgb, strict=True
        ):
            if weight > NEGLIGIBLE:
                colors = colors + weight * difference
        return np.clip(colors, 0, 1)


def surfaces_of(relit: Relit | None, bodies: NDArray[np.int32]) -> tuple[LitSurface, ...]:
    """The relit Gaussians of a twin by body, then by light; `bodies` (N,) of all its Gaussians."""
    if relit is None:
        return ()
    owners = bodies[relit.indices]
    residual_of = {item.body: item for item in relit.residuals}
    surfaces = []
    for body, light in np.unique(np.stack([owners, relit.light_of], 1), axis=0).tolist():
        rows = np.flatnonzero((owners == body) & (relit.light_of == light))
        residual = residual_of.get(body)
        if residual is not None:
            column = np.full(len(owners), -1)
            column[residual.rows] = np.arange(len(residual.rows))
            columns = column[rows]
            residual = None if (columns < 0).any() else ResidualAppearance(
                body=body,
                rows=rows,
                Rs_world_body=residual.Rs_world_body,
                difference_srgb=residual.difference_srgb[:, columns],
                reach_rad=residual.reach_rad,
            )  # fmt: skip
        surfaces.append(
            LitSurface(
                body=body,
                rows=rows,
                albedo_linear=relit.albedo_linear[rows],
                transfer=relit.transfer[rows],
                light=relit.lights[light],
                residual=residual,
            )
        )
    return tuple(surfaces)


def join_relit(first: Relit | None, second: Relit) -> Relit:
    """Surfaces of both, whose indices already mean the same twin."""
    if first is None:
        return second
    count = len(first.indices)
    return Relit(
        indices=np.concatenate([first.indices, second.indices]),
        albedo_linear=np.concatenate([first.albedo_linear, second.albedo_linear]),
        transfer=np.concatenate([first.transfer, second.transfer]),
        light_of=np.concatenate([first.light_of, second.light_of + len(first.lights)]),
        lights=(*first.lights, *second.lights),
        residuals=(
            *first.residuals,
            *(
                ResidualAppearance(
                    body=item.body,
                    rows=item.rows + count,
                    Rs_world_body=item.Rs_world_body,
                    difference_srgb=item.difference_srgb,
                    reach_rad=item.reach_rad,
                )
                for item in second.residuals
            ),
        ),
    )


def orientation_weights(Rs_seen: Array, Rs: Array, reach_rad: float) -> Array:
    """Weights (T, K) of K seen orientations (K, 3, 3) for T orientations (T, 3, 3)."""
    cosines = (np.einsum("tij,kij->tk", Rs, Rs_seen) - 1) / 2
    turns = np.arccos(np.clip(cosines, -1, 1))
    weights = np.exp(-0.5 * (turns / reach_rad) ** 2)
    return weights / np.maximum(weights.sum(-1, keepdims=True), FULL_WEIGHT)
