"""Calibrated fixed cameras of the demonstration: pose, clock, and how they were found."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aomgen.core.camera import Camera
from aomgen.core.clock import Clock
from aomgen.errors import MalformedFileError, SyncError
from aomgen.io.atomic import write_json
from aomgen.io.jsonfile import read_json

CAMERAS_FILE = "fixed_cameras.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibratedCamera:
    """One fixed camera in the world, and its video's clock.

    Attributes:
        camera: Optics and pose, world frame.
        clock: Of its video against the joint log, None when it was refused.
        refusal: Where, problem and remedy of the refused clock; empty otherwise.
        note: How the pose was found, in words.
        trusted: Whether everything that was known of the camera agrees.
        figures: Metrics by name.
    """

    camera: Camera
    clock: Clock | None
    refusal: tuple[str, ...] = ()
    note: str = ""
    trusted: bool = True
    figures: dict[str, float] = field(default_factory=dict)

    def require_clock(self) -> Clock:
        """The clock.

        Raises:
            SyncError: It was refused; the reason is the one found then.
        """
        if self.clock is None:
            raise SyncError(*self.refusal)
        return self.clock

    def summary(self) -> dict[str, object]:
        """Metrics for the manifest."""
        clock = {} if self.clock is None else {"offset_s": self.clock.offset_s, "sd_s": self.clock.sd_s}
        return {"note": self.note, "clock": clock or "; ".join(self.refusal), **self.figures}

    def warnings(self, name: str) -> list[str]:
        """Sentences for the user."""
        found = [] if self.trusted else [f"camera '{name}' {self.note}"]
        return found + ([f"camera '{name}': {'; '.join(self.refusal)}"] if self.refusal else [])


def save_calibrated_cameras(cameras: dict[str, CalibratedCamera], folder: Path) -> None:
    """Write `fixed_cameras.json` into a folder."""
    stored = {name: _json(item) for name, item in cameras.items()}
    write_json(folder / CAMERAS_FILE, {"format": 1, "cameras": stored})


def load_calibrated_cameras(folder: Path) -> dict[str, CalibratedCamera]:
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


def _json(item: CalibratedCamera) -> dict[str, Any]:
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


def _of(stored: dict[str, Any]) -> CalibratedCamera:
    clock = stored["clock"]
    return CalibratedCamera(
        camera=Camera(**stored["camera"]),
        clock=None if clock is None else Clock(**clock),
        refusal=tuple(stored["refusal"]),
        note=stored["note"],
        trusted=stored["trusted"],
        figures=stored["figures"],
    )
