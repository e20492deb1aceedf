"""The user's cache folder, which holds files that can be downloaded or computed again."""

import os
from pathlib import Path


def cache_folder(name: str) -> Path:
    """Return a folder in `$AOMGEN_CACHE`, or in `~/.cache/aomgen` if that is not set; the folder may not exist."""
    chosen = os.environ.get("AOMGEN_CACHE")
    return (Path(chosen) if chosen else Path.home() / ".cache" / "aomgen") / name
