"""Every command in the documentation exists, has the flags that it is written with, and can be imported as a user would."""

import argparse
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer

from aomgen.cli.app import app as aomgen_app
from benchmarks.__main__ import app as benchmarks_app
from synthetic.__main__ import app as synthetic_app

REPOSITORY = Path(__file__).parents[3]
PARSERS = {
    "aomgen": typer.main.get_command(aomgen_app),
    "python -m benchmarks": typer.main.get_command(benchmarks_app),
    "python -m synthetic": typer.main.get_command(synthetic_app),
}
# What typer's parsers raise; not public by itself.
UsageError: Any = typer.BadParameter.__base__
PROGRAM = re.compile(
    r"(?:^|[\s/@])(aomgen|python3? -m (?:benchmarks|synthetic)[\w.]*|python examples/[\w.]+)(?: ([^;|&`]*))?$"
)
# What stands for a value in documentation: FOLDER, N, FILE#JOINT.
PLACEHOLDER = re.compile(r"[A-Z][A-Z_]*")


class Written(NamedTuple):
    """A command as it is written somewhere; `complete` unless it stands within a sentence."""

    place: str
    program: str
    words: list[str]
    complete: bool


def find_commands(path: Path) -> Iterator[Written]:
    text = path.read_text("utf-8").replace("\\\n", " ")
    name = str(path.relative_to(REPOSITORY))
    if path.suffix == ".md":
        blocks = re.findall(r"^ *```[^\n]*\n(.*?)^ *```", text, re.S | re.M)
        prose = re.sub(r"^ *```.*?^ *```", "", text, flags=re.S | re.M)
        spans = [span.replace("\n", " ") for span in re.findall(r"`([^`]+)`", prose)]
        lines = [line for block in blocks for line in block.splitlines()]
    elif path.suffix == ".py":
        spans, lines = text.split('"""')[1].splitlines()[:1], []
    else:
        # A list in a variable becomes one of its flags, another variable its name.
        text = re.sub(r"\$\(\w+:%=(--[\w-]+) %\)", r"\1 X", text.replace("$(BIN)/", ""))
        spans, lines = [], re.sub(r"\$\((\w+)\)", r"\1", text).splitlines()
    for complete, written in ((True, lines), (False, spans)):
        for line in written:
            for part in re.split(r"[;|&]+", re.sub(r"(^|\s)#.*", "", line)):
                found = PROGRAM.search(part.strip())
                if found and "import aomgen" not in part and (found[2] or found[1].startswith("python")):
                    words = shlex.split(re.sub(r"\[(--[^]]*)\]|\.\.\.", r"\1 ", found[2] or ""))
                    yield Written(name, found[1].replace("python3", "python"), words, complete)


DOCUMENTS = [
    *(REPOSITORY / name for name in ("README.md", "CONTRIBUTING.md", "Makefile", ".ci/run")),
    *sorted((REPOSITORY / "docs").glob("*.md")),
    *sorted((REPOSITORY / "examples").glob("*.py")),
]
# Options that write to the user's shell while they are parsed.
COMPLETION = ("--install-completion", "--show-completion")
COMMANDS = [command for path in DOCUMENTS for command in find_commands(path)]


def parse(command: Any, words: list[str], *, complete: bool) -> None:
    """Parse words as a command does, without running it; in a sentence, arguments and values may be missing.

    Raises:
        UsageError: A command, a flag or a value that there is not.
    """
    if words and words[0] in COMPLETION:
        assert words[0] in [option for parameter in command.params for option in parameter.opts]
        return
    # A placeholder may stand for a number.
    words = ["1" if PLACEHOLDER.fullmatch(word) else word for word in words]
    try:
        if not hasattr(command, "resolve_command"):
            command.make_context(command.name, words)
        elif words:
            context = command.make_context(command.name, list(words))
            _, inner, rest = command.resolve_command(context, [*context._protected_args, *context.args])
            parse(inner, rest, complete=complete)
    except typer.Exit:
        return
    except UsageError as error:
        if complete or type(error).__name__ not in ("MissingParameter", "BadOptionUsage"):
            raise


def parse_example(script: Path, words: list[str]) -> None:
    """Let an example parse its command line, and stop it there."""
    text = script.read_text("utf-8")
    if "ArgumentParser(" not in text:
        assert len(words) == len(set(re.findall(r"sys\.argv\[\d\]", text)))
        return

    class Parsed(Exception):
        """The command line is right."""

    original = argparse.ArgumentParser.parse_args

    def stop(self, *arguments):
        original(self, *arguments)
        raise Parsed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", stop)
        patch.setattr(sys, "argv", [str(script), *words])
        patch.setattr(sys, "path", [str(script.parent), *sys.path])
        with pytest.raises(Parsed):
            runpy.run_path(str(script), run_name="__main__")


def test_commands_are_found():
    programs = [command.program for command in COMMANDS]
    assert programs.count("aomgen") > 20
    assert programs.count("python -m benchmarks") > 20
    assert {"python -m synthetic", "python -m benchmarks.gsplat_parity"} <= set(programs)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: f"{c.place}: {c.program} {' '.join(c.words)}")
def test_command_is_parsed(command: Written):
    if command.program in PARSERS:
        parse(PARSERS[command.program], command.words, complete=command.complete)
    elif "examples/" in command.program:
        parse_example(REPOSITORY / command.program.split()[1], command.words)
    else:
        assert command.words == [], "a module that is no command line of typer has no documented flags"


@pytest.mark.parametrize(
    "words", [["no-such-command"], ["splatting", "--no-such-flag"], ["intervals", "--worlds", "many"]]
)
def test_wrong_commands_are_seen(words: list[str]):
    with pytest.raises(UsageError):
        parse(PARSERS["python -m benchmarks"], words, complete=False)


# Imports all modules of both packages but those that run inside other programs, as `python -m` would find them.
IMPORT_ALL = """
import importlib, pkgutil, sys
import benchmarks, synthetic
for package in (benchmarks, synthetic):
    for module in pkgutil.iter_modules(package.__path__):
        if module.name != "blender_tracer":
            importlib.import_module(f"{package.__name__}.{module.name}")
"""


def test_modules_are_imported_from_the_repositorys_root():
    subprocess.run([sys.executable, "-c", IMPORT_ALL], cwd=REPOSITORY, check=True, timeout=300)


@pytest.mark.parametrize("package", ["benchmarks", "synthetic"])
def test_packages_run_as_programs(package: str):
    done = subprocess.run(
        [sys.executable, "-m", package, "--help"], cwd=REPOSITORY, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"Usage: python -m {package}")
