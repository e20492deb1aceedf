"""Manifests, which state the inputs and files of a stage's result, and the record of the last command of a run."""

import hashlib
import os
import stat
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from aomgen.errors import CorruptArtifactError
from aomgen.io.artifact import MAX_LIST_BYTES, file_digest, read_json
from aomgen.io.atomic import STAGING_PREFIX, write_json

MANIFEST = "manifest.json"
RUN_RECORD = "run.json"
# Version of a stage, digests of its inputs by name, and its parameters.
Identity = tuple[int, dict[str, str], dict[str, Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """Identity and content of one stage's result, without times, host or user.

    Attributes:
        stage: Name of the stage.
        version, inputs, parameters: See `Identity`.
        files: SHA-256 and size, [bytes], of every file in the folder, by relative path.
        figures: Metrics of the result, by name.
        warnings: Sentences for the user about deficiencies of the inputs and their consequences.
        digest: SHA-256 over `files`.
    """

    stage: str
    version: int
    inputs: dict[str, str]
    parameters: dict[str, Any]
    files: dict[str, tuple[str, int]]
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    digest: str = ""

    @property
    def identity(self) -> Identity:
        """Version, inputs and parameters of the result."""
        return self.version, self.inputs, self.parameters


def write_manifest(
    folder: Path, stage: str, identity: Identity, figures: dict[str, Any], warnings: tuple[str, ...] = ()
) -> Manifest:
    """Hash every file of a finished folder and write its manifest, whose presence marks the folder as complete.

    Args:
        folder: Folder of the result.
        stage: Name of the stage.
        identity: Version, inputs and parameters of the result.
        figures: Metrics of the result.
        warnings: Sentences for the user.

    Raises:
        StorageError: Writing to the disk failed.
    """
    version, inputs, parameters = identity
    files = {
        path.relative_to(folder).as_posix(): (file_digest(path), path.stat().st_size)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != MANIFEST and not _is_staging(path, folder)
    }
    digest = text_digest("\n".join(f"{name} {sha}" for name, (sha, _) in files.items()))
    manifest = Manifest(
        stage=stage,
        version=version,
        inputs=inputs,
        parameters=parameters,
        files=files,
        figures=figures,
        warnings=warnings,
        digest=digest,
    )
    write_json(folder / MANIFEST, asdict(manifest))
    return manifest


def read_manifest(folder: Path) -> Manifest | None:
    """Read the manifest of a folder; None if the stage has not finished there.

    Raises:
        MalformedFileError: The file is not JSON.
        CorruptArtifactError: The file is not a manifest.
    """
    path = folder / MANIFEST
    if not path.is_file():
        return None
    data = read_json(path, MAX_LIST_BYTES)
    try:
        files = {name: (sha, size) for name, (sha, size) in data.pop("files").items()}
        warnings = tuple(str(sentence) for sentence in data.pop("warnings", ()))
        return Manifest(files=files, warnings=warnings, **data)
    except (TypeError, KeyError, ValueError) as error:
        raise CorruptArtifactError(
            path, "is not a manifest", f"delete the folder {folder} and run again"
        ) from error


def find_damage(folder: Path, manifest: Manifest, *, content: bool = False) -> Iterator[str]:
    """Yield the relative paths of the files that are missing, unreadable or of another size than the manifest states.

    Args:
        folder: Folder of the result.
        manifest: Its manifest.
        content: Also read every file and compare its digest.
    """
    root = os.fspath(folder)
    for name, (sha256, size) in manifest.files.items():
        try:
            have = os.stat(f"{root}/{name}")
            intact = stat.S_ISREG(have.st_mode) and have.st_size == size
            intact = intact and (not content or file_digest(folder / name) == sha256)
        except OSError:
            intact = False
        if not intact:
            yield name


def files_digest(paths: list[Path]) -> str:
    """Compute the SHA-256 over the names and contents of files, in the given order."""
    return text_digest("\n".join(f"{path.name} {file_digest(path)}" for path in paths))


def text_digest(text: str) -> str:
    """Compute the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def _is_staging(path: Path, folder: Path) -> bool:
    return any(part.startswith(STAGING_PREFIX) for part in path.relative_to(folder).parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """The last command that changed a run, the version of AOMGen, and the time at which the command finished.

    The time is in ISO 8601 with UTC offset; it is stored here, because manifests do not contain times.
    """

    command: str
    version: str
    finished: str


def save_record(out: Path, record: RunRecord) -> None:
    """Write the record to the folder of a run.

    Raises:
        StorageError: Writing to the disk failed.
    """
    write_json(out / RUN_RECORD, asdict(record))


def load_record(out: Path) -> RunRecord | None:
    """Read the record of a run; None if no command has finished there.

    Raises:
        CorruptArtifactError: The file is not a record.
    """
    path = out / RUN_RECORD
    if not path.is_file():
        return None
    try:
        return RunRecord(**read_json(path))
    except TypeError as error:
        raise CorruptArtifactError(path, "is not the record of a run", "delete it") from error
