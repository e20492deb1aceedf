"""Every command in a shell block of the documentation is run on a finished run, or is listed with the reason why not."""

import re
import shlex
from pathlib import Path

import pytest

from aomgen.errors import AssetError
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

INSTALLED = "installs AOMGen, which .ci/run does before the tests"
PACKAGED = "`make package-test` installs the wheel in a new environment"
PART = "runs a part of `make test`"
SERVES = "serves pages until Ctrl+C; tests/unit/viewing and tests/unit/prompting test the pages"
RECORDED = "needs a robot or its recording; tests/unit/importers imports every format"
TRAINED = "belongs to a training; `make datasets-test` runs these commands in a LeRobot environment"
SERVED = "needs a GPU with another program; tests/unit/recipes checks the flags"
EPISODES = "replaces the episodes, which takes a minute; .ci/run calls examples/04_set_a_parameter.py"
CLUSTER = "needs a Ray cluster; tests/unit/test_executors.py starts one"
SANITIZED = "replaces the engine of the installation; `make sanitize` runs the tests of its C interface"
# Beginning of a command: reason why it is not run.
NOT_RUN = {
    "apt-get install": INSTALLED,
    "make install": INSTALLED,
    "make develop": INSTALLED,
    "python3 -m venv": PACKAGED,
    "pip install": PACKAGED,
    "make demo": "takes minutes; .ci/run calls it before, and these tests use its run",
    "aomgen demo out": "takes minutes; `make demo` calls it",
    "make quick": PART,
    ".venv/bin/python -m pytest": PART,
    "make format check": "changes the checkout; .ci/run calls `make check`",
    "git": "changes the checkout",
    "aomgen --install-completion": "changes the settings of the shell",
    "aomgen check my_capture": "takes ten seconds; tests/unit/cli/test_preflight.py",
    "aomgen prompts": SERVES,
    "aomgen view out": SERVES,
    "aomgen view my_capture": SERVES,
    "aomgen run project.toml --set": EPISODES,
    "aomgen run out --set": EPISODES,
    "aomgen run project.toml --ray": CLUSTER,
    "ray start": CLUSTER,
    "aomgen corpus": "takes minutes for each capture; tests/unit/api/test_corpus.py",
    "aomgen splat": "takes minutes; tests/unit/pipeline/test_splat.py calls it with few small photos",
    "aomgen export OUT": "docs/datasets.md contains the same command with other names of folders",
    "aomgen export out demonstration.rrd": "needs the extra rerun; tests/unit/exports/test_recordings.py",
    "python -m mujoco.viewer": "opens a window; tests/unit/api/test_run_exports.py loads the file",
    "aomgen import demo open": RECORDED,
    "python record.py": RECORDED,
    "ffmpeg": RECORDED,
    "ros2": RECORDED,
    "lerobot-record": RECORDED,
    ". .venv-policy/bin/activate": TRAINED,
    "aomgen export out dataset": TRAINED,
    "aomgen export out images": TRAINED,
    "aomgen export out others": TRAINED,
    "aomgen export out demonstrations": TRAINED,
    "aomgen export out handles": TRAINED,
    "aomgen evaluate suite out suite.json --trials 200 --size": TRAINED,
    "aomgen evaluate suite out poses.json --actions": TRAINED,
    "export ACCELERATE_MIXED_PRECISION": TRAINED,
    "lerobot-train": TRAINED,
    "lerobot-eval": TRAINED,
    "python -m lerobot_policy_aomgen.train_finder": TRAINED,
    "python -m lerobot_policy_aomgen.create_handle_plan": TRAINED,
    "aomgen evaluate poses.json --policy lerobot:": TRAINED,
    "aomgen evaluate joint_suite.json --policy lerobot:": TRAINED,
    "aomgen evaluate suite.json --policy lerobot:": TRAINED,
    "aomgen evaluate --real": "needs trials on a real robot; tests/unit/evaluation/test_real_trials.py",
    ".venv-policy/bin/python -m benchmarks policy": "takes hours; .ci/run calls it with --quick",
    "cp build/sanitize": SANITIZED,
    "LD_PRELOAD": SANITIZED,
    "HF_LEROBOT_HOME": SERVED,
    "uv run": SERVED,
    "sh RECIPES": SERVED,
    "python vla-scripts": SERVED,
    "aomgen evaluate suite.json --policy openpi:": SERVED,
    "aomgen evaluate suite.json --policy openvla:": SERVED,
}
# Commands that begin like a listed one and are run.
RUN = ("aomgen view out --export",)
# Part of a command: text that is run in its place, for placeholders, large numbers and names that do not exist.
REPLACED = {
    "import scan PHOTOS my_capture": "import scan photos imported",
    "import demo RECORDING my_capture": "import demo out/dataset imported",
    "import scan SOURCE my_capture": "import scan photos imported",
    "import demo SOURCE CAPTURE --episode N": "import demo out/dataset imported --episode 1",
    "init my_capture": "init my_capture --project written.toml",
    "--trials 200": "--trials 2",
    "--n 500": "--n 2",
    "--episode 3": "--episode {episode}",
    "fridge.urdf": "fridge.xml",
    "cabinet.urdf": "cabinet.xml",
    "drawer.usda --for": "microwave:1 --for",
    "panda.xml": "arm.urdf",
    "--workers N": "--workers 1",
    "--json F": "--json figures.json",
}

