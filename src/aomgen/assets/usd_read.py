"""Reading articulated USD assets safely: a child process parses, this one only takes arrays.

The child is `python -m aomgen.assets.usd_read FILE FOLDER JOINT CHOICES`: it writes the asset into FOLDER; an error of ours
becomes a JSON line on standard error and exit code REFUSED, anything else is a crash that the parent reports.
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

# Largest USD file read, and address space of the child, [bytes]: far above usual assets, and room to read it.
MAX_BYTES, MAX_MEMORY_BYTES = 512 << 20, 8 << 30
# Usual assets take a few seconds, [s]; a parser that hangs is stopped.
TIMEOUT_S = 120.0
# Exit code of an asset that is refused with a message; 1 and 2 are the interpreter's own.
REFUSED = 3
ARTIFACT = "asset"
SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def read_usd(
    path: Path,
    joint: str = "",
    *,
    limits: Sequence[float] = (),
    handle: Sequence[float] = (),
    timeout_s: float = TIMEOUT_S,
) -> ArticulatedAsset:
    """Read an articulated asset in a child process, so that a parser crash stays a typed error.

    Any metersPerUnit and upAxis, instances, face subsets, UsdPreviewSurface or MDL materials
    are understood; the result is metric, Z up, its front towards -y, standing on z = 0 (see
    `usd_parse.parse_usd`). Whatever the file refers to must lie in its folder.

    Raises:
        MissingFileError: The file or one of its textures is not there.
        MalformedFileError: Not USD, damaged, or the parser crashed or ran out of time.
        LimitExceededError: Larger than what is read without asking.
        UnsafePathError: A layer or texture lies outside the file's folder.
        AssetError: Several revolute or prismatic joints and none named, or no usable geometry.
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
        choices = json.dumps({"limits": list(limits), "handle": list(handle)})
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
    """The error that the child put on the last line of its standard error."""
    try:
        values = json.loads(message.strip().splitlines()[-1])
        return restore_error(values["error"], values["args"], values["values"])
    except (ValueError, IndexError, KeyError):
        return MalformedFileError(path, "cannot be parsed as USD", "open and export the asset again")


def parse_as_child(arguments: list[str]) -> int:
    """Parse the joint `arguments[2]` of file `arguments[0]` into folder `arguments[1]`; returns the exit code.

    `arguments[3]` holds limits and handle in JSON, as `parse_usd` takes them.
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
