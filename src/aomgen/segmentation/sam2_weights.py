"""Location of SAM 2 weights, and their installation by `python -m aomgen.segmentation.sam2_weights`.

A set of weights is a folder with `config.json` and `model.safetensors`, as publishers provide it for `transformers`.
The installation compares the file with the SHA-256 digest on the publisher's page, copies both files under a name and
stores the digests, which are checked again at every use. Other formats are not supported, because they may contain code.
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
    """List the names of the installed sets of weights, sorted; `folder` is as for `find_sam2`."""
    root = (folder or weights_folder()) / FOLDER
    return tuple(sorted(path.parent.name for path in root.glob(f"*/{NOTE}")))


def find_sam2(name: str, folder: Path | None = None) -> Path:
    """Find the folder of installed weights, and check the digests of its files `CONFIG` and `WEIGHTS`.

    Args:
        name: Name under which the weights were installed.
        folder: Folder of all weights; None uses `weights_folder()`.

    Raises:
        BackendError: The weights are missing, or a file has changed since the installation.
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
    """Copy a downloaded model under a name and return its folder.

    Args:
        source: Folder with `config.json` and `model.safetensors`.
        name: Name of letters, digits, dots, dashes and underscores, for example "sam2.1-hiera-tiny".
        sha256: SHA-256 digest of `model.safetensors`, as its publisher states it.
        folder: Folder of all weights; None uses `weights_folder()`.

    Raises:
        BackendError: The name is invalid, a file is missing, or the digest differs.
        StorageError: Writing to the disk failed.
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
    """Install downloaded weights and return the exit code."""
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