# Exit codes other than 0: `aomgen assets check` lists the joints of a file and refuses it until one is chosen.
CODES = {"aomgen assets check cabinet.urdf --for out": AssetError.exit_code}


def find_commands(page: str) -> list[str]:
    """List the commands of a page's shell blocks in order, without comments."""
    text = (REPOSITORY / page).read_text("utf-8")
    blocks = [block for _, language, block in FENCE.findall(text) if language == "bash"]
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [command for line in lines if (command := re.sub(r"(^|\s)#.*", "", line).strip())]


COMMANDS = {page: commands for page in PAGES if (commands := find_commands(page))}


def is_listed(command: str) -> bool:
    return command.startswith(tuple(NOT_RUN)) and not command.startswith(RUN)


def choose_commands() -> dict[str, list[str]]:
    """Choose the commands that are run, by page; a command of several pages is run on the first one."""
    first = {command: page for page in reversed(COMMANDS) for command in COMMANDS[page]}
    chosen = {
        page: [c for c in dict.fromkeys(commands) if first[c] == page and not is_listed(c)]
        for page, commands in COMMANDS.items()
    }
    return {page: commands for page, commands in chosen.items() if commands}


def replace_words(command: str, episode: int) -> str:
    """Apply `REPLACED`, and include optional arguments, which are in brackets."""
    for written, run in REPLACED.items():
        command = command.replace(written, run.format(episode=episode))
    return re.sub(r"\[(--[^]]*)\]", r"\1", command)


def test_every_block_names_its_language() -> None:
    bare = [
        f"{page}: {block.splitlines()[0]}"
        for page in PAGES
        for _, language, block in FENCE.findall((REPOSITORY / page).read_text("utf-8"))
        if not language
    ]
    assert bare == [], "write ```bash for commands that a reader runs, and ```text for listings"


def test_every_command_is_run_or_listed() -> None:
    neither = [c for commands in choose_commands().values() for c in commands if not c.startswith("aomgen ")]
    assert neither == [], "add these commands to NOT_RUN with a reason"


def test_every_entry_is_used() -> None:
    commands = [command for page in COMMANDS.values() for command in page]
    assert [entry for entry in NOT_RUN if not any(c.startswith(entry) for c in commands)] == []
    assert CODES.keys() <= set(commands)
    assert [entry for entry in REPLACED if not any(entry in c and not is_listed(c) for c in commands)] == []


@pytest.mark.parametrize("page", choose_commands())
def test_commands_of_a_page_succeed(page: str, tmp_path: Path) -> None:
    out = copy_finished_run(tmp_path)
    if out is None:
        pytest.skip(f"{VARIABLE} names no finished run; `make api-test` does")
    write_files(tmp_path)
    episode = min(int(path.name) for path in (out / "08_episodes").iterdir() if path.name.isdecimal())
    for written in choose_commands()[page]:
        command = replace_words(written, episode)
        done = aomgen(*shlex.split(command)[1:], folder=tmp_path)
        assert done.returncode == CODES.get(written, 0), f"{command}\n{done.stdout}{done.stderr}"
