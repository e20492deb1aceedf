"""Hierarchy of all errors; each family has an exit code, and the message of each error is one sentence.

The message states the location, the problem (the value and its limit) and the remedy:
`demo/joints.csv, row 12: 'elbow_joint' is nan; re-export the log`.
Errors that a program may handle have the values of the message as attributes.
"""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

# Largest number of names in a message, so that it stays readable.
MAX_LISTED = 20
# Largest number of characters of another library's message that is quoted.
MAX_QUOTED = 120


def suggest(word: str, known: Iterable[str]) -> str:
    """Return a question with the known word that is most similar to a word, or a list of known words if none is similar."""
    words = list(known)
    near = difflib.get_close_matches(word, words, 1)
    if near:
        return f"did you mean '{near[0]}'?"
    more = f" and {len(words) - MAX_LISTED} more" if len(words) > MAX_LISTED else ""
    return f"known: {', '.join(words[:MAX_LISTED])}{more}"


def quote_error(error: Exception) -> str:
    """Return the kind and message of another library's error as one line of limited length."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:MAX_QUOTED]


class AomgenError(Exception):
    """Base class of all errors that AOMGen raises on purpose.

    Args:
        where: File, stage or argument in which the problem was found.
        problem: Description of the problem, with the value and its limit.
        remedy: Action by which the user can solve the problem.
    """

    exit_code = 1

    def __init__(self, where: object, problem: str, remedy: str = "") -> None:
        self.where = str(where)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{where}: {problem}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[Any, ...]:
        """Support pickling with all attributes, so that errors of worker processes can be raised in their parent."""
        return restore_error, (type(self).__name__, self.args, self.__dict__)


def restore_error(kind: str, args: Sequence[Any], values: Mapping[str, Any]) -> AomgenError:
    """Restore an error of another process.

    Args:
        kind: Name of the error's class.
        args, values: `args` and `__dict__` of the error.

    Raises:
        KeyError: The class is unknown.
    """
    found: type[AomgenError] = globals()[kind]
    error = found.__new__(found, *args)
    error.__dict__.update(values)
    return error


class ConfigError(AomgenError):
    """An option or a project setting is wrong."""

    exit_code = 2


class UnknownNameError(ConfigError):
    """A name is not one of the known names.

    Args:
        where: Option or argument that holds the name.
        name: The unknown name.
        known: All names that are accepted there.
    """

    def __init__(self, where: object, name: str, known: Iterable[str]) -> None:
        self.name, self.known = name, tuple(known)
        super().__init__(where, f"'{name}' is unknown", suggest(name, self.known))


class ShapeError(ConfigError, ValueError):
    """The shape of an array differs from the required one.

    Args:
        where: Name of the argument.
        shape: Shape of the array that was given.
        required: Description of the required shape, for example "(N, 4, 4)".
    """

    def __init__(self, where: object, shape: tuple[int, ...], required: str) -> None:
        self.shape, self.required = tuple(shape), required
        super().__init__(where, f"has shape {self.shape}", f"expected {required}")


class PoseError(ConfigError):
    """A matrix is not a rotation with a translation.

    Args:
        where: Name of the argument.
        index: Number of the first such matrix.
        determinant: Determinant of its upper left 3 x 3 block; 1 for a rotation.
        deviation: Largest difference between R R^T and the identity.
    """

    def __init__(self, where: object, index: int, determinant: float, deviation: float) -> None:
        self.index, self.determinant, self.deviation = index, determinant, deviation
        super().__init__(
            where,
            f"matrix {index} is not a rigid pose (determinant {determinant:.4f}, R R^T differs from the identity by "
            f"{deviation:.2g})",
            "give a rotation matrix, a translation [m], and 0, 0, 0, 1 in the last row",
        )


class InputError(AomgenError):
    """An input file is missing, damaged or inconsistent."""

    exit_code = 3


class MissingFileError(InputError):
    """A file that a capture or an asset names does not exist."""


class MalformedFileError(InputError):
    """A file does not follow its format."""


class UnsafePathError(InputError):
    """A reference points outside the folder of its file."""


class LimitExceededError(InputError):
    """A file is larger than the limit for reading."""


class IncompleteCaptureError(InputError):
    """A recording lacks frames or joint rows."""


class NonFiniteError(InputError):
    """A number is NaN or infinite."""


class UnitsError(InputError):
    """Numbers seem to be in another unit (degrees, millimeters)."""


class CalibrationError(InputError):
    """Intrinsics do not belong to the images."""


class SeveralCamerasError(CalibrationError):
    """Images of a scan do not come from one camera.

    Args:
        where: Folder or file that contains or lists the images.
        groups: Names of images by a description of their size or focal length.
    """

    def __init__(self, where: object, groups: Mapping[str, Sequence[str]]) -> None:
        self.groups = {kind: list(names) for kind, names in groups.items()}
        kinds = sorted(self.groups.items(), key=lambda item: -len(item[1]))
        counts = ", ".join(f"{len(names)} of {kind} ({names[0]})" for kind, names in kinds[:MAX_LISTED])
        super().__init__(
            where,
            f"contains images of {len(kinds)} cameras: {counts}",
            "give images of one camera, size and zoom",
        )


class UnknownCameraModelError(CalibrationError):
    """A file names a camera model that has no pinhole equivalent, or is unknown.

    Args:
        where: The file.
        model: The unknown model.
        known: Models that are accepted there.
    """

    def __init__(self, where: object, model: str, known: Iterable[str]) -> None:
        self.model, self.known = model, tuple(known)
        super().__init__(where, f"has the camera model '{model}'", suggest(model, self.known))


class ScanPoseError(InputError):
    """The pose of a scan image is not a rotation with a translation.

    Args:
        where: The file.
        image: Name of the image.
        determinant: Determinant of the upper left 3 x 3 block of the matrix; 1 for a rotation, negative for a
            reflection.
        deviation: Largest difference between R R^T and the identity.
    """

    def __init__(self, where: object, image: str, determinant: float, deviation: float) -> None:
        self.image, self.determinant, self.deviation = image, determinant, deviation
        kind = "mirrors space" if determinant < 0 else "is not a rotation with a translation"
        super().__init__(
            where,
            f"the pose of {image} {kind} (determinant {determinant:.4f}, R R^T differs from the identity by "
            f"{deviation:.2g})",
            "export the poses again, or remove them",
        )


class AssetError(InputError):
    """An articulated asset cannot be used without changes."""


class SeveralJointsError(AssetError):
    """A file has several joints, and none is named.

    Args:
        where: The file.
        joints: Names of its joints.
        remedy: Action by which the user can select one of them.
    """

    def __init__(self, where: object, joints: Iterable[str], remedy: str) -> None:
        self.joints = list(joints)
        super().__init__(where, f"has {len(self.joints)} joints: {', '.join(self.joints)}", remedy)


class BackendError(AomgenError):
    """A library, driver or weight file is missing or broken."""

    exit_code = 4


class DamagedWeightsError(BackendError):
    """A file of downloaded weights differs from the published one."""


def explain_missing_module(error: ModuleNotFoundError) -> BackendError | None:
    """Return an error that names the extra with a missing module, or None if `reconstruct` does not contain it."""
    module = (error.name or "").partition(".")[0]
    if module not in ("torch", "pycolmap", "onnxruntime"):
        return None
    return BackendError(module, "is not installed", "pip install 'aomgen[reconstruct]'")


class PolicyServerError(BackendError):
    """The server of a policy is unreachable, failed, or sent an invalid reply."""


class EstimationError(AomgenError):
    """An estimator refuses to return an estimate, because its evidence is too weak."""

    exit_code = 5


class ReconstructionError(EstimationError):
    """The result of structure from motion or Gaussian training is below a quality threshold."""


class AlignmentError(EstimationError):
    """Scene and robot could not be aligned reliably."""


class SyncError(EstimationError):
    """The clock offset between video and joint log is not determined."""


class WrongPromptError(EstimationError):
    """Prompts and demonstration contradict each other about the moving part."""


class NoMotionError(EstimationError):
    """The video shows no motion of the movable part."""


class DemonstrationTooShortError(EstimationError):
    """The part moved too little to determine its joint."""


class AmbiguousJointError(EstimationError):
    """Two joint hypotheses explain the demonstration equally well."""


class NotEnoughEpisodesError(EstimationError):
    """Too few variations passed verification."""


class StorageError(AomgenError):
    """Results cannot be written or read back."""

    exit_code = 6


class CorruptArtifactError(StorageError):
    """A stored result does not match its digest."""


class OutdatedRunError(StorageError):
    """A result was computed by another version of AOMGen.

    Args:
        run: Folder of the run.
        stage: Name of the stage that made the result.
        made: Version of the stage that made it.
        current: Version of the stage in this installation.
    """

    def __init__(self, run: object, stage: str, made: int, current: int) -> None:
        self.run, self.stage, self.made, self.current = str(run), stage, made, current
        super().__init__(
            run,
            f"contains a result of version {made} of stage '{stage}', but the current version is {current}",
            f"bring it up to date with `aomgen run {run}`",
        )


class LockedError(StorageError):
    """Another process uses the same output folder."""


class WorkerError(AomgenError):
    """A child process died or ran out of time."""

    exit_code = 7
