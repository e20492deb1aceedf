"""Stages, progress and remaining time: bars on a terminal, plain lines when there is none."""

import threading
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from aomgen.pipeline.figures import read_figures
from aomgen.pipeline.runner import Stage
from aomgen.pipeline.stages import STAGES

# Often enough to see that it works, seldom enough to keep a log short, [s].
EVERY_S = 12.0
COLORS = {"good": "green", "poor": "yellow", "": ""}


class Pace:
    """The remaining time of a run, from the stages' weights and the seconds of those that are finished.

    The running stage says how far it is, but not evenly: its seconds do not count before it is finished.
    """

    def __init__(self) -> None:
        self._total = sum(stage.weight for stage in STAGES)
        self._done = 0.0
        self._spent = 0.0
        self._spent_weight = 0.0
        self._weight = 0.0

    def keep(self, stage: Stage) -> None:
        """A stage needs no time."""
        self._done += stage.weight

    def begin(self, stage: Stage) -> None:
        """A stage starts."""
        self._weight = stage.weight

    def end(self, stage: Stage, seconds: float) -> None:
        """The stage took so long."""
        self._done += stage.weight
        self._spent += seconds
        self._spent_weight += stage.weight

    def remaining(self, share: float) -> str:
        """In words, when the running stage is this far."""
        pace = self._spent / self._spent_weight if self._spent_weight else 1.0
        left = pace * max(0.0, self._total - self._done - share * self._weight)
        return f"about {left / 60:.0f} min left" if left >= 90 else f"about {left:.0f} s left"


class TerminalDisplay:
    """One line a stage, and a bar for the one that runs."""

    def __init__(self) -> None:
        self._console = Console(highlight=False)
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(24),
            TextColumn("{task.percentage:3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[note]}"),
            console=self._console,
            transient=True,
        )
        self._task: TaskID | None = None
        self._pace = Pace()

    def __enter__(self) -> "TerminalDisplay":
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        """A stage starts, or is kept when it is fresh."""
        if fresh:
            self._pace.keep(stage)
            self._console.print(f"  kept   {stage.title}")
            return
        self._pace.begin(stage)
        self._task = self._bars.add_task(f"  {stage.title}", total=1.0, note="")

    def progress(self, share: float, text: str) -> None:
        """The running stage is this far."""
        if self._task is not None:
            self._bars.update(self._task, completed=share, note=f"{text}  {self._pace.remaining(share)}")

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None:
        """A stage has been committed."""
        if self._task is not None:
            self._bars.remove_task(self._task)
        self._pace.end(stage, seconds)
        self._console.print(finished_line(stage, seconds, figures), soft_wrap=True)

    def warn(self, stage: Stage, sentence: str) -> None:
        """A finished stage has something to say about its input."""
        self._console.print(Text(f"         warning: {sentence}"), soft_wrap=True)


class PlainDisplay:
    """Lines for a log: what starts, every few seconds how far it is, and what came out."""

    def __init__(self, every_s: float = EVERY_S) -> None:
        self._every_s = every_s
        self._pace = Pace()
        self._title, self._share, self._note = "", 0.0, ""
        self._over = threading.Event()
        self._ticking = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> "PlainDisplay":
        self._ticking.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._ticking.join()

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        """A stage starts, or is kept when it is fresh."""
        if fresh:
            self._pace.keep(stage)
            print(f"  kept   {stage.title}", flush=True)
            return
        self._pace.begin(stage)
        self._title, self._share, self._note = stage.title, 0.0, ""
        print(f"  ...    {stage.title}", flush=True)

    def progress(self, share: float, text: str) -> None:
        """The running stage is this far."""
        self._share, self._note = share, text

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None:
        """A stage has been committed."""
        self._title = ""
        self._pace.end(stage, seconds)
        print(finished_line(stage, seconds, figures).plain, flush=True)

    def warn(self, stage: Stage, sentence: str) -> None:
        """A finished stage has something to say about its input."""
        print(f"         warning: {sentence}", flush=True)

    def _tick(self) -> None:
        """A line every few seconds, also while a stage says nothing."""
        while not self._over.wait(self._every_s):
            if self._title:
                words = [f"{self._title} {100 * self._share:.0f} %", self._note]
                left = self._pace.remaining(self._share)
                print(f"  ...    {', '.join([*filter(None, words), left])}", flush=True)


def display() -> TerminalDisplay | PlainDisplay:
    """The display for where standard output goes."""
    return TerminalDisplay() if Console().is_terminal else PlainDisplay()


def finished_line(stage: Stage, seconds: float, figures: dict[str, Any]) -> Text:
    """Seconds, title and figures of a finished stage, colored where there is a limit."""
    line = Text(f"  {seconds:5.1f}s {stage.title}")
    for number, reading in enumerate(read_figures(stage.name, figures)):
        line.append("; " if number else ": ")
        line.append(reading.sentence, style=COLORS[reading.verdict])
    return line
