"""Soft shadow of an object on the surface below it, precomputed in the frame of the object."""

from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from aomgen.core.gaussians import Gaussians
from aomgen.core.light import Light
from aomgen.core.sh import sh_basis, sphere_directions
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.lighting.plane_shadow import PlaneGrid, project_shadow
from aomgen.twin.twin import OBJECT, PART, TwinModel

# Cell size of a map of soft light, [m]; soft shadows have no finer details.
CELL: Final = 0.015
# The soft shadow is computed up to this distance from the object and fades out over the last third of it, [m].
REACH: Final = 0.35
# Number of directions of soft light on the sphere, half of which are above the plane; the map is smoothed afterwards.
SKY_DIRECTIONS: Final = 160
# Number of joint values, from limit to limit, at which the soft shadow is computed; other values are interpolated.
STATES: Final = 9
# Share of the blocked light that surrounding surfaces reflect into the shadow.
FILL: Final = 0.15
# Number of rendered pixels per cell of a map, along each side.
FINER: Final = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectShadow:
    """Visibility of light from D directions past an object, on the surface below it, at K joint values.

    Attributes:
        T_object_plane: Pose of the surface in the object frame (4, 4).
        grid: Cells of the maps.
        directions: Unit directions toward the light (D, 3), frame of the surface.
        thetas: Joint values of the maps (K,), [rad] or [m].
        visibility: Visible share of the light (D, K, rows, columns), 0..1.
    """

    T_object_plane: Matrix4
    grid: PlaneGrid
    directions: Annotated[Array, "D 3"]
    thetas: Annotated[Array, "K"]
    visibility: Annotated[NDArray[np.float32], "D K _ _"]

    __post_init__ = freeze_arrays

    def block(self, light: Light, T_world_object: ArrayLike) -> NDArray[np.float32]:
        """Compute the share (K, rows, columns) of the irradiance that the object at a pose (4, 4) blocks, for each joint value."""
        R = (np.asarray(T_world_object) @ self.T_object_plane)[:3, :3]
        radiance = (sh_basis(self.directions @ R.T, 2) @ light.radiance_sh).mean(1)
        weights = self.directions[:, 2] * np.maximum(radiance, 0)
        # einsum is used, because the rounding errors of a matrix product in a threaded BLAS may differ between calls.
        passed = np.einsum("d,dkij->kij", weights.astype(np.float32), self.visibility) / max(
            weights.sum(), 1e-9
        )
        blocked = np.stack([gaussian_filter((1 - FILL) * (1 - share), 1.0) for share in passed])
        # The factor of the fade is the distance of a cell from the border, relative to a third of the reach, at most 1.
        rows, columns = (np.minimum(np.arange(n), n - 1 - np.arange(n)) for n in passed.shape[1:])
        fade = np.clip(np.minimum(rows[:, None], columns) * CELL / (REACH / 3), 0, 1)
        return (blocked * fade).astype(np.float32)

    def interpolate(self, maps: NDArray[np.float32], thetas: Array) -> NDArray[np.float32]:
        """Interpolate the maps (K, rows, columns) of all joint values linearly at joint values (T,), [rad] or [m]."""
        place = np.interp(thetas, self.thetas, np.arange(len(self.thetas)))
        weights = np.maximum(1 - np.abs(place[:, None] - np.arange(len(self.thetas))), 0)
        return np.einsum("tk,kij->tij", weights.astype(np.float32), maps)

    def scale_by(self, factor: float, prismatic: bool) -> "ObjectShadow":
        """Scale the shadow with its object about the origin of the object frame."""
        T = np.array(self.T_object_plane)
        T[:3, 3] *= factor
        grid = replace(self.grid, low=self.grid.low * factor, cell=self.grid.cell * factor)
        thetas = self.thetas * factor if prismatic else self.thetas
        return replace(self, T_object_plane=T, grid=grid, thetas=thetas)


def tabulate_object_shadow(
    twin: TwinModel, T_world_plane: ArrayLike, threads: int | None = None
) -> ObjectShadow | None:
    """Compute the shadow of a twin's relit object on a plane below it; None if the twin has no such object.

    Args:
        twin: Twin with an object.
        T_world_plane: Pose of the plane (4, 4).
        threads: See `splatting.rasterizer.render`.
    """
    lit = np.isin(np.arange(len(twin.bodies)), [] if twin.relit is None else twin.relit.indices)
    static, part = (twin.gaussians.select(lit & (twin.bodies == twin.body(name))) for name in (OBJECT, PART))
    if not len(static):
        return None
    T_object_plane = invert(twin.T_world_object) @ np.asarray(T_world_plane, np.float64)
    T_plane_object, joint = invert(T_object_plane), twin.joint
    thetas: Array = np.linspace(joint.lower, max(joint.upper, joint.lower + 1e-6), STATES, dtype=np.float64)
    Ts_part = T_plane_object @ joint.motion(thetas)
    posed = [(T_plane_object, static), *((T, part) for T in Ts_part)]
    points = np.concatenate([apply(T, body.means)[:, :2] for T, body in posed])
    low = points.min(0) - REACH
    columns, rows = np.ceil((points.max(0) + REACH - low) / CELL).astype(int).tolist()
    fine = PlaneGrid(low=low, cell=CELL / FINER, columns=FINER * columns, rows=FINER * rows)
    directions = sphere_directions(SKY_DIRECTIONS)
    directions = directions[directions[:, 2] > 0]

    def measure_visibility(body: Gaussians, T_plane_body: Array) -> NDArray[np.float32]:
        blocked = project_shadow(body, None, T_plane_body[None, None], directions, fine, threads)[0]
        return 1 - blocked.reshape(len(directions), rows, FINER, columns, FINER).mean((2, 4))

    around = measure_visibility(static, T_plane_object)
    return ObjectShadow(
        T_object_plane=T_object_plane,
        grid=PlaneGrid(low=low, cell=CELL, columns=columns, rows=rows),
        directions=directions,
        thetas=thetas,
        visibility=np.stack([around * measure_visibility(part, T) for T in Ts_part], 1),
    )
