"""`robot.toml`: the roles of the joints, bodies and sites of a robot's model."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from aomgen.errors import ConfigError, MalformedFileError
from aomgen.io.mujoco_model import RobotXml, read_robot_xml
from aomgen.io.paths import find_inside
from aomgen.io.schema import format_toml_value, read_toml

FILE_NAME: Final = "robot.toml"
# Folder with the descriptions of the robots that are known by name.
MODELS: Final = Path(__file__).parent / "models"
PACKAGE: Final = "package://"
Three = Annotated[tuple[FiniteFloat, ...], Field(min_length=3, max_length=3)]
Four = Annotated[tuple[FiniteFloat, ...], Field(min_length=4, max_length=4)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PadSection(_Section):
    """Gripping face of a finger, given by a box behind it whose z axis points to the other finger.

    Attributes:
        body: Name of the body.
        center: Center of the box in the body frame, [m].
        quat_wxyz: Orientation of the box in the body frame.
        half_extents: Half of the side lengths, [m].
    """

    body: str
    center: Three
    quat_wxyz: Four
    half_extents: Three


class ActuatorSection(_Section):
    """Actuator of the model that closes the gripper, and its control at gripper 0 and 1."""

    name: str
    open: FiniteFloat
    closed: FiniteFloat


class EndEffectorSection(_Section):
    """End effector frame: a site of the model, or a pose on a body, position in [m].

    The z axis points out of the palm, the y axis from the left to the right finger.
    """

    site: str = ""
    body: str = ""
    position: Three = (0.0, 0.0, 0.0)
    quat_wxyz: Four = (1.0, 0.0, 0.0, 0.0)


class GripperSection(_Section):
    """Model, driving joints and pads of the gripper.

    Attributes:
        model, attach, prefix: Model file of the gripper, the arm's site to which it is attached, and the prefix of its
            names; empty if the model of the arm contains the gripper.
        open, closed: Values of the driving joints at gripper 0 and 1, [rad] or [m]. The gripper value of the joint log
            refers to the first one that moves; the others follow it.
        actuator: If given, the actuators and contact shapes of the model are used without changes.
        left, right: Pads of the fingers.
    """

    model: str = ""
    attach: str = ""
    prefix: str = ""
    open: dict[str, FiniteFloat] = Field(min_length=1)
    closed: dict[str, FiniteFloat] = Field(min_length=1)
    actuator: ActuatorSection | None = None
    left: PadSection
    right: PadSection

    @property
    def pads(self) -> Mapping[str, PadSection]:
        """Pads by side, "left" and "right"."""
        return {"left": self.left, "right": self.right}

    @property
    def strokes(self) -> Mapping[str, tuple[float, float]]:
        """Values of each driving joint at gripper 0 and 1, [rad] or [m]; joints that do not move come last."""
        names = sorted(self.open, key=lambda name: self.open[name] == self.closed[name])
        return {name: (self.open[name], self.closed[name]) for name in names}


class MountSection(_Section):
    """A camera on a body.

    Attributes:
        name: Name of the camera.
        body: Name of the body.
        position, quat_wxyz: Pose in the body frame, [m]; x right, y down, z forward.
        fov_deg: Vertical field of view.
        width, height: Image size, [px].
    """

    name: str = Field(pattern=r"^[a-z0-9_]+$")
    body: str
    position: Three
    quat_wxyz: Four
    fov_deg: float = Field(gt=0, lt=180)
    width: int = Field(ge=1, le=4096)
    height: int = Field(ge=1, le=4096)


class RobotDescription(_Section):
    """Content of a robot.toml; see `docs/capture.md`.

    Attributes:
        format: Version of the format.
        name: Name of the robot.
        model: URDF or MJCF file relative to the robot.toml.
        joints: Names of the arm joints, from the base on.
        end_effector: End effector frame.
        gripper: Gripper, or None.
        camera: Cameras that are mounted on the robot.
    """

    format: Literal[1] = 1
    name: str = Field(min_length=1)
    model: str
    joints: tuple[str, ...] = Field(min_length=1)
    end_effector: EndEffectorSection
    gripper: GripperSection | None = None
    camera: tuple[MountSection, ...] = ()


def read_description(path: Path) -> RobotDescription:
    """Read a robot.toml.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: The file is missing, too large or malformed.
    """
    found = read_toml(path, RobotDescription, "write it with `aomgen robot propose`")
    gripper = found.gripper
    if gripper is not None and set(gripper.open) != set(gripper.closed):
        raise MalformedFileError(
            path, "gripper.open and .closed name different joints", "give both values for each joint"
        )
    if bool(found.end_effector.site) == bool(found.end_effector.body):
        raise MalformedFileError(path, "end_effector needs a site or a body", "give one of them")
    if len({camera.name for camera in found.camera}) < len(found.camera):
        raise MalformedFileError(path, "has two cameras with one name", "give each a different name")
    return found


def find_known_description(name: str) -> Path:
    """Find the file that describes a robot known by name.

    Raises:
        ConfigError: The name is unknown.
    """
    known = {path.stem: path for path in MODELS.glob("*.toml")}
    if name not in known:
        raise ConfigError("robot.model", f"'{name}' is unknown", f"known: {', '.join(sorted(known))}")
    return known[name]


def find_description(model_file: Path) -> Path | None:
    """Find the robot.toml in the folder of a model; None if there is none.

    Raises:
        MalformedFileError: The robot.toml is malformed or describes another model.
    """
    path = model_file.parent / FILE_NAME
    if not path.is_file():
        return None
    named = read_description(path).model
    if (path.parent / named).resolve() != model_file.resolve():
        raise MalformedFileError(
            path, f"describes {named}, not {model_file.name}", "keep each robot in a separate folder"
        )
    return path


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotFiles:
    """Checked model files of a robot.

    Attributes:
        arm: Model of the arm, which may contain the gripper.
        gripper: Separate model of the gripper, or None.
        attach: Site of the arm to which the separate gripper is attached.
        prefix: Prefix of the names of the separate gripper.
    """

    arm: RobotXml
    gripper: RobotXml | None = None
    attach: str = ""
    prefix: str = ""


def read_models(description: RobotDescription, path: Path, root: Path) -> RobotFiles:
    """Read the model files of a description.

    Args:
        description: Content of a robot.toml.
        path: File of the description, to whose folder the references are relative.
        root: Folder that the references must not leave.

    Raises:
        ConfigError: A package is missing.
        InputError: A file is missing or cannot be used.
    """
    arm, gripper = _model(description.model, path, root), description.gripper
    if gripper is None or not gripper.model:
        return RobotFiles(arm=arm)
    own = _model(gripper.model, path, root)
    return RobotFiles(arm=arm, gripper=own, attach=gripper.attach, prefix=gripper.prefix)


def _model(reference: str, path: Path, root: Path) -> RobotXml:
    if path.parent != MODELS:
        return read_robot_xml(find_inside(root, [path.parent], [reference], named_by=path), root)
    package, _, rest = reference.removeprefix(PACKAGE).partition("/")
    found = find_spec(package)
    if found is None or found.origin is None:
        remedy = f"pip install {package.replace('_', '-')}"
        raise ConfigError("robot.model", f"'{path.stem}' needs the package {package}", remedy)
    file = Path(found.origin).parent / rest
    return read_robot_xml(file, file.parent)


def robot_references(model_file: Path, root: Path) -> tuple[Path, ...]:
    """List all files that a robot needs in addition to its model, including robot.toml.

    Raises:
        ConfigError, InputError: A package or a file is missing or cannot be used.
    """
    path = find_description(model_file)
    if path is None:
        return read_robot_xml(model_file, root).references
    files = read_models(read_description(path), path, root)
    parts = [] if files.gripper is None else [files.gripper.path, *files.gripper.references]
    return (*files.arm.references, *parts, path)


def description_toml(description: RobotDescription) -> str:
    """Format a description as the text of a robot.toml."""
    end, gripper = description.end_effector, description.gripper
    quote = format_toml_value
    place = f"body = {quote(end.body)}\nposition = {list(end.position)}\nquat_wxyz = {list(end.quat_wxyz)}"
    text = f"""\
