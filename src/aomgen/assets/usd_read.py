"""Read articulated USD assets in a child process, so that a crash of the parser does not end this process.

The child, `python -m aomgen.assets.usd_read FILE FOLDER JOINT CHOICES`, writes the asset as an artifact to FOLDER. It
reports an `AomgenError` as a JSON line on standard error with exit code REFUSED; any other exit code is a crash.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from aomgen import errors
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import (
    AomgenError,
    LimitExceededError,
    MalformedFileError,
    MissingFileError,
    restore_error,
)
from aomgen.io.artifact import load_artifact, save_artifact

# Largest accepted USD file, and limit of the child's address space, [bytes].
MAX_BYTES, MAX_MEMORY_BYTES = 512 << 20, 8 << 30
# Time after which the child is stopped, [s]; usual assets take a few seconds.
TIMEOUT_S = 120.0
# Exit code if an asset is refused with a message; codes 1 and 2 are used by the interpreter.
REFUSED = 3
ARTIFACT = "asset"
SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def read_usd(
    path: Path,
    joint: str = "",
    *,
    scale: float = 1.0,
    limits: Sequence[float] = (),
    handle: Sequence[float] = (),
    timeout_s: float = TIMEOUT_S,
) -> ArticulatedAsset:
    """Read an articulated asset in a child process, so that a crash of the parser becomes a `MalformedFileError`.

    Any metersPerUnit and upAxis, instances, face subsets, and UsdPreviewSurface and MDL materials are supported. All files
    to which the file refers must be in its folder.

    Args:
        path: USD file.
        joint: Prim name or path of the joint that moves; may be empty if there is only one.
        scale: Factor on all lengths; `limits` and `handle` refer to the unscaled file.
        limits: Lower and upper joint limit relative to the pose in the file, [rad] or [m]; they replace the limits in the
            file.
        handle: Lower and upper corner of a box around the handle, in the coordinates of the stage in meters, Z up.
        timeout_s: Time limit of the child.

    Returns:
        The asset in meters, Z up, with its front toward -y, standing on z = 0; see `usd_parse.parse_usd`.

    Raises:
        MissingFileError: The file or one of its textures is missing.
        MalformedFileError: The file is not USD or damaged, or the parser crashed or exceeded the time limit.
        LimitExceededError: The file or its number of faces is too large.
        UnsafePathError: A layer or texture is outside the file's folder.
        AssetError: There is no joint, or there are several and none is named; the geometry, limits or handle are unusable.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the path of the asset")
    if path.suffix.lower() not in SUFFIXES:
        raise MalformedFileError(
            path, f"has suffix {path.suffix!r}", f"expected one of {', '.join(SUFFIXES)}"
        )
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"has {path.stat().st_size} bytes, limit {MAX_BYTES}")
    with tempfile.TemporaryDirectory(prefix="aomgen-usd-") as folder:
        choices = json.dumps({"scale": scale, "limits": list(limits), "handle": list(handle)})
        _run_child([str(path.resolve()), folder, joint, choices], path, timeout_s)
        return load_artifact(Path(folder), ARTIFACT, ArticulatedAsset)


def _run_child(arguments: list[str], path: Path, timeout_s: float) -> None:
    package_parent = str(Path(errors.__file__).resolve().parent.parent)
    search = os.pathsep.join(filter(None, [package_parent, os.environ.get("PYTHONPATH", "")]))
    command = [sys.executable, "-m", "aomgen.assets.usd_read", *arguments]
    env = {**os.environ, "PYTHONPATH": search}
    try:
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=timeout_s)
    except subprocess.TimeoutExpired as error:
        problem = f"is not parsed within {timeout_s:g} s"
        raise MalformedFileError(path, problem, "simplify the asset") from error
    if done.returncode == REFUSED:
        raise _error_of(done.stderr, path)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1][:300]
        problem = f"stops the USD parser (exit code {done.returncode}: {last})"
        raise MalformedFileError(path, problem, "open and export the asset again")


def _error_of(message: str, path: Path) -> AomgenError:
    """Restore the error from the last line of the child's standard error."""
    try:
        values = json.loads(message.strip().splitlines()[-1])
        return restore_error(values["error"], values["args"], values["values"])
    except (ValueError, IndexError, KeyError):
        return MalformedFileError(path, "cannot be parsed as USD", "open and export the asset again")


def parse_as_child(arguments: list[str]) -> int:
    """Parse a USD file, save the asset as an artifact, and return the exit code.

    Args:
        arguments: File, folder of the artifact, joint name, and `scale`, `limits` and `handle` of `parse_usd` in JSON.
    """
    from aomgen.assets.usd_parse import parse_usd

    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        asset = parse_usd(Path(arguments[0]), arguments[2], **json.loads(arguments[3]))
        save_artifact(Path(arguments[1]), ARTIFACT, asset)
    except AomgenError as error:
        answer = {"error": type(error).__name__, "args": error.args, "values": vars(error)}
        sys.stderr.write(json.dumps(answer) + "\n")
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(parse_as_child(sys.argv[1:]))
