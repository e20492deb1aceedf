"""Import articulated models as assets: URDF, MJCF, OBJ with a joint file, USD with several joints."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from aomgen.assets import mjcf_model, usd_read
from aomgen.assets.mjcf_model import read_mjcf_model
from aomgen.assets.normalization import complete
from aomgen.assets.obj_model import read_obj_model
from aomgen.assets.usd_read import read_usd
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import ConfigError, MalformedFileError

OBJ = ".obj"
# Default name of the file that describes the joints of an OBJ file, in its folder or a folder above.
JOINTS_FILE = "articulation.json"
# Formats that can be imported, but cannot be named in a project.
SUFFIXES = (*mjcf_model.SUFFIXES, OBJ)


def import_model(
    path: Path,
    *,
    joint: str = "",
    joints_file: Path | None = None,
    scale: float = 1.0,
    category: str = "",
    limits: Sequence[float] = (),
    handle: Sequence[float] = (),
) -> ArticulatedAsset:
    """Read a model as an asset: closed, in the asset frame, with colliders and a handle.

    Args:
        path: URDF, MJCF, OBJ or USD file.
        joint: Name of the joint that moves; may be empty if there is only one. Other joints keep their value in the file.
        joints_file: Description of an OBJ file's joints; by default `articulation.json` in its folder or a folder above.
        scale: Factor on all lengths, for example to enlarge a toy; `limits` and `handle` refer to the unscaled file.
        category: Category of the object; replaces that of the file.
        limits: Lower and upper joint limit relative to the pose in the file, [rad] or [m]; they replace the limits in the
            file.
        handle: Corners x0, y0, z0, x1, y1, z1 of a box around the handle in the modeled pose, Z up, [m].

    Returns:
        The asset; its `notes` list the assumptions.

    Raises:
        ConfigError: An OBJ file has no description of its joints.
        InputError: A file cannot be used; the subclass states the reason.
        AssetError: The content of the file does not form an asset.
    """
    suffix = path.suffix.lower()
    if suffix in usd_read.SUFFIXES:
        asset = read_usd(path, joint, scale=scale, limits=limits, handle=handle)
    elif suffix == OBJ:
        drawn = read_obj_model(path, joints_file or _joints_file(path), joint)
        drawn = drawn.transform(np.diag([scale] * 3 + [1.0]))
        asset = complete(drawn, path, scale=scale, limits=limits, handle=handle)
    elif suffix in mjcf_model.SUFFIXES:
        drawn = read_mjcf_model(path, joint, scale=scale, limited=not limits)
        asset = complete(drawn, path, scale=scale, limits=limits, handle=handle)
    else:
        known = ", ".join([*SUFFIXES, *usd_read.SUFFIXES])
        raise MalformedFileError(path, f"has suffix {suffix!r}", f"expected one of {known}")
    return replace(asset, category=category or asset.category)


def _joints_file(path: Path) -> Path:
    folders = path.resolve().parents
    found = next((folder / JOINTS_FILE for folder in folders if (folder / JOINTS_FILE).is_file()), None)
    if found is None:
        raise ConfigError(
            "--joints", f"is needed: {path.name} does not describe joints", "see docs/assets.md"
        )
    return found
