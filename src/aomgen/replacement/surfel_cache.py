"""Surfels of assets in the user's cache folder: each asset is fitted once, by a run or in the background of its first stages."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.assets.choice import ORIGINAL, open_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import AomgenError, StorageError
from aomgen.executors import Processes, Work, run_units
from aomgen.io.artifact import artifact_digest, load_artifact, save_artifact
from aomgen.io.atomic import lock_folder, remove_folder
from aomgen.io.cache import cache_folder
from aomgen.io.reuse import reuse, warn_of_file
from aomgen.replacement import asset_surfels
from aomgen.splatting.surfels import Surfels

FOLDER: Final = "surfels"
# Version of the fit, increased whenever a fit of the same asset gives another result.
VERSION: Final = 1
# Number of assets that are kept, the most recently used ones; one takes about 10 MB.
KEPT: Final = 64
# Files of an asset without suffix, and the file that is written last, so that it marks a complete asset.
LINKS: Final = ("static", "moving")
LAST_FILE: Final = "moving.json"
# Largest time to fit the surfels of one asset, which takes half a minute, [s].
FIT_S: Final = 1800.0
DIGEST_LENGTH: Final = 64
# Niceness of background processes, which use only idle cores.
IDLE_PRIORITY: Final = 19


def find_surfels(asset: ArticulatedAsset) -> tuple[Surfels, Surfels]:
    """Return the surfels of an asset's static and moving link, from the cache or else by a fit, which is then stored.

    If another process fits the same asset, its result is awaited. Without a writable cache folder, nothing is stored and the
    user is warned.

    Raises:
        AssetError, BackendError: See `fit_surfels`.
    """
    entry = _entry(asset)
    try:
        entry.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        warn_of_file(
            entry.parent, f"cannot be written ({error.strerror})", "surfels of assets are not stored"
        )
        return _fit(asset)
    with lock_folder(entry):
        found = _load(entry)
        if found is None:
            found = _fit(asset)
            try:
                for name, surfels in zip(LINKS, found, strict=True):
                    save_artifact(entry, name, surfels)
            except StorageError as error:
                warn_of_file(entry, error.problem, "surfels of assets are not stored")
        os.utime(entry)
    _forget_oldest(entry.parent)
    return found


def find_all_surfels(
    assets: Mapping[int, ArticulatedAsset], workers: int
) -> Iterator[tuple[int, tuple[Surfels, Surfels]]]:
    """Find the surfels of several assets and yield them with their numbers: first the stored ones, then each one that is fitted.

    Every fit has a separate process. The errors are those of `find_surfels`.
    """
    missing = [number for number, asset in assets.items() if not (_entry(asset) / LAST_FILE).is_file()]
    for number, asset in assets.items():
        if number not in missing:
            yield number, find_surfels(asset)
    if missing:
        executor = Processes(partial(_open, assets), min(workers, len(missing)), FIT_S)
        for done in run_units(missing, executor):
            yield done.unit, done.value


@contextmanager
def fit_in_background(specs: Sequence[str]) -> Iterator[None]:
    """Fit the assets of a project (see `Project.assets`) one after the other while the block runs, on cores that are idle.

    Errors are not reported here: the fit is repeated where its result is needed.
    """
    if not specs:
        yield
        return
    with Processes(_open_background, 1, FIT_S) as executor:
        executor.submit(tuple(specs))
        yield


def _open(assets: Mapping[int, ArticulatedAsset]) -> Work:
    return lambda number: find_surfels(assets[number])


def _open_background() -> Work:
    os.nice(IDLE_PRIORITY)
    return _fit_specs


def _fit_specs(specs: Sequence[str]) -> None:
    for spec in specs:
        if spec != ORIGINAL:
            try:
                find_surfels(open_asset(spec))
            except AomgenError:
                return


def _fit(asset: ArticulatedAsset) -> tuple[Surfels, Surfels]:
    return asset_surfels.fit_surfels(asset, np.random.default_rng(0))


def _load(entry: Path) -> tuple[Surfels, Surfels] | None:
    """Load the surfels of an entry; None if it is incomplete or, after a warning, damaged."""

    def read() -> tuple[Surfels, Surfels]:
        static, moving = (load_artifact(entry, name, Surfels) for name in LINKS)
        return static, moving

    return reuse(entry / LAST_FILE, read)


def _entry(asset: ArticulatedAsset) -> Path:
    """Return the folder of an asset, named by the digest of its links, its joint and the effort of the fit."""
    parts = VERSION, asset_surfels.effort(), asset.static, asset.moving, asset.joint
    return cache_folder(FOLDER) / artifact_digest(parts)


def _forget_oldest(folder: Path) -> None:
    with lock_folder(folder):
        entries = [entry for entry in folder.iterdir() if len(entry.name) == DIGEST_LENGTH]
        for entry in sorted(entries, key=lambda entry: entry.stat().st_mtime)[:-KEPT]:
            remove_folder(entry)
