"""Every command in a shell block of the documentation is run on a finished run, or is listed with the reason why not."""

import re
import shlex
from pathlib import Path

import pytest

from command_line import aomgen
from documented_files import write_files
from finished_run import VARIABLE, copy_finished_run

REPOSITORY = Path(__file__).parents[3]
PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    *(f"docs/{path.name}" for path in sorted((REPOSITORY / "docs").glob("*.md"))),
)
FENCE = re.compile(r"^( *)```(\S*)\n(.*?)^\1```$", re.S | re.M)

TRAINED = "needs a trained policy; `make datasets-test` trains and evaluates policies with these commands"
INSTALLED = "installs AOMGen, which .ci/run does before"
SERVES = "serves pages until Ctrl+C; tests/unit/viewing and tests/unit/prompting test the pages"
RECORDED = "needs a recording or the robot; tests/unit/importers imports every format"
SERVER = "needs the policy server of another program on a GPU; tests/unit/recipes checks the flags"
EPISODES = "replaces the episodes, which takes a minute; .ci/run calls examples/04_set_a_parameter.py"
PUSHES = "changes the reader's clone"
# Beginning of a command -> why it is not run.
NOT_RUN = {
    "apt-get install": INSTALLED,
    "make install": INSTALLED,
    "make develop": INSTALLED,
    "python3 -m venv": "`make package-test` installs the wheel in a new environment",
    "pip install": "`make package-test` installs the wheel in a new environment",
    "make demo": "takes minutes; .ci/run calls it, and these commands use its run",
    "aomgen demo out": "takes minutes; `make demo` calls it",
    "make quick": "runs a part of `make test`",
    ".venv/bin/python -m pytest": "runs a part of `make test`",
    "make format check": "changes the checkout; .ci/run calls `make check`",
    "git": PUSHES,
    "aomgen --install-completion": "changes the reader's shell",
    "aomgen prompts": SERVES,
    "aomgen view out": SERVES,
    "aomgen view my_capture": SERVES,
    "aomgen run project.toml --set": EPISODES,
    "aomgen run out --set": EPISODES,
    "aomgen run project.toml --ray": "needs a Ray cluster; tests/unit/test_executors.py starts one",
    "ray start": "needs a Ray cluster; tests/unit/test_executors.py starts one",
    "aomgen corpus": "takes minutes for each capture; tests/unit/api/test_corpus.py runs one",
    "aomgen splat": "takes minutes; tests/unit/pipeline/test_splat.py calls it with few small photos",
    "aomgen export out demonstration.rrd": "needs the extra rerun; tests/unit/exports/test_recordings.py",
    "python -m mujoco.viewer": "opens a window; tests/unit/api/test_run_exports.py loads the file",
    "aomgen import demo open": RECORDED,
    "python record.py": RECORDED,
    "ffmpeg": RECORDED,
    "ros2": RECORDED,
    "lerobot-record": RECORDED,
    ". .venv-policy/bin/activate": TRAINED,
    "export ACCELERATE_MIXED_PRECISION": TRAINED,
    "lerobot-train": TRAINED,
    "lerobot-eval": TRAINED,
    "python -m lerobot_policy_aomgen.train_finder": TRAINED,
    "aomgen evaluate suite.json --policy lerobot:": TRAINED,
    "aomgen evaluate --real": "needs trials on a real robot; tests/unit/evaluation/test_real_trials.py",
    ".venv-policy/bin/python -m benchmarks policy": "takes hours; .ci/run calls it with --quick",
    "cp build/sanitize": "replaces the engine; `make sanitize` runs the engine's own tests",
    "LD_PRELOAD": "replaces the engine; `make sanitize` runs the engine's own tests",
    "HF_LEROBOT_HOME": SERVER,
    "uv run": SERVER,
    "sh RECIPES": SERVER,
    "python vla-scripts": SERVER,
    "aomgen evaluate suite.json --policy openpi:": SERVER,
    "aomgen evaluate suite.json --policy openvla:": SERVER,
}
# Text of a command -> what is run in its place: placeholders, large numbers, and files that a reader must own.
REPLACED = {
    "import scan PHOTOS my_capture": "import scan photos imported",
    "import demo RECORDING my_capture": "import demo out/dataset imported",
    "import scan SOURCE my_capture": "import scan photos imported",
    "import demo SOURCE CAPTURE --episode N": "import demo out/dataset imported --episode 1",
    "init my_capture": "init my_capture --project written.toml",
    "--trials 200": "--trials 2",
    "--n 24000": "--n 2",
    "--n 500": "--n 2",
    "--n 6000": "--n 2",
    "--n 1000": "--n 2",
    "fridge.urdf": "fridge.xml",
    "cabinet.urdf": "cabinet.xml",
    "drawer.usda --for": "microwave.usda --for",
    "panda.xml": "arm.urdf",
    "--workers N": "--workers 1",
    "--json F": "--json figures.json",
    "OUT": "out",
    "DATA": "data",
}


def find_commands(page: str) -> list[str]:
    """List the commands of a page's shell blocks in order, without comments."""
    text = (REPOSITORY / page).read_text("utf-8")
    blocks = [block for _, language, block in FENCE.findall(text) if language == "bash"]
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [command for line in lines if (command := re.sub(r"(^|\s)#.*", "", line).strip())]


COMMANDS = {page: commands for page in PAGES if (commands := find_commands(page))}


def replace_words(command: str) -> str:
    """Apply `REPLACED`, and include optional arguments."""
    for written, run in REPLACED.items():
        command = command.replace(written, run)
    return re.sub(r"\[(--[^]]*)\]", r"\1", command)


def is_listed(command: str) -> bool:
    return command.startswith(tuple(NOT_RUN)) and "view out --export" not in command


def test_every_block_names_its_language() -> None:
    bare = [
        f"{page}: {block.splitlines()[0]}"
        for page in PAGES
        for _, language, block in FENCE.findall((REPOSITORY / page).read_text("utf-8"))
        if not language
    ]
    assert bare == [], "write ```bash for commands that a reader runs, ```text for listings"


def test_every_command_is_run_or_listed_and_every_entry_is_used() -> None:
    commands = [command for page in COMMANDS.values() for command in page]
    neither = [c for c in commands if not is_listed(c) and not c.startswith("aomgen ")]
    assert neither == [], "run these commands, or add them to NOT_RUN with a reason"
    assert [entry for entry in NOT_RUN if not any(c.startswith(entry) for c in commands)] == []
    assert [entry for entry in REPLACED if not any(entry in c for c in commands)] == []


@pytest.mark.parametrize("page", COMMANDS)
def test_commands_of_a_page_succeed(page: str, tmp_path: Path) -> None:
    commands = [command for command in COMMANDS[page] if not is_listed(command)]
    if not commands:
        return
    if copy_finished_run(tmp_path) is None:
        pytest.skip(f"{VARIABLE} names no finished run; `make api-test` does")
    write_files(tmp_path)
    for command in map(replace_words, commands):
        done = aomgen(*shlex.split(command)[1:], folder=tmp_path)
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
