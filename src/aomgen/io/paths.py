"""Resolution of all paths that are found inside files."""

from collections.abc import Iterable
from pathlib import Path

from aomgen.errors import MissingFileError, UnsafePathError


def resolve_inside(folder: Path, reference: str, *, named_by: Path) -> Path:
    """Path of a file or folder that `named_by` refers to, which must lie inside `folder`.

    Raises:
        UnsafePathError: Absolute path, URL, link or `..` that leaves the folder.
        MissingFileError: Nothing is there.
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
    """The first existing combination of a folder and a name; it must lie inside `root`.

    For references that may mean several places, such as those of robot descriptions.

    Raises:
        UnsafePathError: An absolute path, a URL, or a reference that leaves `root`.
        MissingFileError: None of them is there.
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
