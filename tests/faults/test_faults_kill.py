"""kill -9 at any moment of generation loses nothing that was acknowledged, and the rest follows.

A hundred kills instead of the everyday few:
`AOMGEN_KILLS=100 pytest tests/faults/test_faults_kill.py -s`
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from aomgen.io.episode_folder import list_committed, read_episode
from aomgen.pipeline.manifest import read_manifest, verify

SCRIPT = Path(__file__).with_name("killed_run.py")
KILLS = int(os.environ.get("AOMGEN_KILLS", "6"))
STAGES = ("episodes", "dataset")
KILLS_A_STAGE = 3  # before a run may come to its end
# A quick stage is missed now and then on a busy machine; it is tried again, so often at most.
MAX_CAMPAIGNS = 40


class Server:
    """The process that forks the runs.

    Attributes:
        finished: Stages that the last run finished, with the seconds they took.
    """

    def __init__(self, process: subprocess.Popen) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self._to, self._from = process.stdin, process.stdout
        self.finished: dict[str, float] = {}

    def run(self, out: Path, digest: str, target: str = "", delay_s: float = 0.0) -> str:
        """Start a run and kill it so long after a stage has begun, at the latest when it ends.

        Returns:
            The stage it was killed in; empty if it came to its end.
        """
        self.finished.clear()
        self._to.write(f"{out} {digest}\n")
        self._to.flush()
        child, stage, began = int(self._line().removeprefix("child ")), "", 0.0
        alarm = threading.Timer(delay_s, kill, (child,))
        while not (line := self._line()).startswith("ended "):
            word, stage = line.split()
            if word == "begin":
                began = time.monotonic()
                if stage == target:
                    alarm.start()
            elif stage == target:
                alarm.cancel()
                kill(child)
            else:
                self.finished[stage] = time.monotonic() - began
        alarm.cancel()
        status = int(line.removeprefix("ended "))
        assert status in (0, -signal.SIGKILL), f"the run failed in {stage}"
        return stage if status else ""

    def _line(self) -> str:
        return self._from.readline().strip()


def kill(process: int) -> None:
    with suppress(ProcessLookupError):  # it came to its end
        os.kill(process, signal.SIGKILL)


@contextmanager
def serving() -> Iterator[Server]:
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, str(SCRIPT)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        yield Server(process)


def tree(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def acknowledged(out: Path, whole: dict[str, bytes]) -> set[str]:
    """Rejections and episodes of this run that are complete.

    Every complete one must have the bytes of the undisturbed run, and the dataset must be readable,
    whether it is the old one or the new one.
    """
    if (out / "dataset").exists():
        manifest = read_manifest(out / "dataset")
        assert manifest is not None, "the dataset is partial"
        verify(out / "dataset", manifest)
    found = {f"episodes/rejected/{path.name}" for path in (out / "episodes" / "rejected").glob("[0-9]*.json")}
    for folder in list_committed(out / "episodes"):
        read_episode(folder)
        found |= {f"episodes/{folder.name}/{path.name}" for path in folder.iterdir()}
    for name in found:
        assert (out / name).read_bytes() == whole[name], f"{name} is partial"
    started = {
        stage
        for stage in ("episodes",)
        if (file := out / stage / "started.json").is_file()
        and file.read_bytes() == whole[f"{stage}/started.json"]
    }
    return {name for name in found if name.split("/")[0] in started}


def test_killed_runs_end_in_the_same_bytes(tmp_path):
    rng = np.random.default_rng(0)
    delivered, equal = Counter(), 0
    whole: dict[str, dict[str, bytes]] = {}
    with serving() as server:
        for campaign in range(MAX_CAMPAIGNS):
            # Other inputs every second time: then all is made anew over a finished run.
            digest, out = f"capture-{campaign % 2}", tmp_path / "broken"
            if digest not in whole:
                assert server.run(tmp_path / digest, digest) == ""
                seconds, whole[digest] = dict(server.finished), tree(tmp_path / digest)
            had_dataset, known = (out / "dataset").exists(), set[str]()
            for target in [stage for stage in STAGES for _ in range(KILLS_A_STAGE)]:
                if delivered.total() < KILLS or not delivered[target]:
                    delay_s = float(rng.uniform(0, seconds[target]))
                    delivered[server.run(out, digest, target, delay_s)] += 1
                    now = acknowledged(out, whole[digest])
                    assert known <= now, "something acknowledged is gone"
                    assert (out / "dataset").exists() or not had_dataset, "the old dataset is gone"
                    known = now
            assert server.run(out, digest) == ""
            for stage in STAGES:
                assert tree(out / stage) == tree(tmp_path / digest / stage)
            equal += 1
            del delivered[""]  # of runs that were faster
            if delivered.total() >= KILLS and all(delivered[stage] for stage in STAGES):
                break
    counts = {stage: delivered[stage] for stage in STAGES}
    print(
        f"\n{delivered.total()} kills {counts}, nothing lost, nothing partial, {equal} of {equal} runs equal"
    )
    assert all(counts.values()), "a stage was never killed, so it was not tested"
