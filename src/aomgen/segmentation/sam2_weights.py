"""SAM 2's weights: their location, and `python -m aomgen.segmentation.sam2_weights` to install them.

A set of weights is a folder as the model's publisher offers it for `transformers`: `config.json` and
`model.safetensors`. Installing copies the two under a name, after the SHA-256 that the publisher's page
shows was compared, and notes it; every use checks the digest again. Other formats are refused: only
safetensors cannot hold code.
"""

import argparse
import re
import shutil
import sys
from pathlib import Path
from typing import Final

from aomgen.errors import AomgenError, BackendError
from aomgen.io.artifact import file_digest, read_json
from aomgen.io.atomic import stage_folder, write_json
from aomgen.segmentation.weights import weights_folder

FOLDER: Final = "sam2"
CONFIG: Final = "config.json"
WEIGHTS: Final = "model.safetensors"
NOTE: Final = "sha256.json"
COMMAND: Final = "python -m aomgen.segmentation.sam2_weights"
NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def list_installed(folder: Path | None = None) -> tuple[str, ...]:
    """Names of the sets of weights that are installed, sorted."""
    root = (folder or weights_folder()) / FOLDER
    return tuple(sorted(path.parent.name for path in root.glob(f"*/{NOTE}")))


def find_sam2(name: str, folder: Path | None = None) -> Path:
    """Find the folder of installed weights, below a folder of all weights; `weights_folder()` when None.

    It holds `CONFIG` and `WEIGHTS`, whose digests are checked.

    Raises:
        BackendError: They are missing, or not the installed ones any more.
    """
    known = list_installed(folder)
    if name not in known:
        raise BackendError(
            name,
            f"no SAM 2 weights of this name are installed (known: {', '.join(known) or 'none'})",
            f"run `{COMMAND} --help`",
        )
    root = (folder or weights_folder()) / FOLDER / name
    note = read_json(root / NOTE)
    for file in (CONFIG, WEIGHTS):
        _check(root / file, note.get(file, ""))
    return root


def install_sam2(source: Path, name: str, sha256: str, folder: Path | None = None) -> Path:
    """Copy a downloaded model under a name; returns its folder.

    Args:
        source: Folder with `config.json` and `model.safetensors`.
        name: Letters, digits, dots and dashes, "sam2.1-hiera-tiny" for example.
        sha256: Of `model.safetensors`, as its publisher states it.

    Raises:
        BackendError: The name cannot be a folder, a file is missing, or the digest differs.
    """
    if not NAME.fullmatch(name):
        raise BackendError(name, "is not a valid name for weights", "use letters, digits, dots and dashes")
    _check(source / WEIGHTS, sha256.lower())
    if not (source / CONFIG).is_file():
        raise BackendError(source / CONFIG, "is missing", "download it to the folder of the weights")
    with stage_folder((folder or weights_folder()) / FOLDER / name) as staging:
        for file in (CONFIG, WEIGHTS):
            shutil.copyfile(source / file, staging / file)
        write_json(staging / NOTE, {CONFIG: file_digest(staging / CONFIG), WEIGHTS: sha256.lower()})
    return find_sam2(name, folder)


def _check(path: Path, sha256: str) -> None:
    if not path.is_file():
        raise BackendError(path, "is missing", f"install the weights with `{COMMAND}`")
    if file_digest(path) != sha256:
        raise BackendError(path, "is not the file whose SHA-256 was given", "download and install it again")


def main(arguments: list[str] | None = None) -> int:
    """Install downloaded weights; returns the exit code."""
    parser = argparse.ArgumentParser(prog=COMMAND, description="Install downloaded SAM 2 weights.")
    parser.add_argument("source", type=Path, help=f"folder with {CONFIG} and {WEIGHTS}")
    parser.add_argument("--name", required=True, help="how projects call them, sam2.1-hiera-tiny for example")
    parser.add_argument("--sha256", required=True, help=f"of {WEIGHTS}, from its publisher's page")
    given = parser.parse_args(arguments)
    try:
        installed = install_sam2(given.source, given.name, given.sha256)
    except AomgenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{installed / WEIGHTS}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
