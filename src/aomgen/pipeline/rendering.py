"""Render the twin of a finished run, and parse cameras and states that are given as JSON."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, PART_LABELS
from aomgen.core.camera import Camera
from aomgen.core.transforms import ROTATION_TOLERANCE, measure_rigidity
from aomgen.core.values import Array
from aomgen.errors import ConfigError, MissingFileError, UnknownNameError
from aomgen.io.artifact import load_artifact
from aomgen.lighting.shadowed_twin import render_state
from aomgen.results import Results
from aomgen.robots.loading import load_stored_robot
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import TwinModel, TwinState

TWIN_FOLDER = "06_twin"
# Largest accumulated alpha of a pixel that counts as background.
LABEL_MIN_ALPHA = 0.5
CAMERA_KEYS = ("T_world_cam", "fx", "fy", "cx", "cy", "width", "height")
STATE_KEYS = ("joints", "gripper", "theta", "T_world_object")
# Largest accepted image size and focal length, [px]; larger values are probably mistakes.
MAX_PX = 16_384


def open_twin(out: Path) -> tuple[TwinModel, RobotModel]:
    """Load the twin of a run and its robot.

    Args:
        out: Folder of the run.

    Raises:
        MissingFileError: The run has not finished the twin stage.
    """
    folder = out / TWIN_FOLDER
    if not folder.is_dir():
        raise MissingFileError(folder, "is missing", "finish the run first")
    twin = load_artifact(folder, "twin", TwinModel)
    return twin, load_stored_robot(folder)


def render_twin(
    twin: TwinModel, robot: RobotModel, camera: Camera, state: TwinState
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]:
    """Render the twin in a state.

    Returns:
        Image (H, W, 3) uint8 sRGB; depth (H, W) float32 along the optical axis, [m], 0 for the background; part labels
        (H, W) uint8, see `conventions.PART_LABELS`. The label of a pixel is the one with the largest sum of Gaussian
        contributions, or background for alpha <= 0.5. Because contributions are summed by label, a thin layer in front
        of a surface that consists of many layers does not determine the label.
    """
    kinds = np.array(sorted(PART_LABELS.values()))
    shares = (twin.labels[:, None] == kinds).astype(np.float32)
    drawn = render_state(twin, robot, state, camera, features=shares)
    image = np.clip(np.rint(drawn.rgb * 255), 0, 255).astype(np.uint8)
    strongest = kinds[np.argmax(np.asarray(drawn.features), axis=-1)]
    labels = np.where(drawn.alpha > LABEL_MIN_ALPHA, strongest, BACKGROUND).astype(np.uint8)
    depth = np.where(drawn.alpha > LABEL_MIN_ALPHA, drawn.depth, 0).astype(np.float32)
    return image, depth, labels


def list_cameras(results: Results) -> dict[str, Camera]:
    """Return the cameras of a run by name, world frame: cameras of the demonstration, the episodes and the scan images.

    If demonstration and episodes have a camera of the same name, that of the demonstration, with the video's size, is used.
    """
    cameras = {name: item.camera for name, item in results.alignment.cameras.items()}
    made = results.episode_scene.cameras if results.folders["replacement"].is_dir() else {}
    for others in (made, results.scan_cameras):
        cameras |= {name: camera for name, camera in others.items() if name not in cameras}
    return cameras


def find_camera(results: Results, name: str) -> Camera:
    """Return a camera of a run, see `list_cameras`.

    Raises:
        UnknownNameError: The run has no camera of that name; the message suggests known ones.
    """
    known = list_cameras(results)
    if name not in known:
        raise UnknownNameError("--camera", name, known)
    return known[name]


def parse_camera(data: Any, where: Path) -> Camera:
    """Parse a camera from the JSON data of `aomgen render`.

    Args:
        data: Object with the keys `CAMERA_KEYS`.
        where: File, for messages.

    Raises:
        ConfigError: A key is missing, or its value is not valid.
    """
    wanted = f"expected {', '.join(CAMERA_KEYS)}"
    _require_object(data, where, wanted)
    missing = [name for name in CAMERA_KEYS if name not in data]
    if missing:
        raise ConfigError(where, f"lacks {', '.join(missing)}", wanted)
    numbers = {name: _number(data, name, where) for name in ("fx", "fy", "cx", "cy")}
    sizes = {name: round(_number(data, name, where)) for name in ("width", "height")}
    for name, value in (("fx", numbers["fx"]), ("fy", numbers["fy"]), *sizes.items()):
        if not 0 < value <= MAX_PX:
            raise ConfigError(where, f"'{name}' is {value:g} px", f"expected more than 0, at most {MAX_PX}")
    return Camera(**numbers, **sizes, T_world_cam=_pose(data, "T_world_cam", where))


def parse_state(data: Any, twin: TwinModel, robot: RobotModel, where: Path) -> TwinState:
    """Parse a state from the JSON data of `aomgen render`; omitted values are those of the scan.

    Args:
        data: Object with any of the keys `STATE_KEYS`.
        twin, robot: Twin and its robot.
        where: File, for messages.

    Raises:
        ConfigError: A key or joint is unknown, or a value is not valid.
    """
    rest = twin.scan_state
    known = f"known: {', '.join(STATE_KEYS)}"
    _require_object(data, where, known)
    unknown = set(data) - set(STATE_KEYS)
    if unknown:
        raise ConfigError(where, f"has an unknown key '{min(unknown)}'", known)
    values, names = data.get("joints", {}), ", ".join(robot.joint_names)
    if not isinstance(values, dict):
        raise ConfigError(where, "'joints' is not an object of joint values", f"known joints: {names}")
    joints = np.array(rest.joints)
    for name in values:
        if name not in robot.joint_names:
            raise ConfigError(where, f"names an unknown joint '{name}'", f"known: {names}")
        joints[robot.joint_names.index(name)] = _number(values, name, where)
    placed = "T_world_object" in data
    return TwinState(
        joints=joints,
        gripper=_number(data, "gripper", where) if "gripper" in data else rest.gripper,
        theta=_number(data, "theta", where) if "theta" in data else rest.theta,
        T_world_object=_pose(data, "T_world_object", where) if placed else rest.T_world_object,
    )


def _require_object(data: Any, where: Path, wanted: str) -> None:
    if not isinstance(data, dict):
        raise ConfigError(where, "is not a JSON object", wanted)


def _number(data: dict[str, Any], name: str, where: Path) -> float:
    value = data[name]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(where, f"'{name}' is not a number", "write it as a number")
    return float(value)


def _pose(data: dict[str, Any], name: str, where: Path) -> Array:
    """Parse a rigid pose (4, 4); JSON data read by `read_json` contain no NaN."""
    remedy = "expected four rows of four numbers: rotation, translation [m], and 0, 0, 0, 1 below"
    try:
        T = np.array(data[name], np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(where, f"'{name}' is not a matrix of numbers", remedy) from error
    if T.shape != (4, 4):
        raise ConfigError(where, f"'{name}' has shape {T.shape}", remedy)
    determinant, deviation = measure_rigidity(T)
    rigid = determinant > 0 and deviation <= ROTATION_TOLERANCE
    if not (rigid and np.array_equal(T[3], [0, 0, 0, 1])):
        raise ConfigError(where, f"'{name}' is not a rotation with a translation", remedy)
    return T
