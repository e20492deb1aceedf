"""Torch on one thread: these tests do many small operations, which threads only slow down."""

from collections.abc import Iterator

import pytest

from benchmarks.timing import torch_threads


@pytest.fixture(autouse=True, scope="package")
def _one_torch_thread() -> Iterator[None]:
    with torch_threads(1):
        yield
