"""State of a run after a fault, and comparison of the continued run with an undisturbed one, byte by byte."""

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from aomgen.episodes.grasp_choice import GRASPS_FOLDER
from aomgen.episodes.ledger import OBJECTS_FOLDER, REJECTED_FOLDER
from aomgen.io.atomic import STAGING_PREFIX
from aomgen.pipeline.runner import TIMINGS
from fault_run import in_child, make_here, open_here, told_file
from toy_run import FOLDERS

BEFORE, AFTER = "before", "after"
# Files that are no results: the durations and the lock.
NO_RESULTS: Final = (TIMINGS, ".lock")
# Files of a run by name.
Tree = dict[str, bytes]


@dataclass(frozen=True, slots=True, kw_only=True)
class Left:
    """State of a run after a fault.

    Attributes:
        code: Exit code of the disturbed run.
        lost: Number of requested results that are missing or were made again; also a missing dataset.
        partial: Number of episodes, rejections, files and datasets that are equal neither to the old nor to the new ones.
        equal: Whether the continued run has the same bytes as the undisturbed run.
    """

    code: int
    lost: int
    partial: int
    equal: bool


def begin_over(scratch: Path, out: Path) -> None:
    """Copy a finished run of other inputs: all episodes will be made again, and the dataset replaced."""
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(scratch / BEFORE, out)
    told_file(out).write_text("")


def look(scratch: Path, out: Path, code: int) -> Left:
    """Compare a run after a fault, let it continue, compare again, and delete it."""
    whole, now = read_tree(scratch / AFTER), read_tree(out)
    known = _items(whole), _items(read_tree(scratch / BEFORE))
    found = _items(now)
    partial_items = [name for name in found if found[name] not in (known[0].get(name), known[1].get(name))]
    told = [_names_of(int(line)) for line in told_file(out).read_text().split()]
    lost = sum(not names & found.keys() for names in told) + (FOLDERS["dataset"] not in found)
    kept = [out / name for name in now if any(_item_of(name) in names for names in told)]
    times = [path.stat().st_mtime_ns for path in kept]
    open_here(scratch)
    continued = in_child(partial(make_here, out, AFTER, 0))
    end = read_tree(out, staging=True)
    again = sum(
        not path.exists() or path.stat().st_mtime_ns != time for path, time in zip(kept, times, strict=True)
    )
    shutil.rmtree(out)
    return Left(
        code=code, lost=lost + again, partial=len(partial_items), equal=continued == 0 and end == whole
    )


def summary(left: Iterable[Left]) -> dict[str, int]:
    """Summarize many faults as figures."""
    rows = list(left)
    return {
        "lost": sum(row.lost for row in rows),
        "partial": sum(row.partial for row in rows),
        "trees_equal": sum(row.equal for row in rows),
    }


def read_tree(out: Path, *, staging: bool = False) -> Tree:
    """Read all files of a run's results; with `staging` also incomplete ones."""
    names = [path.relative_to(out) for path in out.rglob("*") if path.is_file()]
    return {
        name.as_posix(): (out / name).read_bytes()
        for name in names
        if name.name not in NO_RESULTS
        and (staging or not any(part.startswith(STAGING_PREFIX) for part in name.parts))
    }


def _items(tree: Tree) -> dict[str, Tree]:
    """List results that are committed in one step: a dataset, an episode, an object, or else a file."""
    items: dict[str, Tree] = {}
    for name, data in tree.items():
        items.setdefault(_item_of(name), {})[name] = data
    return items


def _item_of(name: str) -> str:
    parts = name.split("/")
    if parts[0] == FOLDERS["dataset"]:
        return parts[0]
    return "/".join(parts[: 3 if parts[1] in (OBJECTS_FOLDER, REJECTED_FOLDER, GRASPS_FOLDER) else 2])


def _names_of(number: int) -> set[str]:
    """Return the names of the results of a finished unit; exactly one of the two exists."""
    episodes = FOLDERS["episodes"]
    return {f"{episodes}/{number:06d}", f"{episodes}/{REJECTED_FOLDER}/{number:06d}.json"}
