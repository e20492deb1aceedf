"""Articulated assets as one bounded archive of plain arrays (npz, no pickle)."""

import io
import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh
from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.atomic import write_bytes

# Largest archive read, [bytes]: far above a usual asset, but fits in memory.
MAX_BYTES = 2 << 30
_MESH_ARRAYS = ("vertices", "faces", "uvs", "texture_srgb", "color_srgb")


def save_asset(asset: ArticulatedAsset, path: Path) -> None:
    """Write an asset, exactly, as an npz file.

    Raises:
        StorageError: The disk refuses.
    """
    arrays: dict[str, Any] = {}
    header: dict[str, Any] = {"name": asset.name, "category": asset.category, "links": []}
    joint = asdict(asset.joint)
    arrays["joint_axis"], arrays["joint_origin"] = joint.pop("axis"), joint.pop("origin")
    header["joint"] = joint
    arrays["handle_point"], arrays["handle_axis"] = asset.handle_point, asset.handle_axis
    for link in (asset.static, asset.moving):
        number = len(header["links"])
        for i, mesh in enumerate(link.meshes):
            arrays.update({f"link{number}_mesh{i}_{key}": getattr(mesh, key) for key in _MESH_ARRAYS})
        for i, box in enumerate(link.colliders):
            arrays[f"link{number}_box{i}_T"] = box.T_asset_box
            arrays[f"link{number}_box{i}_half"] = box.half_extents
        meshes = [{"name": m.name, "roughness": m.roughness, "metallic": m.metallic} for m in link.meshes]
        boxes = [box.name for box in link.colliders]
        header["links"].append({"name": link.name, "mass": link.mass, "meshes": meshes, "boxes": boxes})
    arrays["header"] = np.frombuffer(json.dumps(header, allow_nan=False).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def load_asset(path: Path) -> ArticulatedAsset:
    """Read what `save_asset` wrote.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: As their names say.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "make or import the asset again")
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"has {path.stat().st_size} bytes, limit {MAX_BYTES}")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            header = json.loads(bytes(arrays["header"]).decode())
            links = [_link(arrays, number, entry) for number, entry in enumerate(header["links"])]
            static, moving = links
            return ArticulatedAsset(
                name=header["name"],
                category=header["category"],
                static=static,
                moving=moving,
                joint=Joint(axis=arrays["joint_axis"], origin=arrays["joint_origin"], **header["joint"]),
                handle_point=arrays["handle_point"],
                handle_axis=arrays["handle_axis"],
            )
    except (ValueError, KeyError, TypeError, OSError, zipfile.BadZipFile) as error:
        raise MalformedFileError(path, f"is not an asset archive ({error})", "make it again") from error


def _link(arrays: Any, number: int, entry: dict[str, Any]) -> AssetLink:
    meshes = tuple(
        Mesh(**{key: arrays[f"link{number}_mesh{i}_{key}"] for key in _MESH_ARRAYS}, **values)
        for i, values in enumerate(entry["meshes"])
    )
    boxes = tuple(
        BoxCollider(
            name=name,
            T_asset_box=arrays[f"link{number}_box{i}_T"],
            half_extents=arrays[f"link{number}_box{i}_half"],
        )
        for i, name in enumerate(entry["boxes"])
    )
    return AssetLink(name=entry["name"], meshes=meshes, colliders=boxes, mass=entry["mass"])
