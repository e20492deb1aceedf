"""Surfels of assets are fitted once, and again if the stored ones are damaged."""

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.io.reuse import StoredFileWarning
from aomgen.replacement import asset_surfels, surfel_cache
from aomgen.replacement.surfel_cache import find_all_surfels, find_surfels, fit_in_background
from aomgen.splatting.surfels import Surfels, surfels_of

Pair = tuple[Surfels, Surfels]


@pytest.fixture(scope="module")
def asset() -> ArticulatedAsset:
    return make_asset("toolbox", 3)


@pytest.fixture
def fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the assets that were fitted; the fit is a quick cover, and the cache is empty."""
    found = list[str]()

    def cover(asset: ArticulatedAsset, rng: np.random.Generator) -> Pair:
        found.append(asset.name)
        return surfels_of(asset.static.meshes, 200, rng), surfels_of(asset.moving.meshes, 200, rng)

    monkeypatch.setenv("AOMGEN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(asset_surfels, "fit_surfels", cover)
    return found


def same(a: Pair, b: Pair) -> bool:
    return all(
        np.array_equal(x.gaussians.means, y.gaussians.means) and np.array_equal(x.transfer, y.transfer)
        for x, y in zip(a, b, strict=True)
    )


def test_an_asset_is_fitted_once(asset: ArticulatedAsset, fits: list[str]) -> None:
    first = find_surfels(asset)
    # A name does not change what an asset looks like.
    assert same(find_surfels(replace(asset, name="other")), first)
    assert fits == [asset.name]


def test_another_look_or_effort_is_another_fit(
    asset: ArticulatedAsset, fits: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    find_surfels(asset)
    mesh = replace(asset.static.meshes[0], opacity=0.5)
    find_surfels(replace(asset, static=replace(asset.static, meshes=(mesh, *asset.static.meshes[1:]))))
    monkeypatch.setattr(asset_surfels, "ROUNDS", 3)
    find_surfels(asset)
    assert len(fits) == 3


@pytest.mark.parametrize("file", ["static.npz", "static.json", "moving.npz", "moving.json"])
def test_a_damaged_entry_is_fitted_again_with_one_warning(
    file: str, asset: ArticulatedAsset, fits: list[str], tmp_path: Path
) -> None:
    first = find_surfels(asset)
    (stored,) = (tmp_path / "cache" / "surfels").glob(f"*/{file}")
    stored.write_bytes(stored.read_bytes()[:50])
    with pytest.warns(StoredFileWarning, match="cannot be reused") as caught:
        assert same(find_surfels(asset), first)
    assert len(caught) == 1
    assert same(find_surfels(asset), first)
    assert len(fits) == 2


def test_stored_assets_of_a_run_are_checked_once_and_count_as_used(
    asset: ArticulatedAsset, fits: list[str], tmp_path: Path
) -> None:
    first = find_surfels(asset)
    (entry,) = (tmp_path / "cache" / "surfels").iterdir()
    os.utime(entry, (0, 0))
    (entry / "static.npz").write_bytes(b"")
    with pytest.warns(StoredFileWarning, match="cannot be reused") as caught:
        ((number, found),) = find_all_surfels({4: asset}, 1)
    assert (number, len(caught), len(fits)) == (4, 1, 2)
    assert same(found, first)
    assert entry.stat().st_mtime > 0


def test_without_a_writable_folder_nothing_is_stored(
    asset: ArticulatedAsset, fits: list[str], tmp_path: Path
) -> None:
    (tmp_path / "cache").write_text("a file")
    with pytest.warns(StoredFileWarning, match="not stored"):
        find_surfels(asset)
    assert len(fits) == 1


def test_the_least_recently_used_assets_are_forgotten(
    asset: ArticulatedAsset, fits: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(surfel_cache, "KEPT", 1)
    find_surfels(asset)
    find_surfels(make_asset("toolbox", 4))
    find_surfels(asset)
    assert fits == ["toolbox-3", "toolbox-4", "toolbox-3"]


@pytest.mark.slow
def test_what_the_background_has_fitted_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A real fit, in the background process, which this process awaits."""
    monkeypatch.setenv("AOMGEN_CACHE", str(tmp_path / "cache"))
    asset = make_asset("toolbox", 3)
    entries = tmp_path / "cache" / "surfels"
    with fit_in_background(["toolbox:3"]):
        while not list(entries.glob("*")):
            time.sleep(0.1)
        # The process locks the entry that it has just made.
        time.sleep(1.0)
        monkeypatch.setattr(asset_surfels, "fit_surfels", None)
        static, _ = find_surfels(asset)
    assert len(static.gaussians) > 1000
    ((number, found),) = find_all_surfels({4: asset}, 1)
    assert number == 4
    assert np.array_equal(found[0].gaussians.means, static.gaussians.means)
