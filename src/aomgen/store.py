"""Store of archives for computers that share no disk: a folder, or the URL of an object store.

An archive is one object `URL/NAME.zip`. It is written by one put, so that readers find the complete archive or none: object
stores show an object when its upload is complete, and a file in a folder is renamed when it is complete.
"""

import errno
import importlib
import importlib.util
import io
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, Final

from aomgen.errors import (
    AomgenError,
    BackendError,
    ConfigError,
    LimitExceededError,
    MalformedFileError,
    StorageError,
    UnsafePathError,
    quote_error,
)
from aomgen.io.atomic import write_bytes

# Largest content of an archive that is read, [bytes]; that of an episode or of the inputs of a run is far smaller.
MAX_BYTES: Final = 8 << 30


class Store:
    """Archives below a URL.

    Args:
        url: Path of a folder, or a URL of an object store that fsspec knows, for example "s3://bucket/run".

    Raises:
        BackendError: fsspec or its package for this kind of URL is not installed.
        ConfigError: The kind of URL is unknown.
    """

    def __init__(self, url: str) -> None:
        self.url, where = url.rstrip("/"), f"--store {url}"
        if importlib.util.find_spec("fsspec") is None:
            raise BackendError("fsspec", "is not installed", "pip install 'aomgen[ray]'")
        # Untyped, because implementations have further methods and arguments.
        fsspec: Any = importlib.import_module("fsspec")
        local: Any = importlib.import_module("fsspec.implementations.local")
        try:
            self._files, self._root = fsspec.url_to_fs(self.url)
        except ImportError as error:
            raise BackendError(where, f"needs a package ({error})", "install it on every machine") from error
        except ValueError as error:
            raise ConfigError(
                where, f"is not a known kind of store ({error})", "see docs/episodes.md"
            ) from error
        self._local = isinstance(self._files, local.LocalFileSystem)
        if self._local:  # The path of a folder may be relative.
            self.url = self._root

    def begin(self) -> None:
        """Prepare the store for writing: if it is a folder, it is created.

        Raises:
            StorageError: The store cannot be used.
        """
        if self._local:
            with self._explain():
                Path(self._root).mkdir(parents=True, exist_ok=True)

    def put(self, name: str, files: Mapping[str, bytes]) -> None:
        """Write an archive in one step; an archive of this name is replaced.

        Args:
            name: Name of the archive.
            files: Content of the files by relative path.

        Raises:
            StorageError: The store cannot be used.
        """
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for path, content in files.items():
                archive.writestr(zipfile.ZipInfo(path), content)
        with self._explain():
            if not self._local:
                self._files.pipe_file(self._path(name), buffer.getvalue())
            elif not os.path.isdir(
                self._root
            ):  # It is not created again, because it may be a disk that was removed.
                raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), self._root)
            else:
                write_bytes(Path(self._path(name)), buffer.getvalue())

    def get(self, name: str) -> dict[str, bytes]:
        """Read the files of an archive, by relative path.

        Raises:
            StorageError: The store cannot be used, or has no such archive.
            MalformedFileError: The archive is damaged.
            LimitExceededError, UnsafePathError: The archive is too large, or has a path outside its folder.
        """
        with self._explain():
            data = self._files.cat_file(self._path(name))
        where = f"{self.url}/{name}.zip"
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                size = sum(item.file_size for item in archive.infolist())
                if not size <= MAX_BYTES:
                    raise LimitExceededError(where, f"has {size} bytes, limit {MAX_BYTES}")
                files = {item.filename: archive.read(item) for item in archive.infolist()}
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
            raise MalformedFileError(
                where, f"is not an archive ({error})", "delete it and run again"
            ) from error
        for path in map(PurePosixPath, files):
            if path.is_absolute() or ".." in path.parts:
                raise UnsafePathError(where, f"contains the path '{path}'", "delete it and run again")
        return files

    def names(self) -> set[str]:
        """List the names of all archives.

        Raises:
            StorageError: The store cannot be used.
        """
        with self._explain():
            self._files.invalidate_cache()
            paths = self._files.ls(self._root, detail=False)
        return {PurePosixPath(path).stem for path in paths if path.endswith(".zip")}

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}.zip"

    @contextmanager
    def _explain(self) -> Iterator[None]:
        """Raise any error of a storage library as `StorageError`; these libraries have no common class of errors."""
        try:
            yield
        except AomgenError:
            raise
        except Exception as error:
            remedy = "make the store available, then run the same command again to continue"
            raise StorageError(
                self.url, f"the store cannot be used ({quote_error(error)})", remedy
            ) from error


def require_store(url: str) -> None:
    """Check that a store can be written and read.

    Raises:
        AomgenError: See `Store`.
    """
    store = Store(url)
    store.begin()
    store.put("check", {})
    store.get("check")