# What the parts of this robot are for. Lengths in meters, angles in radians; check every line.
format = 1
name = {quote(description.name)}
model = {quote(description.model)}  # beside this file
joints = {quote(list(description.joints))}  # the arm, from the base on

[end_effector]  # z out of the palm, y from the left to the right finger
{f"site = {quote(end.site)}" if end.site else place}
"""
    for camera in description.camera:
        text += f"""
[[camera]]  # x right, y down, z forward
name = {quote(camera.name)}
body = {quote(camera.body)}
position = {list(camera.position)}
quat_wxyz = {list(camera.quat_wxyz)}
fov_deg = {camera.fov_deg}
width = {camera.width}
height = {camera.height}
"""
    if gripper is None:
        return text
    text += "\n[gripper]\n# Values of the joints that drive it; the log's gripper column measures the first that moves.\n"
    for key, values in (("open", gripper.open), ("closed", gripper.closed)):
        pairs = ", ".join(f"{quote(name)} = {value}" for name, value in values.items())
        text += f"{key} = {{ {pairs} }}\n"
    for side, pad in gripper.pads.items():
        text += f"""
[gripper.{side}]  # a box behind the face that holds, z towards the other finger
body = {quote(pad.body)}
center = {list(pad.center)}
quat_wxyz = {list(pad.quat_wxyz)}
half_extents = {list(pad.half_extents)}
"""
    return text
