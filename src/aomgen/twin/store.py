"""Twins on disk: `twin.json` and `twin.npz` in one folder."""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.gaussians import Gaussians
from aomgen.core.joint import Joint
from aomgen.core.light import Light
from aomgen.errors import MalformedFileError
from aomgen.io.arrays import npz_bytes, read_npz
from aomgen.io.atomic import write_bytes, write_json
from aomgen.io.jsonfile import read_json
from aomgen.twin.directional_shadow import DirectionalLight
from aomgen.twin.relighting import Relit, ResidualAppearance
from aomgen.twin.twin import Twin, TwinState

# Raised when the files of a twin change.
FORMAT: Final = 3
_GAUSSIANS: Final = ("means", "quats", "scales", "opacities", "sh")
_RELIT: Final = ("indices", "albedo_linear", "transfer", "light_of")
_LIGHT: Final = ("direction", "T_world_plane", "shade")
_RESIDUAL: Final = ("rows", "Rs_world_body", "difference_srgb")


def save_twin(folder: Path, twin: Twin) -> None:
    """Write a twin into an existing folder; equal twins give equal bytes."""
    arrays: dict[str, NDArray] = {name: getattr(twin.gaussians, name) for name in _GAUSSIANS}
    arrays |= {"bodies": twin.bodies, "labels": twin.labels}
    if twin.relit is not None:
        arrays |= {f"relit_{name}": getattr(twin.relit, name) for name in _RELIT}
        arrays["lights_radiance_sh"] = np.stack([light.radiance_sh for light in twin.relit.lights])
        for item in twin.relit.residuals:
            arrays |= {f"remembered_{item.body}_{name}": getattr(item, name) for name in _RESIDUAL}
            arrays[f"remembered_{item.body}_reach_rad"] = np.array([item.reach_rad])
    joint, state = twin.joint, twin.scan_state
    header = {
        "format": FORMAT,
        "robot": twin.robot,
        "body_names": list(twin.body_names),
        "joint": {name: getattr(joint, name) for name in ("type", "axis", "origin", "lower", "upper")},
        "T_world_object": twin.T_world_object,
        "scan_state": {
            name: getattr(state, name) for name in ("joints", "gripper", "theta", "T_world_object")
        },
        "lamp": None
        if twin.directional_light is None
        else {name: getattr(twin.directional_light, name) for name in _LIGHT},
    }
    write_bytes(folder / "twin.npz", npz_bytes(arrays))
    write_json(folder / "twin.json", header)


def load_twin(folder: Path) -> Twin:
    """Read what `save_twin` wrote.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: As their names say.
    """
    where = folder / "twin.json"
    header: Any = read_json(where)
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise MalformedFileError(where, f"is not a twin of format {FORMAT}", "run the stage again")
    arrays = read_npz(folder / "twin.npz")
    try:
        return Twin(
            robot=str(header["robot"]),
            gaussians=Gaussians(**{name: arrays[name] for name in _GAUSSIANS}),
            bodies=_below(arrays["bodies"], len(header["body_names"])),
            labels=arrays["labels"],
            body_names=tuple(header["body_names"]),
            joint=Joint(**header["joint"]),
            T_world_object=header["T_world_object"],
            scan_state=TwinState(**header["scan_state"]),
            relit=_relit(arrays, len(header["body_names"])),
            directional_light=None if header["lamp"] is None else DirectionalLight(**header["lamp"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedFileError(where, f"is not complete ({error!r})", "run the stage again") from error


def _relit(arrays: dict[str, NDArray], bodies: int) -> Relit | None:
    if "relit_indices" not in arrays:
        return None
    fields: dict[str, Any] = {name: arrays[f"relit_{name}"] for name in _RELIT}
    lights = tuple(Light(radiance_sh=radiance) for radiance in arrays["lights_radiance_sh"])
    _below(fields["indices"], len(arrays["means"]))
    _below(fields["light_of"], len(lights))
    residuals = []
    for body in range(bodies):
        prefix = f"remembered_{body}_"
        if f"{prefix}rows" not in arrays:
            continue
        values: dict[str, Any] = {name: arrays[prefix + name] for name in _RESIDUAL}
        _below(values["rows"], len(fields["indices"]))
        reach = float(arrays[f"{prefix}reach_rad"][0])
        residuals.append(ResidualAppearance(body=body, reach_rad=reach, **values))
    return Relit(**fields, lights=lights, residuals=tuple(residuals))


def _below(indices: NDArray, limit: int) -> NDArray:
    if len(indices) and not (indices.min() >= 0 and indices.max() < limit):
        raise ValueError(f"an index is outside 0..{limit - 1}")
    return np.asarray(indices)
