"""Time and memory of the bookkeeping of a run with many episodes: status, continuation, completion, datasets in shards.

The files of the episodes are hard links to those of one small episode: 100,000 folders take 400 MB. Every step is a separate process,
whose time and largest memory include the start of Python.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

REPOSITORY: Final = Path(__file__).parents[1]
EPISODES_FOLDER: Final = "08_episodes"
ASSETS: Final = 10
# One sample in this many is rejected.
REJECTED: Final = 11
# Number of hard links to one file; ext4 allows 65,000.
LINKS: Final = 10_000
SHARDS: Final = 4


def run_scale(folder: Path, units: int, notify: Callable[[str], None]) -> list[dict[str, Any]]:
    """Measure each step for a tenth of the units, and for all of them.

    The run whose episodes are exported has a hundredth of the units, because the other steps read no arrays.

    Args:
        folder: Folder of the runs; it must not exist, and it is deleted afterwards.
        units: Number of committed episodes, at least 1000.
        notify: Receives the row of each step.

    Returns:
        Step, number of units, wall clock and processor time, [s], and largest memory, [MB].
    """
    rows: list[dict[str, Any]] = []

    def measure(step: str, count: int, *arguments: object) -> None:
        rows.append({"step": step, "units": count, **_measure([str(item) for item in arguments])})
        notify(str(rows[-1]))

    folder.mkdir(parents=True)
    try:
        for count in (units // 10, units):
            run = folder / str(count)
            measure("make the folders", count, *_call("make_run", run, count, ""))
            measure("status of an unfinished run", count, *_command("status", run))
            measure("resume scan", count, *_call("find_missing", run, count))
            measure("complete the ledger", count, *_call("complete", run, count))
            measure("status of a finished run", count, *_command("status", run))
        for count in (units // 1000, units // 100):
            run, shard = folder / f"exported-{count}", (*_FORMAT, "--shard", f"1/{SHARDS}")
            measure("make episodes", count, *_call("make_run", run, count, "all files"))
            for step in (f"export shard 1/{SHARDS}", f"export shard 1/{SHARDS} again"):
                measure(step, count, *_command("export", run, folder / f"dataset-{count}", *shard))
    finally:
        shutil.rmtree(folder)
    return rows


_FORMAT: Final = ("--format", "lerobot-v3", "--media", "none")


def _command(*words: object) -> tuple[object, ...]:
    return ("-c", "from aomgen.cli.app import main; main()", *words)


def _call(function: str, *arguments: object) -> tuple[object, ...]:
    return ("-c", f"import sys; from benchmarks.scale import {function} as f; f(*sys.argv[1:])", *arguments)


def _measure(arguments: list[str]) -> dict[str, float]:
    """Run Python with arguments, and measure the process."""
    started = time.monotonic()
    process = subprocess.Popen([sys.executable, *arguments], cwd=REPOSITORY, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise subprocess.CalledProcessError(status, arguments)
    return {
        "wall_s": time.monotonic() - started,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1024,
    }


def make_run(folder: str, count: str, files: str) -> None:
    """Make a run with committed and rejected units, as it is when its process is killed.

    Args:
        folder: Folder of the run.
        count: Number of committed episodes.
        files: Empty for folders that contain episode.json alone, or else with all files of an episode.
    """
    sys.path.insert(0, str(REPOSITORY / "tests" / "helpers"))
    from aomgen.core.plan import Rejection
    from aomgen.core.project import Project
    from aomgen.episodes.ledger import Unit, rejection_file, write_rejection, write_request
    from aomgen.io.episode_folder import EPISODE_FILE, episode_folder
    from aomgen.pipeline.project_file import write_project
    from aomgen.pipeline.stages import PROJECT_FILE
    from small_episodes import commit

    out, first = Path(folder).resolve(), Unit(asset=0, index=0)
    episodes, each = out / EPISODES_FOLDER, int(count) // ASSETS
    (episodes / "rejected").mkdir(parents=True)
    made, linked = 0, list[str]()
    for asset in range(ASSETS):
        index = committed = 0
        while committed < each:
            unit, source = Unit(asset=asset, index=index), out / "sources" / str(made // LINKS)
            if made % LINKS == 0:
                commit(source, 0, 100)
                write_rejection(source, first, _variation(unit), Rejection(reason="collision"))
                linked = sorted(os.listdir(source / "000000")) if files else [EPISODE_FILE]
            made, index = made + 1, index + 1
            if index % REJECTED == 0:
                os.link(rejection_file(source, first), rejection_file(episodes, unit))
                continue
            committed += 1
            home = episode_folder(episodes, unit.number)
            home.mkdir()
            for name in linked:
                os.link(f"{source}/000000/{name}", f"{home}/{name}")
    shutil.rmtree(out / "sources")
    names = tuple(f"microwave:{number}" for number in range(ASSETS))
    write_project(out / PROJECT_FILE, Project(capture=out, out=out, assets=names, poses=each))
    write_request(episodes, _request(each))


def find_missing(folder: str, count: str) -> None:
    """Continue a run that lacks one episode of each asset until the first missing unit is submitted."""
    if not _generate(folder, int(count) // ASSETS + 1):
        raise RuntimeError("no unit is missing")


def complete(folder: str, count: str) -> None:
    """Close the ledger of a run, and write the manifest of its episodes."""
    from aomgen.episodes.ledger import ACCOUNTS, read_accounts
    from aomgen.pipeline.manifest import write_manifest

    _generate(folder, int(count) // ASSETS)
    home = Path(folder) / EPISODES_FOLDER
    figures = {ACCOUNTS: [asdict(account) for account in read_accounts(home)]}
    write_manifest(home, "episodes", (0, {}, {}), figures)


class _Submitted(Exception):
    """The first missing unit has been found."""


class _NoWorkers:
    slots = 2

    def submit(self, unit: Any) -> None:
        raise _Submitted


def _generate(folder: str, episodes: int) -> bool:
    """Request episodes of each asset, and return whether a unit is missing; no unit is executed."""
    from aomgen.core.progress import silent
    from aomgen.episodes.generate import generate

    def screen(unit: Any) -> Any:
        return _variation(unit), None

    executor: Any = _NoWorkers()
    try:
        generate(Path(folder) / EPISODES_FOLDER, _request(episodes), executor, screen, silent)
    except _Submitted:
        return True
    return False


def _request(episodes: int) -> Any:
    from aomgen.episodes.ledger import Request

    names = tuple(f"microwave-{number}" for number in range(ASSETS))
    return Request(assets=names, episodes=episodes, attempts=5 * episodes)


def _variation(unit: Any) -> Any:
    """Compute a variation of the size that a run with six joints and two cameras has."""
    from aomgen.episodes.variations import Ranges, draw

    return draw(0, unit.asset, unit.index, Ranges(), slides=[False] * 6, cameras=2, free=0)
