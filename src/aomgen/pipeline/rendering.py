"""Drawing the twin of a finished run: what `aomgen render` and the benchmarks call."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, PART_LABELS
from aomgen.core.camera import Camera
from aomgen.errors import ConfigError, MissingFileError
from aomgen.physics.robot import RobotModel
from aomgen.physics.robot_store import stored_robot
from aomgen.twin.store import load_twin
from aomgen.twin.twin import Twin, TwinState, render_state

TWIN_FOLDER = "06_twin"
LABEL_MIN_ALPHA = 0.5


def open_twin(out: Path) -> tuple[Twin, RobotModel]:
    """The twin of a finished run and its robot.

    Raises:
        MissingFileError: The run has not come that far.
    """
    folder = out / TWIN_FOLDER
    if not folder.is_dir():
        raise MissingFileError(folder, "is missing", "finish the run first")
    twin = load_twin(folder)
    return twin, stored_robot(folder)


def draw_twin(
    twin: Twin, robot: RobotModel, camera: Camera, state: TwinState
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Image (H, W, 3) and part labels (H, W), both uint8, of the twin in a state.

    A pixel's label is the one whose Gaussians contribute most together, background where
    alpha <= 0.5. Summing by label keeps a thin veil before a surface made of many layers from
    taking the pixel.
    """
    kinds = np.array(sorted(PART_LABELS.values()))
    shares = (twin.labels[:, None] == kinds).astype(np.float32)
    drawn = render_state(twin, robot, state, camera, features=shares)
    image = np.clip(np.rint(drawn.rgb * 255), 0, 255).astype(np.uint8)
    strongest = kinds[np.argmax(np.asarray(drawn.features), axis=-1)]
    labels = np.where(drawn.alpha > LABEL_MIN_ALPHA, strongest, BACKGROUND).astype(np.uint8)
    return image, labels


def parse_camera(data: Any, where: Path) -> Camera:
    """A camera from the JSON of `aomgen render`.

    Raises:
        ConfigError: A key is missing or has the wrong shape.
    """
    try:
        return Camera(
            fx=float(data["fx"]),
            fy=float(data["fy"]),
            cx=float(data["cx"]),
            cy=float(data["cy"]),
            width=int(data["width"]),
            height=int(data["height"]),
            T_world_cam=np.array(data["T_world_cam"], np.float64),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            where, f"is not a camera ({error!r})", "want T_world_cam (4x4), fx, fy, cx, cy, width, height"
        ) from error


def parse_state(data: Any, twin: Twin, robot: RobotModel, where: Path) -> TwinState:
    """A state from the JSON of `aomgen render`; what is left out is as in the scan.

    Raises:
        ConfigError: An unknown key, an unknown joint or a wrong shape.
    """
    rest = twin.scan_state
    known = ("joints", "gripper", "theta", "T_world_object")
    unknown = set(data) - set(known)
    if unknown:
        raise ConfigError(where, f"has an unknown key '{min(unknown)}'", f"known: {', '.join(known)}")
    joints = np.array(rest.joints)
    for name, value in data.get("joints", {}).items():
        if name not in robot.joint_names:
            raise ConfigError(
                where, f"names an unknown joint '{name}'", f"known: {', '.join(robot.joint_names)}"
            )
        joints[robot.joint_names.index(name)] = float(value)
    try:
        return TwinState(
            joints=joints,
            gripper=float(data.get("gripper", rest.gripper)),
            theta=float(data.get("theta", rest.theta)),
            T_world_object=np.array(data.get("T_world_object", rest.T_world_object), np.float64),
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(where, f"is not a state ({error})", "see the capture format") from error
