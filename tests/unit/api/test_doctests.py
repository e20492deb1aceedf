"""Every public name has an example, and every example gives what it states."""

import doctest
import inspect
import re
from pathlib import Path

import numpy as np
import pytest

import aomgen as ag
from aomgen.cli.run import sample_capture
from finished_run import VARIABLE, copy_finished_run

# Names whose docstring needs no example: errors, and values that functions return.
VALUES = {
    *(
        "Demonstration",
        "FittedAsset",
        "Gaussians",
        "JointFit",
        "MotionEstimate",
        "Plan",
        "Rejection",
        "Scene",
    ),
    *("Episode", "Robot", "State", "Verdict"),
}


def examples() -> list[tuple[str, doctest.DocTest]]:
    found = []
    for name in ag.__all__:
        thing = getattr(ag, name)
        members = (
            inspect.getmembers(thing)
            if inspect.isclass(thing) and thing.__module__.startswith("aomgen.api")
            else []
        )
        for label, item in [
            (name, thing),
            *((f"{name}.{key}", value) for key, value in members if not key.startswith("_")),
        ]:
            text = inspect.getdoc(item) or ""
            if ">>>" in text:
                test = doctest.DocTestParser().get_doctest(text, {"ag": ag, "np": np}, label, None, 0)
                found.append((label, test))
    return found


EXAMPLES = examples()


@pytest.mark.parametrize(("label", "test"), EXAMPLES, ids=[label for label, _ in EXAMPLES])
def test_examples_give_what_they_state(
    label: str, test: doctest.DocTest, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_capture").symlink_to(sample_capture())
    if '"out"' in test.docstring and copy_finished_run(tmp_path) is None:
        pytest.skip(f"{VARIABLE} names no finished run")
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    said: list[str] = []
    runner.run(test, out=said.append)
    assert runner.failures == 0, "".join(said)


def test_every_public_name_has_an_example() -> None:
    shown = {label.split(".")[0] for label, _ in EXAMPLES}
    errors = {
        name
        for name in ag.__all__
        if inspect.isclass(getattr(ag, name)) and issubclass(getattr(ag, name), Exception)
    }
    assert set(ag.__all__) - shown - errors - VALUES - {"__version__"} == set()


def test_docstrings_of_public_names_are_sentences() -> None:
    for name in ag.__all__[1:]:
        first = (inspect.getdoc(getattr(ag, name)) or "").splitlines()[0]
        assert first.endswith("."), name


def test_the_reference_lists_every_public_name() -> None:
    text = (Path(__file__).parents[3] / "docs" / "api.md").read_text("utf-8")
    assert [name for name in ag.__all__[1:] if not re.search(rf"`{name}\b|\b{name}`", text)] == []
