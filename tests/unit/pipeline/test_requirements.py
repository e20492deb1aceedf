"""What a machine must have for the stages that are still to be made."""

import pytest

from aomgen.errors import BackendError
from aomgen.pipeline import requirements


@pytest.mark.parametrize("missing", ["pycolmap", "torch", "onnxruntime"])
def test_missing_modules(monkeypatch, missing):
    found = requirements.importlib.util.find_spec
    monkeypatch.setattr(
        requirements.importlib.util, "find_spec", lambda name: None if name == missing else found(name)
    )
    with pytest.raises(BackendError, match=f"{missing}: is not installed; pip install"):
        requirements.require_environment(requirements.EVERYTHING, "auto", has_masks=False)


def test_what_is_done_needs_nothing(monkeypatch):
    monkeypatch.setattr(requirements.importlib.util, "find_spec", lambda name: None)
    requirements.require_environment([], "auto", has_masks=False)
    requirements.require_environment(["dataset"], "auto", has_masks=False)


def test_weights(tmp_path, monkeypatch):
    monkeypatch.setenv("AOMGEN_WEIGHTS", str(tmp_path))
    requirements.require_environment(["parts"][:0], "auto", has_masks=False)
    with pytest.raises(BackendError, match="weights are missing"):
        requirements.require_environment(["parts"], "auto", has_masks=False)
    with pytest.raises(BackendError, match=r"sam2-large: no SAM 2 weights of this name .*known: none"):
        requirements.require_environment(["parts"], "sam2-large", has_masks=True)


def test_the_extra_of_light_from_a_photograph(monkeypatch):
    monkeypatch.setattr(requirements, "gl_problem", lambda: "")
    found = requirements.importlib.util.find_spec
    monkeypatch.setattr(
        requirements.importlib.util, "find_spec", lambda name: None if name == "diffusers" else found(name)
    )
    requirements.require_environment(["replacement"], "auto", has_masks=True)
    with pytest.raises(BackendError, match=r"diffusers: is not installed; pip install 'aomgen\[diffusion\]'"):
        requirements.require_environment(["replacement"], "auto", has_masks=True, diffusion=True)


def test_no_opengl_driver(monkeypatch):
    monkeypatch.setattr(requirements, "GL_PROBE", "raise RuntimeError('no device')")
    with pytest.raises(BackendError, match="OpenGL: RuntimeError: no device; install libegl1"):
        requirements.require_environment(["alignment"], "auto", has_masks=True)
