"""Statements that several files of the repository make: the version, the versions of Python, the checks of a change."""

import re
import tomllib
from pathlib import Path

from aomgen.version import __version__

REPOSITORY = Path(__file__).parents[2]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))
WORKFLOW = (REPOSITORY / ".github/workflows/ci.yml").read_text("utf-8")
CI = (REPOSITORY / ".ci/run").read_text("utf-8")
MAKEFILE = (REPOSITORY / "Makefile").read_text("utf-8")


def find_targets(text: str) -> set[str]:
    return set(re.findall(r"\bmake ([a-z][\w-]*)", text))


def test_there_is_one_version():
    cited = re.search(r"^version: (.+)$", (REPOSITORY / "CITATION.cff").read_text("utf-8"), re.M)
    changed = re.search(r"^## (\S+) - ", (REPOSITORY / "CHANGELOG.md").read_text("utf-8"), re.M)
    assert cited
    assert changed
    assert cited[1] == changed[1] == __version__
    assert "version" in PROJECT["project"]["dynamic"]
    plugins = [tomllib.loads(path.read_text("utf-8")) for path in REPOSITORY.glob("plugins/*/pyproject.toml")]
    assert [plugin["project"]["version"] for plugin in plugins] == [__version__] * 2


def test_the_workflow_runs_targets_that_ci_runs():
    runs = re.findall(r"^ +- run: (.+)$", WORKFLOW, re.M)
    assert runs
    assert all(command.startswith("make ") for command in runs)
    assert find_targets("\n".join(runs)) <= find_targets(CI)


def test_every_supported_python_is_tested():
    matrix = re.search(r"python: \[(.+)\]", WORKFLOW)
    assert matrix
    versions = re.findall(r"3\.\d+", matrix[1])
    assert versions == ["3.11", "3.12", "3.13"]
    assert PROJECT["project"]["requires-python"] == ">=3.11,<3.14"
    assert versions == [kind.split()[-1] for kind in PROJECT["project"]["classifiers"] if "Python ::" in kind]


def test_named_targets_exist():
    existing = set(re.findall(r"^([a-z][\w-]*):", MAKEFILE, re.M))
    documents = ["README.md", "CONTRIBUTING.md", "Dockerfile", ".devcontainer/devcontainer.json"]
    texts = [(REPOSITORY / name).read_text("utf-8") for name in documents]
    texts += [path.read_text("utf-8") for path in (REPOSITORY / "docs").glob("*.md")]
    code = re.findall(r"`(make [^`]+)`|^(?:RUN )?(make .+)$|\"(make .+)\"", "\n".join([*texts, CI]), re.M)
    assert find_targets("\n".join("".join(found) for found in code)) <= existing
