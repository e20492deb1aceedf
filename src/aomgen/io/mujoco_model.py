"""URDF and MJCF files as MuJoCo models."""

# MuJoCo ships no type stubs: its classes are unknown to the checker.
# pyright: reportUnknownParameterType=false

from pathlib import Path

import mujoco

from aomgen.errors import MalformedFileError
from aomgen.io.robot_xml import RobotXml

# What links without mass get: less than any real link, enough for the solver, [kg] and [kg m^2].
LEAST_MASS, LEAST_INERTIA = 1e-3, 1e-6


def parse_spec(xml: RobotXml) -> mujoco.MjSpec:
    """The editable model of a file as it stands.

    Raises:
        MalformedFileError: MuJoCo cannot read it.
    """
    try:
        if xml.kind == "mjcf":
            return mujoco.MjSpec.from_file(str(xml.path))
        meshes = {name: file.read_bytes() for name, file in xml.meshes.items()}
        return mujoco.MjSpec.from_string(xml.text, assets=meshes)
    except (ValueError, RuntimeError) as error:
        raise MalformedFileError(xml.path, f"cannot be read by MuJoCo ({error})", "correct it") from error


def compile_model(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """The compiled model.

    Raises:
        MalformedFileError: MuJoCo refuses it.
    """
    try:
        return spec.compile()
    except (ValueError, RuntimeError) as error:
        raise MalformedFileError(path, f"cannot be used by MuJoCo ({error})", "correct it") from error
