"""Fixed cameras of the demonstration on disk."""

from pathlib import Path
from typing import Any

from aomgen.core.camera import Camera
from aomgen.core.clock import Clock
from aomgen.core.fixed_camera import FixedCamera
from aomgen.errors import MalformedFileError
from aomgen.io.atomic import write_json
from aomgen.io.jsonfile import read_json

CAMERAS_FILE = "fixed_cameras.json"


def save_calibrated_cameras(cameras: dict[str, FixedCamera], folder: Path) -> None:
    """Write `fixed_cameras.json` into a folder."""
    stored = {name: _json(item) for name, item in cameras.items()}
    write_json(folder / CAMERAS_FILE, {"format": 1, "cameras": stored})


def load_calibrated_cameras(folder: Path) -> dict[str, FixedCamera]:
    """Load the calibrated fixed cameras by name, world frame.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: As their names say.
    """
    path = folder / CAMERAS_FILE
    stored = read_json(path)
    try:
        return {name: _of(item) for name, item in stored["cameras"].items()}
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise MalformedFileError(path, f"does not hold cameras ({error})", "run the stage again") from error


def _json(item: FixedCamera) -> dict[str, Any]:
    camera, clock = item.camera, item.clock
    return {
        "camera": {
            name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height", "T_world_cam")
        },
        "clock": None
        if clock is None
        else {name: getattr(clock, name) for name in ("offset_s", "sd_s", "rate", "rate_sd", "middle_s")},
        "refusal": list(item.refusal),
        "note": item.note,
        "trusted": item.trusted,
        "figures": item.figures,
    }


def _of(stored: dict[str, Any]) -> FixedCamera:
    clock = stored["clock"]
    return FixedCamera(
        camera=Camera(**stored["camera"]),
        clock=None if clock is None else Clock(**clock),
        refusal=tuple(stored["refusal"]),
        note=stored["note"],
        trusted=stored["trusted"],
        figures=stored["figures"],
    )
