"""Record the contacts of the robot with other bodies: they are copied at every tick and selected once per run."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array, freeze_arrays
from aomgen.simulation.scene import Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class Touches:
    """C contacts of the robot with other bodies, ordered by tick.

    Attributes:
        ticks: Tick of each contact (C,).
        robot_geoms, other_geoms: Geoms in contact (C,).
        distances: Distances between the geoms (C,), negative for overlaps, [m].
        points_world: Contact points (C, 3), [m].
        normals_world: Unit normals (C, 3), toward the robot.
        forces: Normal forces (C,), [N].
        forces_world: Total forces on the robot (C, 3), [N].
    """

    ticks: Annotated[NDArray[np.int64], "C"]
    robot_geoms: Annotated[NDArray[np.int64], "C"]
    other_geoms: Annotated[NDArray[np.int64], "C"]
    distances: Annotated[Array, "C"]
    points_world: Annotated[Array, "C 3"]
    normals_world: Annotated[Array, "C 3"]
    forces: Annotated[Array, "C"]
    forces_world: Annotated[Array, "C 3"]

    __post_init__ = freeze_arrays


class RawContacts(NamedTuple):
    """All C contacts at one tick in MuJoCo's form: geoms (C, 2), contact frames (C, 9), wrenches in these frames (C, 6)."""

    tick: int
    geoms: NDArray[np.int32]
    distances: Array
    points_world: Array
    frames: Array
    wrenches: Array


def read_contacts(model: mujoco.MjModel, data: mujoco.MjData, tick: int) -> RawContacts:
    """Copy the current contacts for `find_touches`, because the next step overwrites them."""
    contact = data.contact
    wrenches = np.empty((data.ncon, 6))
    for index in range(data.ncon):
        mujoco.mj_contactForce(model, data, index, wrenches[index])
    return RawContacts(
        tick,
        contact.geom.copy(),
        contact.dist.copy(),
        contact.pos.copy(),
        contact.frame.copy(),
        wrenches,
    )


def find_touches(scene: Scene, contacts: list[RawContacts]) -> Touches:
    """Select the contacts of the robot with other bodies."""
    ticks = np.repeat([item.tick for item in contacts], [len(item.geoms) for item in contacts])
    geoms = np.concatenate([np.zeros((0, 2), np.int32), *(item.geoms for item in contacts)])
    robot = scene.roles.robot[geoms]
    kept = robot[:, 0] != robot[:, 1]

    def column(values: Iterable[Array], width: int) -> Array:
        return np.concatenate([np.zeros((0, width)), *values])[kept]

    # The robot's geom becomes the first of each pair. MuJoCo's normal points from the first geom to the second; here it points
    # toward the robot.
    ours = robot[kept, :1]
    pairs = np.where(ours, geoms[kept], geoms[kept, ::-1])
    frames = column((item.frames for item in contacts), 9) * np.where(ours, -1.0, 1.0)
    wrenches = column((item.wrenches for item in contacts), 6)
    return Touches(
        ticks=ticks[kept],
        robot_geoms=pairs[:, 0],
        other_geoms=pairs[:, 1],
        distances=np.concatenate([np.zeros(0), *(item.distances for item in contacts)])[kept],
        points_world=column((item.points_world for item in contacts), 3),
        normals_world=frames[:, :3],
        forces=wrenches[:, 0],
        forces_world=np.einsum("cij,ci->cj", frames.reshape(-1, 3, 3), wrenches[:, :3]),
    )
