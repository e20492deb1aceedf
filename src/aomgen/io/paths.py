"""The one resolver of paths that stand inside files."""

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
