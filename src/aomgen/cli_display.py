"""Stages, progress bars and remaining time on a terminal; plain lines when it is not one."""

import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from aomgen.pipeline.stage import Stage
from aomgen.pipeline.stages import STAGES


class TerminalDisplay:
    """Shows one line a stage, and the remaining time from the stages' weights."""

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
        self._total = sum(stage.weight for stage in STAGES)
        self._done = 0.0
        self._spent = 0.0
        self._spent_weight = 0.0
        self._weight = 0.0
        self._started = 0.0

    def __enter__(self) -> "TerminalDisplay":
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        """A stage starts, or is kept when it is fresh."""
        if fresh:
            self._done += stage.weight
            self._console.print(f"  kept   {stage.title}")
            return
        self._weight = stage.weight
        self._started = time.monotonic()
        self._task = self._bars.add_task(f"  {stage.title}", total=1.0, note="")
        if not self._console.is_terminal:
            self._console.print(f"  ...    {stage.title}")

    def progress(self, share: float, text: str) -> None:
        """The running stage is this far."""
        if self._task is not None:
            note = f"{text}  {self._remaining(share)}"
            self._bars.update(self._task, completed=share, note=note)

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None:
        """A stage has been committed."""
        if self._task is not None:
            self._bars.remove_task(self._task)
        self._done += stage.weight
        self._spent += seconds
        self._spent_weight += stage.weight
        shown = ", ".join(f"{name} {_short(value)}" for name, value in figures.items() if _is_short(value))
        self._console.print(
            f"  {seconds:5.1f}s {stage.title}" + (f": {shown}" if shown else ""), soft_wrap=True
        )

    def warn(self, stage: Stage, sentence: str) -> None:
        """A finished stage has something to say about its input."""
        self._console.print(f"         warning: {sentence}", soft_wrap=True)

    def _remaining(self, share: float) -> str:
        spent = self._spent + time.monotonic() - self._started
        weight = self._spent_weight + share * self._weight
        if weight < 0.02 * self._total:
            pace = 1.0
        else:
            pace = spent / weight
        left = pace * max(0.0, self._total - self._done - share * self._weight)
        return f"about {left / 60:.0f} min left" if left >= 90 else f"about {left:.0f} s left"


def _is_short(value: Any) -> bool:
    return isinstance(value, (int, float, str, bool)) and len(str(value)) < 40


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
