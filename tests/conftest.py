"""Fixtures every test may use."""

import gc
import importlib.resources
import os
import shutil
from pathlib import Path

import pytest
from hypothesis import settings

# A time limit for each example would fail on a busy machine.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")
os.environ.setdefault("MUJOCO_GL", "egl")
# The matrices here are small: a second thread of the linear algebra doubles their time, mostly by waiting.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

SAMPLE = Path(str(importlib.resources.files("aomgen.samples"))) / "microwave-a"


def pytest_collection_finish() -> None:
    """Exclude the objects of the imported modules from garbage collection."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Set the cache folder to one that all workers of a test run share."""
    base = tmp_path_factory.getbasetemp()
    os.environ["AOMGEN_CACHE"] = str((base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache")
    # Downloaded weights are used from the user's folder.
    os.environ.setdefault("AOMGEN_WEIGHTS", str(Path.home() / ".cache" / "aomgen" / "weights"))


@pytest.fixture(scope="session")
def sample() -> Path:
    """The bundled capture; read only."""
    return SAMPLE


@pytest.fixture
def capture_copy(tmp_path: Path) -> Path:
    """A copy of the bundled capture that a test may damage."""
    return Path(shutil.copytree(SAMPLE, tmp_path / "capture"))
