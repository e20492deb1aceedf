"""`python -m benchmarks generate`: verified and exported demonstrations per minute on this machine."""

import os
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from aomgen.core.progress import Progress
from aomgen.core.project import Project
from aomgen.datasets.stage import run as export
from aomgen.episodes.stage import run as generate
from aomgen.executors import Done
from aomgen.io.atomic import remove_folder
from aomgen.io.episode_folder import list_committed, read_episode
from aomgen.io.video import decode_frames
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import STAGES
from aomgen.results import Results

# The workload: two generated assets in the bundled recording, images as the paper's policies take them, [px].
ASSETS: Final = ("microwave:1", "microwave:2")
IMAGE_SIZE: Final = (256, 256)
# Interval at which memory is measured, [s].
WATCH_S: Final = 0.1
# Memory is reported at this number of episodes, and at the end.
EARLY_EPISODES: Final = 10


class MemoryWatch:
    """Largest resident memory of this process and its children together, [MB]."""

    def __init__(self) -> None:
        self.peak_mb = 0.0
        self._over = threading.Event()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Measure the memory while the block runs."""
        thread = threading.Thread(target=self._watch)
        thread.start()
        try:
            yield
        finally:
            self._over.set()
            thread.join()

    def _watch(self) -> None:
        while not self._over.wait(WATCH_S):
            self.peak_mb = max(self.peak_mb, _resident_mb())


def run_generate(
    out: Path,
    capture: Path,
    episodes: int,
    run_project: Callable[..., None],
    progress: Progress,
    **machine: Any,
) -> dict[str, Any]:
    """Make episodes of both assets and their dataset from a twin on disk, rejected attempts included.

    Args:
        out: Run folder; the run up to its fitted assets is kept and not timed.
        capture: The recording.
        episodes: Number of committed episodes at the end, over both assets.
        run_project: Runs a project until a stage.
        progress: Receives the progress of the episodes.
        machine: See `results_of`.
    """
    project = Project(
        capture=capture, out=out, assets=ASSETS, poses=-(-episodes // len(ASSETS)), image_size=IMAGE_SIZE
    )
    run_project(project, until="replacement")
    folders = results_of(project, STAGES).folders
    # The benchmark uses a separate folder, in which nothing has been made.
    scratch = {name: out / "bench" / folders[name].name for name in ("episodes", "dataset")}
    for folder in scratch.values():
        if folder.exists():
            remove_folder(folder)
    results = Results(project=project, out=out, folders={**folders, **scratch}, **machine)
    load, watch, early = os.getloadavg()[0], MemoryWatch(), list[float]()
    core: defaultdict[str, float] = defaultdict(float)

    def heard(done: Done) -> None:
        if not done.lost:
            for part, spent in done.value[1].items():
                core[part] += spent
        if not early and len(list_committed(scratch["episodes"])) >= EARLY_EPISODES:
            early.append(watch.peak_mb)

    begin = time.monotonic()
    with watch.watching():
        scratch["episodes"].mkdir(parents=True)
        made = generate(results, scratch["episodes"], progress, heard)
        spent = time.process_time()
        export(replace(results), scratch["dataset"], progress)
        core["export"] = time.process_time() - spent
    seconds = time.monotonic() - begin
    committed = [read_episode(folder) for folder in list_committed(scratch["episodes"])]
    decoded = sum(sum(1 for _ in decode_frames(path)) for item in committed for path in item.videos.values())
    total = sum(core.values())
    return {
        "episodes": len(committed),
        "workers": results.workers,
        "seconds": seconds,
        "demonstrations_per_minute": 60 * len(committed) / seconds,
        "frames_per_second": decoded / seconds,
        "frames_an_episode": sum(len(item.episode) for item in committed) / len(committed),
        "core_seconds": {part: spent / len(committed) for part, spent in sorted(core.items())},
        "share": {part: spent / total for part, spent in sorted(core.items())},
        "attempts": made["episodes"] + made["rejected"],
        "rejected": made["rejected"],
        "skipped": made["skipped"],
        "settings": min(len(item.episode.verdict["dynamic"]) for item in committed),
        "frames_decoded": decoded,
        "load_before": load,
        "peak_memory_mb": {
            f"at_{EARLY_EPISODES}": early[0] if early else watch.peak_mb,
            "at_end": watch.peak_mb,
        },
    }


def _resident_mb() -> float:
    """Measure the resident memory of this process and its descendants, [MB]."""
    total, waiting = 0, [os.getpid()]
    while waiting:
        process = Path(f"/proc/{waiting.pop()}")
        try:
            total += int((process / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            for task in (process / "task").iterdir():
                waiting += [int(child) for child in (task / "children").read_text().split()]
        except (FileNotFoundError, ProcessLookupError):  # it has ended
            continue
    return total / 1e6
