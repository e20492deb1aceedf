"""Pipelines as folders have them, and a tiny one that paints what is not known."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from aomgen.errors import BackendError
from aomgen.replacement import diffusion_inpainting, diffusion_light
from aomgen.replacement.diffusion_inpainting import paint_unknown
from aomgen.replacement.diffusion_pipeline import load_pipeline
from tiny_diffusion import save_inpainting_pipeline

has_diffusers = importlib.util.find_spec("diffusers") is not None
needs_diffusers = pytest.mark.skipif(not has_diffusers, reason="needs the extra `diffusion`")
KINDS = (diffusion_light.PIPELINE, diffusion_inpainting.PIPELINE)


@pytest.mark.skipif(has_diffusers, reason="diffusers is installed")
def test_without_the_extra_it_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        BackendError, match=r"diffusers: cannot be loaded .*pip install 'aomgen\[diffusion\]'"
    ):
        load_pipeline(tmp_path, KINDS[0])


@needs_diffusers
@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_without_a_pipeline_is_refused(tmp_path: Path, kind: str) -> None:
    with pytest.raises(BackendError, match=f"holds no {kind}"):
        load_pipeline(tmp_path, kind)


@pytest.mark.slow
@needs_diffusers
def test_a_saved_pipeline_paints_what_is_not_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diffusion_inpainting, "STEPS", 2)
    save_inpainting_pipeline(tmp_path)
    image = np.repeat(np.linspace(0.3, 0.7, 90)[None, :, None], 70, 0) * np.ones(3)
    known = np.ones((70, 90), bool)
    known[20:50, 30:60] = False
    hidden = np.where(known[..., None], image, 0.0)
    first, again, other = (paint_unknown(tmp_path, hidden, known, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first[known], image[known])
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    # Random weights paint anything; in the mean it goes on from the border.
    assert abs(first[~known].mean() - image[~known].mean()) < 0.1
    assert (paint_unknown(tmp_path, image, np.zeros((70, 90), bool), 1) == 0.5).all()
