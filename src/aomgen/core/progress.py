"""Progress reports of long computations."""

from collections.abc import Callable

# Callback that receives the completed share (0..1) and a short text; it must return quickly.
Progress = Callable[[float, str], None]


def silent(share: float, text: str) -> None:
    """Do nothing; this is the default callback."""


def part(progress: Progress, start: float, end: float) -> Progress:
    """Make a callback for one part of a computation, which covers the shares start..end of the whole computation."""
    return lambda share, text: progress(start + (end - start) * share, text)
