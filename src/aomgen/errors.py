"""One hierarchy of errors; each family has an exit code and each error writes one sentence.

A sentence says where, what (value against limit) and what to do:
`demo/joints.csv, row 12: 'elbow_joint' is nan; re-export the log`.
"""


class AomgenError(Exception):
    """Base of everything AOMGen raises on purpose.

    Args:
        where: File, stage or argument the problem was found in.
        problem: What is wrong, with the value and the limit it broke.
        remedy: What the user can do about it.
    """

    exit_code = 1

    def __init__(self, where: object, problem: str, remedy: str = "") -> None:
        self.where = str(where)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{where}: {problem}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type["AomgenError"], tuple[str, str, str]]:
        """Errors of worker processes arrive as they were raised."""
        return type(self), (self.where, self.problem, self.remedy)


class ConfigError(AomgenError):
    """An option or a project setting is wrong."""

    exit_code = 2


class InputError(AomgenError):
    """A file of the user's is missing, damaged or inconsistent."""

    exit_code = 3


class MissingFileError(InputError):
    """A file that a capture or an asset names is not there."""


class MalformedFileError(InputError):
    """A file does not follow its format."""


class UnsafePathError(InputError):
    """A reference leaves the folder it belongs to."""


class LimitExceededError(InputError):
    """A file is larger than what is read without asking."""


class IncompleteCaptureError(InputError):
    """A recording misses frames or joint rows."""


class NonFiniteError(InputError):
    """A number is NaN or infinite."""


class UnitsError(InputError):
    """Numbers look like another unit (degrees, millimetres)."""


class CalibrationError(InputError):
    """Intrinsics do not belong to the images."""


class AssetError(InputError):
    """An articulated asset cannot be used as it is."""


class SeveralJointsError(AssetError):
    """A file has several joints, and none is named."""

    @property
    def joints(self) -> list[str]:
        """Their names, as the sentence lists them."""
        return self.problem.partition(": ")[2].split(", ")


class BackendError(AomgenError):
    """A library, driver or weight file is missing or broken."""

    exit_code = 4


class PolicyServerError(BackendError):
    """The server of a policy is away, failed, or answers something else."""


class EstimationError(AomgenError):
    """An estimator refuses to answer, because its evidence is too weak."""

    exit_code = 5


class ReconstructionError(EstimationError):
    """Structure from motion or Gaussian training did not reach its gate."""


class AlignmentError(EstimationError):
    """Scene and robot could not be brought into one frame with confidence."""


class SyncError(EstimationError):
    """The clock offset between video and joint log is not determined."""


class WrongPromptError(EstimationError):
    """Prompts and demonstration name different parts as the moving one."""


class NoMotionError(EstimationError):
    """The video shows no motion of the movable part."""


class DemonstrationTooShortError(EstimationError):
    """The part moved too little to tell its joint."""


class AmbiguousJointError(EstimationError):
    """Two joint hypotheses explain the demonstration equally well."""


class NotEnoughEpisodesError(EstimationError):
    """Too few variations passed verification."""


class StorageError(AomgenError):
    """Results cannot be written or read back."""

    exit_code = 6


class CorruptArtifactError(StorageError):
    """A stored result does not match its digest."""


class LockedError(StorageError):
    """Another process works on the same output folder."""


class WorkerError(AomgenError):
    """A child process died or ran out of time."""

    exit_code = 7
