"""Resolution of paths that are stored inside files."""

from collections.abc import Iterable
from pathlib import Path

from aomgen.errors import MissingFileError, UnsafePathError


def resolve_inside(folder: Path, reference: str, *, named_by: Path) -> Path:
    """Resolve a reference in the file `named_by` to an existing file or folder inside `folder`.

    Args:
        folder: Folder that the resolved path must not leave.
        reference: Path relative to `folder`.
        named_by: File that contains the reference, for messages.

    Returns:
        Absolute path, with symbolic links resolved.

    Raises:
        UnsafePathError: The reference is an absolute path or a URL, or leaves `folder` through a link or `..`.
        MissingFileError: The path does not exist.
    """
    if "://" in reference or Path(reference).is_absolute():
        raise UnsafePathError(named_by, f"refers to '{reference}' outside its folder", "use a relative path")
    path = (folder / reference).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise UnsafePathError(named_by, f"refers to '{reference}' outside its folder", "copy the file inside")
    if not path.exists():
        raise MissingFileError(
            path, f"is missing, but {named_by.name} refers to it", "copy it there or correct the path"
        )
    return path


def find_inside(root: Path, folders: Iterable[Path], names: Iterable[str], *, named_by: Path) -> Path:
    """Return the first existing file `folder / name` inside `root`.

    Robot descriptions contain such references, whose base folder is ambiguous.

    Args:
        root: Folder that the resolved path must not leave.
        folders: Base folders, in order of preference.
        names: Relative paths to try in each folder, in order of preference.
        named_by: File that contains the reference, for messages.

    Returns:
        Absolute path, with symbolic links resolved.

    Raises:
        UnsafePathError: A name is an absolute path or a URL, or no file exists and a candidate leaves `root`.
        MissingFileError: No candidate exists.
    """
    candidates, leaves = list(names), False
    for name in candidates:
        if "://" in name or Path(name).is_absolute():
            return resolve_inside(root, name, named_by=named_by)
    for folder in folders:
        for name in candidates:
            path = (folder / name).resolve()
            inside = path.is_relative_to(root.resolve())
            leaves |= not inside
            if inside and path.is_file():
                return path
    if leaves:
        raise UnsafePathError(
            named_by, f"refers to '{candidates[0]}' outside {root.name}", "copy the file inside"
        )
    raise MissingFileError(
        named_by, f"refers to '{candidates[0]}', which is missing", "copy it there or correct the path"
    )
