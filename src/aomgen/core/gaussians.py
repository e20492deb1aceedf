"""A set of 3D Gaussians as an immutable value."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.conventions import illuminate_srgb
from aomgen.core.sh import rotate_sh
from aomgen.core.transforms import apply, quat_from_matrix, quat_multiply, similarity_parts
from aomgen.core.values import Array, freeze_arrays

# The real spherical harmonic of degree 0, which is constant: sqrt(1 / (4 pi)).
SH_C0 = 0.28209479177387814
# sRGB values below this are too dark for meaningful ratios.
BLACK = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Gaussians:
    """N Gaussians with real values: scales in meters, opacities in 0..1 (no logarithms, no logits).

    Attributes:
        means: Centers (N, 3) float32, [m].
        quats: Rotations (N, 4) float32, wxyz, unit.
        scales: Standard deviations along the rotated axes (N, 3) float32, [m].
        opacities: (N,) float32, 0..1.
        sh: Spherical harmonics (N, K, 3) float32, K = 1, 4, 9 or 16; sRGB color = 0.5 + SH.
    """

    means: Annotated[NDArray[np.float32], "N 3"]
    quats: Annotated[NDArray[np.float32], "N 4"]
    scales: Annotated[NDArray[np.float32], "N 3"]
    opacities: Annotated[NDArray[np.float32], "N"]
    sh: Annotated[NDArray[np.float32], "N _ 3"]

    __post_init__ = freeze_arrays

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree 0..3 of the stored coefficients."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    def select(self, which: NDArray[np.bool_ | np.integer]) -> "Gaussians":
        """Select the Gaussians of a boolean mask or an index array."""
        return Gaussians(
            means=self.means[which],
            quats=self.quats[which],
            scales=self.scales[which],
            opacities=self.opacities[which],
            sh=self.sh[which],
        )

    def transform(self, S: ArrayLike) -> "Gaussians":
        """Transform the Gaussians, including their SH coefficients, by a rigid transform or similarity (4, 4)."""
        scale, R, _ = similarity_parts(S)
        return gaussians_of(
            means=apply(S, self.means),
            quats=quat_multiply(quat_from_matrix(R), self.quats),
            scales=self.scales * scale,
            opacities=self.opacities,
            sh=rotate_sh(self.sh, R),
        )

    def with_sh(self, sh: ArrayLike) -> "Gaussians":
        """Replace the SH coefficients by others (N, K, 3)."""
        return gaussians_of(
            means=self.means, quats=self.quats, scales=self.scales, opacities=self.opacities, sh=sh
        )

    @property
    def colors_srgb(self) -> Array:
        """Mean colors (N, 3) over all viewing directions, sRGB, not limited to 0..1."""
        return 0.5 + SH_C0 * self.sh[:, 0].astype(np.float64)

    def recolor(self, colors_srgb: Array) -> "Gaussians":
        """Replace the mean colors by others (N, 3), sRGB; view-dependent colors are scaled in proportion."""
        before = self.colors_srgb
        sh = self.sh * np.where(before > BLACK, colors_srgb / np.maximum(before, BLACK), 1.0)[:, None]
        sh[:, 0] = (colors_srgb - 0.5) / SH_C0
        return self.with_sh(sh)

    def illuminate(self, factors: ArrayLike) -> "Gaussians":
        """Multiply the linear colors by factors (N, 3) or (N, 1)."""
        before = self.colors_srgb
        return self.recolor(np.where(before > 0, illuminate_srgb(before, factors), before))

    def with_sh_degree(self, degree: int) -> "Gaussians":
        """Truncate or zero-pad the SH coefficients to a degree 0..3."""
        want, have = (degree + 1) ** 2, self.sh.shape[1]
        sh = np.zeros((len(self), want, 3), np.float32)
        sh[:, : min(want, have)] = self.sh[:, : min(want, have)]
        return self.with_sh(sh)


def gaussians_of(
    *, means: ArrayLike, quats: ArrayLike, scales: ArrayLike, opacities: ArrayLike, sh: ArrayLike
) -> Gaussians:
    """Build Gaussians from arrays of any real type, rounded to float32; see `Gaussians` for shapes."""
    return Gaussians(
        means=np.asarray(means, np.float32),
        quats=np.asarray(quats, np.float32),
        scales=np.asarray(scales, np.float32),
        opacities=np.asarray(opacities, np.float32),
        sh=np.asarray(sh, np.float32),
    )


def concatenate(sets: list[Gaussians]) -> Gaussians:
    """Concatenate several sets in order, padded to the highest SH degree among them."""
    degree = max(item.sh_degree for item in sets)
    padded = [item.with_sh_degree(degree) for item in sets]
    return Gaussians(
        means=np.concatenate([item.means for item in padded]),
        quats=np.concatenate([item.quats for item in padded]),
        scales=np.concatenate([item.scales for item in padded]),
        opacities=np.concatenate([item.opacities for item in padded]),
        sh=np.concatenate([item.sh for item in padded]),
    )


def gaussians_from_points(
    points: ArrayLike, colors_srgb: NDArray[np.uint8], *, opacity: float = 0.3, size: float = 0.7
) -> Gaussians:
    """Make one isotropic Gaussian of SH degree 0 for each point.

    Args:
        points: Points (N, 3).
        colors_srgb: Colors (N, 3).
        opacity: Opacity of all Gaussians.
        size: Ratio of a Gaussian's standard deviation to the distance of its neighbors, see `neighbour_distances`.

    Raises:
        ValueError: There are fewer than two points, coordinates are not finite, or the shapes differ.

    Source: Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering", 2023, sec. 5.1.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or np.shape(colors_srgb) != points.shape:
        raise ValueError(
            f"points have shape {points.shape} and colors {np.shape(colors_srgb)}, expected (N, 3)"
        )
    scales = size * neighbour_distances(points)
    return gaussians_of(
        means=points,
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
        scales=np.repeat(scales[:, None], 3, axis=1),
        opacities=np.full(len(points), opacity),
        sh=((np.asarray(colors_srgb) / 255.0 - 0.5) / SH_C0)[:, None],
    )


def neighbour_distances(points: Array) -> Array:
    """Compute the root mean square distances (N,) of points (N, 3) to their three nearest neighbors.

    Distances are limited to the range from a thousandth of the median to the 99th percentile, so that no Gaussian has size
    zero and none covers the scene.

    Raises:
        ValueError: There are fewer than two distinct points, or coordinates are not finite.
    """
    # scipy is imported here, because rendering Gaussians requires only numpy.
    from scipy.spatial import cKDTree

    if not len(points) >= 2 or not np.isfinite(points).all():
        raise ValueError(f"{len(points)} points, expected at least two with finite coordinates")
    count = min(3, len(points) - 1)
    distances, _ = cKDTree(points).query(points, k=count + 1)
    spacing = np.sqrt((distances[:, 1:] ** 2).mean(1))
    apart = spacing[spacing > 0]
    if not len(apart):
        raise ValueError(f"{len(points)} points at one position, expected at least two positions")
    return np.clip(spacing, 1e-3 * np.median(apart), np.percentile(apart, 99))
