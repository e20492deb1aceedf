"""Ground truth of a rendered or instrumented capture; only benchmarks and tests read it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.core.joint import Joint
from aomgen.core.values import Array
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.io.artifact import read_json


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """Content of `truth/truth.json`, world frame, SI units.

    Attributes:
        folder: The truth folder (for masks).
        scan: T_world_cam (4, 4) of every scan image, by file name.
        demo_cameras: T_world_cam of the fixed cameras, by name.
        joint: Axis positive in the demonstrated direction.
        theta: Joint value at each frame of each demonstration video, by camera.
        start_frame, end_frame: First and last frame of the part's motion.
        clock_offset_s: Log time = video time + offset.
        qpos: Arm joints (T, J) at each frame.
        gripper: (T,) at each frame.
        contacts: For each frame a list of {finger, point, normal, force}.
    """

    folder: Path
    scan: dict[str, Array]
    demo_cameras: dict[str, Array]
    joint: Joint
    theta: dict[str, Array]
    start_frame: int
    end_frame: int
    clock_offset_s: float
    qpos: Array
    gripper: Array
    contacts: list[list[dict[str, Any]]]


def read_truth(capture: Path) -> Truth:
    """Load the truth of a capture.

    Raises:
        MissingFileError: The capture has none, so nothing can be scored.
        MalformedFileError: A key is missing or has the wrong shape.
    """
    folder = capture / "truth"
    path = folder / "truth.json"
    if not path.is_file():
        raise MissingFileError(
            path, "is missing, so accuracy cannot be scored", "use a capture with ground truth"
        )
    data = read_json(path)
    try:
        joint = data["joint"]
        return Truth(
            folder=folder,
            scan={name: np.array(T) for name, T in data["scan"].items()},
            demo_cameras={name: np.array(T) for name, T in data["demo_cameras"].items()},
            joint=Joint(
                type=joint["type"],
                axis=joint["axis"],
                origin=joint["origin"],
                lower=joint["lower"],
                upper=joint["upper"],
            ),
            theta={name: np.array(values) for name, values in data["theta"].items()},
            start_frame=data["start_frame"],
            end_frame=data["end_frame"],
            clock_offset_s=data["clock_offset_s"],
            qpos=np.array(data["qpos"]),
            gripper=np.array(data["gripper"]),
            contacts=data["contacts"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedFileError(path, f"does not follow the format ({error!r})") from error
