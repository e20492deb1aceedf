"""Progress reports of long computations."""

from collections.abc import Callable

# Called with the share done (0..1) and a few words; must be cheap.
Progress = Callable[[float, str], None]


def silent(share: float, text: str) -> None:
    """Default callback; does nothing."""


def part(progress: Progress, start: float, end: float) -> Progress:
    """Make a callback for one part of a computation, mapped to start..end of the whole."""
    return lambda share, text: progress(start + (end - start) * share, text)
