"""Captures: recorded scenes and demonstrations, opened and checked."""

from dataclasses import dataclass
from pathlib import Path

from aomgen.capture.capture_check import check_capture
from aomgen.capture.read import read_capture
from aomgen.core.recording import JointLog, Recording
from aomgen.pipeline.preflight import category_warnings


@dataclass(frozen=True, slots=True)
class Capture:
    """A scan of a scene, videos of a demonstration, and the robot's joint log.

    The folder format is described in `docs/capture.md`.

    Attributes:
        recording: The checked content of the folder.

    Example:
        >>> capture = ag.Capture.load("my_capture")
        >>> capture.cameras
        ('front',)
        >>> capture.joint_log.joints.shape[1]
        6
    """

    recording: Recording

    @classmethod
    def load(cls, folder: str | Path) -> "Capture":
        """Read the folder of a capture without decoding its videos.

        Args:
            folder: Folder with a `capture.toml`.

        Raises:
            InputError: A file is missing, damaged or inconsistent; the subclass indicates the kind of problem.

        Example:
            >>> ag.Capture.load("my_capture").category
            'microwave'
        """
        return cls(read_capture(Path(folder)))

    def check(self) -> tuple[str, ...]:
        """Decode every file and return warnings, each of which is one sentence.

        Raises:
            InputError, ConfigError: The first problem that would stop a reconstruction.

        Example:
            >>> ag.Capture.load("my_capture").check()
            ()
        """
        _, _, warnings = check_capture(self.recording)
        return warnings + category_warnings(self.recording)

    @property
    def folder(self) -> Path:
        """Folder of the capture."""
        return self.recording.folder

    @property
    def category(self) -> str:
        """Category of the recorded object, for example "microwave"."""
        return self.recording.category

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the fixed cameras that recorded the demonstration."""
        return tuple(camera.name for camera in self.recording.cameras)

    @property
    def joint_log(self) -> JointLog:
        """Arm joints [rad] and gripper (0 open, 1 closed) over the clock of the log [s]."""
        return self.recording.joint_log
