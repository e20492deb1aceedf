"""What a robot is made of, apart from its joints: what is seen, and the faces of its fingers."""

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.transforms import apply, transform
from aomgen.core.values import Array, freeze
from aomgen.robots.contact_faces import poses_at
from aomgen.robots.from_file import find_visible_geoms
from aomgen.robots.geom_meshes import geom_surface


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotMesh:
    """One visual mesh of the robot.

    Attributes:
        body: Index into `RobotModel.body_names`.
        vertices_body: (V, 3), body frame, [m].
        faces: (F, 3) vertex indices.
        color_srgb: Material color (3,), 0..1.
    """

    body: int
    vertices_body: Array
    faces: NDArray[np.int64]
    color_srgb: Array

    def __post_init__(self) -> None:
        freeze(self, "vertices_body", self.vertices_body, (None, 3))
        freeze(self, "faces", self.faces, (None, 3), np.int64)
        freeze(self, "color_srgb", self.color_srgb, (3,))


@dataclass(frozen=True, slots=True, kw_only=True)
class FingerPad:
    """The face with which one finger holds, as a box behind it.

    Attributes:
        finger: "left" or "right".
        body: Index into `RobotModel.body_names`.
        T_body_pad: Pose of the box (4, 4), z towards the other finger.
        half_extents: (3,), [m].
    """

    finger: str
    body: int
    T_body_pad: Array
    half_extents: Array

    def __post_init__(self) -> None:
        freeze(self, "T_body_pad", self.T_body_pad, (4, 4))
        freeze(self, "half_extents", self.half_extents, (3,))

    @property
    def normal_body(self) -> Array:
        """Unit direction (3,) from the pad towards the other finger, body frame."""
        return self.T_body_pad[:3, 2]

    @property
    def center_body(self) -> Array:
        """Middle of the box (3,), body frame, [m]."""
        return self.T_body_pad[:3, 3]

    @property
    def face_body(self) -> Array:
        """Middle of the face that looks at the other finger (3,), body frame, [m]."""
        return self.center_body + self.half_extents[2] * self.normal_body


@dataclass(frozen=True, slots=True, kw_only=True)
class HandDrive:
    """What a gripper value means to the hand.

    Attributes:
        driver: Finger joint that the value measures.
        driver_range: Its values at gripper 0 and 1 (2,), [rad] or [m].
        actuator: Closes the hand.
        control_range: Its control at gripper 0 and 1 (2,).
    """

    driver: str
    driver_range: tuple[float, float]
    actuator: str
    control_range: tuple[float, float]


def visual_meshes(model: mujoco.MjModel) -> tuple[RobotMesh, ...]:
    """What is seen of every body, triangles of primitive shapes included."""
    meshes = []
    for geom in np.flatnonzero(find_visible_geoms(model)):
        surface = geom_surface(model, int(geom))
        if surface is None:
            continue
        material = model.geom_matid[geom]
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        meshes.append(
            RobotMesh(
                body=int(model.geom_bodyid[geom]) - 1,
                vertices_body=surface[0],
                faces=surface[1],
                color_srgb=rgba[:3],
            )
        )
    return tuple(meshes)


def pads_of_boxes(model: mujoco.MjModel, geoms: Mapping[str, tuple[str, ...]]) -> tuple[FingerPad, ...]:
    """Finger pads from box geoms along the axes of their bodies, by side."""
    Ts = poses_at(model, model.qpos0[None])[0]
    boxes = {}
    for finger, names in geoms.items():
        ids = [model.geom(name).id for name in names]
        lower = np.min([model.geom_pos[i] - model.geom_size[i] for i in ids], 0)
        upper = np.max([model.geom_pos[i] + model.geom_size[i] for i in ids], 0)
        boxes[finger] = (int(model.geom_bodyid[ids[0]]), (lower + upper) / 2, (upper - lower) / 2)
    centers = {finger: apply(Ts[body], center) for finger, (body, center, _) in boxes.items()}
    pads = []
    for finger, (body, center, half) in boxes.items():
        others = np.mean([center for name, center in centers.items() if name != finger], 0)
        towards = Ts[body][:3, :3].T @ (others - centers[finger])
        axis = int(np.argmax(np.abs(towards)))
        z = np.sign(towards[axis]) * np.eye(3)[axis]
        x = np.eye(3)[(axis + 1) % 3]
        R = np.stack([x, np.cross(z, x), z], 1)
        pads.append(
            FingerPad(
                finger=finger,
                body=body - 1,
                T_body_pad=transform(R, center),
                half_extents=np.abs(R.T @ half),
            )
        )
    return tuple(pads)
