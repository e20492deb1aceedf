"""Recipes, imported beside stand-ins of the libraries that they are written for."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from vla_interfaces import RECIPES, write_stand_ins


def imported(library: str, name: str, place: Path, folder: Path) -> Iterator[ModuleType]:
    known = set(sys.modules)
    write_stand_ins(folder, library)
    sys.path[:0] = [str(place), str(folder)]
    try:
        yield importlib.import_module(name)
    finally:
        del sys.path[:2]
        for module in set(sys.modules) - known:
            if module.partition(".")[0] in (name, "openpi", "prismatic"):
                del sys.modules[module]


@pytest.fixture
def pi05(tmp_path) -> Iterator[ModuleType]:
    yield from imported("openpi", "pi05_openpi", RECIPES, tmp_path)


@pytest.fixture(params=["openvla", "openvla_oft"])
def oxe(request, tmp_path) -> Iterator[ModuleType]:
    yield from imported(request.param, "aomgen_oxe", RECIPES / "openvla", tmp_path)
