"""Stages, progress and remaining time: bars on a terminal, plain lines when there is none."""

import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from aomgen.core.progress import silent
from aomgen.pipeline.figures import read_figures
from aomgen.pipeline.runner import Stage
from aomgen.pipeline.stages import STAGES

# Often enough to see that it works, seldom enough to keep a log short, [s].
EVERY_S = 12.0
# From this share on a stage's own pace predicts its end.
TELLING_SHARE = 0.05
COLORS = {"good": "green", "poor": "yellow", "": ""}


class _StageLines(ABC):
    """A line for each stage that is kept or finished, and the remaining time of the run.

    The remaining time is the larger of two estimates: from the duration of the finished stages and the weights of the
    others, and from the progress of the running stage. The second one is needed because many episodes take longer than
    the weight of their stage suggests.
    """

    def __init__(self, stages: Sequence[Stage]) -> None:
        self._left = sum(stage.weight for stage in stages)
        self._spent = self._spent_weight = self._weight = self._began = 0.0

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        """Show that a stage starts, or that its result is kept if it is fresh."""
        if fresh:
            self._left -= stage.weight
            self._say(Text(f"  kept   {stage.title}"))
        else:
            self._weight, self._began = stage.weight, time.monotonic()
            self._show(stage)

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None:
        """Show that a stage has been committed."""
        self._left -= stage.weight
        self._spent += seconds
        self._spent_weight += stage.weight
        self._hide()
        self._say(format_finished_line(stage, seconds, figures))

    def warn(self, stage: Stage, sentence: str) -> None:
        """Show a warning of a finished stage about its input."""
        self._say(Text(f"         warning: {sentence}"))

    def _remaining(self, share: float) -> str:
        """Describe the remaining time, given the finished share of the running stage."""
        pace = self._spent / self._spent_weight if self._spent_weight else 1.0
        left = pace * max(0.0, self._left - share * self._weight)
        if share > TELLING_SHARE:
            left = max(left, (time.monotonic() - self._began) * (1 - share) / share)
        return f"about {left / 60:.0f} min left" if left >= 90 else f"about {left:.0f} s left"

    @abstractmethod
    def _say(self, line: Text) -> None: ...

    @abstractmethod
    def _show(self, stage: Stage) -> None: ...

    @abstractmethod
    def _hide(self) -> None: ...


class TerminalDisplay(_StageLines):
    """One line a stage, and a bar for the one that runs."""

    def __init__(self, stages: Sequence[Stage] = STAGES) -> None:
        super().__init__(stages)
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

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bars.stop()

    def progress(self, share: float, text: str) -> None:
        """Show the finished share of the running stage."""
        if self._task is not None:
            self._bars.update(self._task, completed=share, note=f"{text}  {self._remaining(share)}")

    def _say(self, line: Text) -> None:
        self._console.print(line, soft_wrap=True)

    def _show(self, stage: Stage) -> None:
        self._task = self._bars.add_task(f"  {stage.title}", total=1.0, note="")

    def _hide(self) -> None:
        if self._task is not None:
            self._bars.remove_task(self._task)


class PlainDisplay(_StageLines):
    """Lines for a log: what starts, every few seconds how far it is, and what came out."""

    def __init__(self, every_s: float = EVERY_S, stages: Sequence[Stage] = STAGES) -> None:
        super().__init__(stages)
        self._every_s = every_s
        self._title, self._share, self._note = "", 0.0, ""
        self._over = threading.Event()
        self._ticking = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> Self:
        self._ticking.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._ticking.join()

    def progress(self, share: float, text: str) -> None:
        """Store the finished share of the running stage."""
        self._share, self._note = share, text

    def _say(self, line: Text) -> None:
        print(line.plain, flush=True)

    def _show(self, stage: Stage) -> None:
        self._title, self._share, self._note = stage.title, 0.0, ""
        print(f"  ...    {stage.title}", flush=True)

    def _hide(self) -> None:
        self._title = ""

    def _tick(self) -> None:
        """Print a line every few seconds, also while a stage reports no progress."""
        while not self._over.wait(self._every_s):
            if self._title:
                words = [f"{self._title} {100 * self._share:.0f} %", self._note]
                print(
                    f"  ...    {', '.join([*filter(None, words), self._remaining(self._share)])}", flush=True
                )


def display(stages: Sequence[Stage] = STAGES) -> TerminalDisplay | PlainDisplay:
    """Choose the display for the standard output."""
    return TerminalDisplay(stages) if Console().is_terminal else PlainDisplay(stages=stages)


def format_finished_line(stage: Stage, seconds: float, figures: dict[str, Any]) -> Text:
    """Format duration, title and figures of a finished stage; figures with a limit are colored."""
    line = Text(f"  {seconds:5.1f}s {stage.title}")
    for number, reading in enumerate(read_figures(stage.name, figures)):
        line.append("; " if number else ": ")
        line.append(reading.sentence, style=COLORS[reading.verdict])
    return line


class CallbackDisplay:
    """Passes the progress of stages to a function, or discards it.

    Args:
        callback: Receives the share of the running stage that is done, 0..1, and a text.
    """

    def __init__(self, callback: Callable[[float, str], None] | None = None) -> None:
        self._callback, self._title = callback or silent, ""

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        """Note which stage starts."""
        self._title = stage.title

    def progress(self, share: float, text: str) -> None:
        """Pass on how far the stage is."""
        self._callback(share, f"{self._title}: {text}" if text else self._title)

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None:
        """Report that the stage is done."""
        self._callback(1.0, stage.title)

    def warn(self, stage: Stage, sentence: str) -> None:
        """Turn a warning about the input into a Python warning."""
        warnings.warn(f"{stage.name}: {sentence}", UserWarning, stacklevel=2)
