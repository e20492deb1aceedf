"""Figures of the benchmark `environment`."""

from pathlib import Path

import pytest

from benchmarks.environment import worst_psnr
from toy_run import toy_episode


@pytest.mark.slow
def test_images_of_the_environment_are_those_of_episodes(tmp_path: Path) -> None:
    assert worst_psnr(toy_episode(tmp_path)) >= 60
