"""An articulated asset: a static link, a moving link, and the joint between them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import apply, similarity_parts
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxCollider:
    """An oriented box for collision detection.

    Attributes:
        name: Unique within its link; the names of the handle's boxes start with "handle".
        T_asset_box: Pose of the box's center (4, 4).
        half_extents: Half extents (3,), [m].
    """

    name: str
    T_asset_box: Matrix4
    half_extents: Vector3

    __post_init__ = freeze_arrays

    @property
    def corners(self) -> Array:
        """The eight corners (8, 3), asset frame, [m]."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return apply(self.T_asset_box, signs * self.half_extents)

    def distance(self, point: Array) -> float:
        """Compute the distance of a point (3,) of the asset frame to the box, 0 inside, [m]."""
        local = np.abs(self.T_asset_box[:3, :3].T @ (point - self.T_asset_box[:3, 3]))
        return float(np.linalg.norm(np.maximum(local - self.half_extents, 0.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class AssetLink:
    """One rigid link: visible meshes and colliders, both in the asset frame at joint value 0, and its mass, [kg]."""

    name: str
    meshes: tuple[Mesh, ...]
    colliders: tuple[BoxCollider, ...]
    mass: float

    @property
    def volume(self) -> float:
        """Sum of the volumes of all colliders, [m^3]."""
        return sum(8 * float(box.half_extents.prod()) for box in self.colliders)

    def distances(self, points: Array) -> Array:
        """Compute the distances (N,) of points (N, 3), asset frame, to the nearest collider, 0 inside, [m]."""
        nearest = np.full(len(points), np.inf)
        for box in self.colliders:
            T = box.T_asset_box
            local = np.abs((points - T[:3, 3]) @ T[:3, :3]) - box.half_extents
            x, y, z = (np.maximum(local, 0.0) ** 2).T
            nearest = np.minimum(nearest, x + y + z)
        return np.sqrt(nearest)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper corner (3,) of the bounding box of the colliders, asset frame, [m]."""
        corners = np.concatenate([box.corners for box in self.colliders])
        return corners.min(0), corners.max(0)

    def transform(self, S: ArrayLike) -> "AssetLink":
        """Move and scale the link by a similarity (4, 4); the mass follows the volume."""
        scale, R, _ = similarity_parts(S)
        colliders = tuple(
            replace(box, T_asset_box=_move_pose(S, R, box.T_asset_box), half_extents=box.half_extents * scale)
            for box in self.colliders
        )
        meshes = tuple(mesh.transform(S) for mesh in self.meshes)
        return replace(self, meshes=meshes, colliders=colliders, mass=self.mass * scale**3)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArticulatedAsset:
    """A static link and a moving link that are connected by one joint.

    In the asset frame, z points up, the support plane is z = 0, and joint value 0 is the closed state. By convention, the
    front, which carries the handle, faces -y, and the asset is centered in x. All lengths are in meters.

    Attributes:
        name: Name, for example "microwave-3".
        category: Category, for example "microwave".
        static: The link that stands on the table.
        moving: The door, drawer or lid.
        joint: Joint with its axis positive in the opening direction, asset frame.
        handle_point: Grasp point at the center of the handle (3,).
        handle_axis: Unit direction (3,) along the handle's bar.
        credit: Author and license, if attribution is required.
        notes: Assumptions that were made when the asset was imported, one sentence each.
    """

    name: str
    category: str
    static: AssetLink
    moving: AssetLink
    joint: Joint
    handle_point: Vector3
    handle_axis: Vector3
    credit: str = ""
    notes: tuple[str, ...] = ()

    __post_init__ = freeze_arrays

    @property
    def handle_boxes(self) -> list[BoxCollider]:
        """Colliders whose names start with "handle"."""
        return [box for box in self.moving.colliders if box.name.startswith("handle")]

    @property
    def handle_bar(self) -> BoxCollider | None:
        """The handle collider whose center is closest to `handle_point`; None if there is no handle collider."""
        return min(
            self.handle_boxes,
            key=lambda box: float(np.linalg.norm(box.T_asset_box[:3, 3] - self.handle_point)),
            default=None,
        )

    def transform(self, S: ArrayLike) -> "ArticulatedAsset":
        """Move and scale the asset by a similarity (4, 4); masses follow the volume."""
        _, R, _ = similarity_parts(S)
        return replace(
            self,
            static=self.static.transform(S),
            moving=self.moving.transform(S),
            joint=self.joint.move(S),
            handle_point=apply(S, self.handle_point),
            handle_axis=R @ self.handle_axis,
        )


def _move_pose(S: ArrayLike, R: Array, T_asset_box: Array) -> Array:
    T = np.eye(4)
    T[:3, :3] = R @ T_asset_box[:3, :3]
    T[:3, 3] = apply(S, T_asset_box[:3, 3])
    return T
