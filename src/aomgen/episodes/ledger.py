"""Ledger of the requested episodes and their outcomes, as the files in the stage's folder.

```
request.json          requested episodes of each asset
000005/               a committed episode: asset 0, draw 5
rejected/100002.json  a rejected draw, and the reason: asset 1, draw 2
objects/000005/       the object of an episode that has another size than its asset
draws.json            when all is done: every draw with its outcome, also those that were not tried
```
At any moment, requested = committed + rejected + left. Distributions are computed from the draws.
"""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.plan import Rejection, Variation
from aomgen.core.values import Array, freeze_arrays
from aomgen.episodes.variations import Ranges
from aomgen.errors import MalformedFileError
from aomgen.io.artifact import MAX_LIST_BYTES, read_json
from aomgen.io.atomic import remove_folder, write_json
from aomgen.io.episode_folder import episode_folder, list_committed_names

REQUEST_FILE, DRAWS_FILE = "request.json", "draws.json"
REJECTED_FOLDER, OBJECTS_FOLDER = "rejected", "objects"
# Name of the accounts among the metrics of the finished stage, where they are read without the draws.
ACCOUNTS: Final = "accounts"
# Fields of `Rejection` that its file holds; the sample `worst` is found again by planning.
STATED: Final = ("reason", "detail", "metrics", "excess", "bodies")
# Largest number of draws of an asset: the number of an episode has five digits for them.
MAX_DRAWS: Final = 100_000
# Number of bars of a histogram: each still counts some of a few dozen episodes.
BINS: Final = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """One draw of one asset: the unit of work from the plan to the committed episode or the rejection."""

    asset: int
    index: int

    @property
    def number(self) -> int:
        """Number of its episode."""
        return self.asset * MAX_DRAWS + self.index


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """Requested episodes of each asset, by name and in the order of their numbers.

    Attributes:
        assets: Names of the assets.
        episodes: Number of requested episodes of each asset.
        attempts: Largest number of samples of each asset that are planned.
    """

    assets: tuple[str, ...]
    episodes: int
    attempts: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Account:
    """Outcome of the episodes requested of one asset.

    Attributes:
        asset: Its name.
        requested, committed, rejected, left: Numbers of episodes; `rejected` counts those that are missing
            because the allowed number of samples has been planned.
        attempts: Number of samples that were planned, committed or rejected.
        reasons: Number of rejected and of skipped samples by reason.
    """

    asset: str
    requested: int
    committed: int
    rejected: int
    attempts: int
    reasons: Mapping[str, int] = field(default_factory=dict)

    @property
    def left(self) -> int:
        """Number of episodes that are still to be made."""
        return self.requested - self.committed - self.rejected

    @property
    def why(self) -> str:
        """The reasons in words, the most frequent first."""
        ordered = sorted(self.reasons.items(), key=lambda item: (-item[1], item[0]))
        return ", ".join(f"{count} {reason}" for reason, count in ordered)


def write_request(folder: Path, request: Request) -> None:
    """Store the request before any episode is made.

    Raises:
        StorageError: The file cannot be written.
    """
    write_json(folder / REQUEST_FILE, asdict(request))


def write_rejection(folder: Path, unit: Unit, variation: Variation, rejection: Rejection) -> None:
    """Store why a sample was rejected.

    Raises:
        StorageError: The file cannot be written.
    """
    stated = {name: getattr(rejection, name) for name in STATED}
    content = {"variation": asdict(variation), **stated}
    write_json(rejection_file(folder, unit), content)


def rejection_file(folder: Path, unit: Unit) -> Path:
    """Return the path of the file that states why a sample was rejected."""
    return folder / REJECTED_FOLDER / f"{unit.number:06d}.json"


def object_folder(folder: Path, unit: Unit) -> Path:
    """Return the folder with the USD of an episode's object whose size differs from its asset's."""
    return folder / OBJECTS_FOLDER / f"{unit.number:06d}"


def unit_paths(folder: Path, unit: Unit) -> tuple[Path, Path, Path]:
    """Return the paths that a unit may leave, in the order in which they are committed: object, episode and rejection."""
    return object_folder(folder, unit), episode_folder(folder, unit.number), rejection_file(folder, unit)


def forget_files(folder: Path, names: Iterable[str]) -> None:
    """Delete damaged files, and all files of the units to which they belong, so that these units are made again.

    Args:
        folder: Folder of all episodes.
        names: Relative paths of the damaged files.

    Raises:
        StorageError: A file cannot be deleted.
    """
    damaged = [Path(name) for name in names]
    numbers = {part.removesuffix(".json") for name in damaged for part in name.parts[:2]}
    units = [unit_of(number) for number in numbers if number.isdigit()]
    paths = [path for unit in units for path in unit_paths(folder, unit)]
    for path in filter(Path.exists, [*paths, *(folder / name for name in damaged)]):
        remove_folder(path)


def read_rejection(folder: Path, unit: Unit) -> Rejection:
    """Read why a sample was rejected.

    Raises:
        MissingFileError, MalformedFileError: The file is missing or malformed.
    """
    path = rejection_file(folder, unit)
    content = read_json(path)
    try:
        stated = {name: content[name] for name in STATED}
        return Rejection(**{**stated, "bodies": tuple(stated["bodies"])})
    except (TypeError, KeyError) as error:
        raise MalformedFileError(
            path, f"is not a rejection ({error!r})", "delete it and run again"
        ) from error


def list_ended_units(folder: Path) -> tuple[set[Unit], set[Unit]]:
    """List units whose episode is committed, and those that were rejected."""
    committed = {unit_of(name) for name in list_committed_names(folder)}
    if not (folder / REJECTED_FOLDER).is_dir():
        return committed, set()
    stems = (name.removesuffix(".json") for name in os.listdir(folder / REJECTED_FOLDER))
    return committed, {unit_of(stem) for stem in stems if stem.isdigit()}


def unit_of(number: str | int) -> Unit:
    """Return the unit of an episode's number."""
    asset, index = divmod(int(number), MAX_DRAWS)
    return Unit(asset=asset, index=index)


def read_accounts(folder: Path) -> list[Account]:
    """Read the current outcome of the request; empty where there is none.

    Raises:
        MalformedFileError: A file was not written by this stage.
    """
    if not (folder / REQUEST_FILE).is_file():
        return []
    request = read_request(folder)
    committed, rejected = list_ended_units(folder)
    finished = (folder / DRAWS_FILE).is_file()
    made, failed = (Counter(unit.asset for unit in units) for units in (committed, rejected))
    reasons = [Counter[str]() for _ in request.assets]
    for unit in rejected:
        if unit.asset < len(reasons):
            reasons[unit.asset][read_rejection(folder, unit).reason] += 1
    for draw in read_draws(folder) if finished else ():
        if draw["outcome"] == "skipped":
            reasons[draw["asset"]][draw["reason"]] += 1
    return [
        Account(
            asset=name,
            requested=request.episodes,
            committed=made[asset],
            rejected=request.episodes - made[asset]
            if finished or made[asset] + failed[asset] >= request.attempts
            else 0,
            attempts=made[asset] + failed[asset],
            reasons=dict(reasons[asset]),
        )
        for asset, name in enumerate(request.assets)
    ]


def read_request(folder: Path) -> Request:
    """Read the request that a stage works on.

    Raises:
        MissingFileError, MalformedFileError: The file is missing or malformed.
    """
    path = folder / REQUEST_FILE
    content = read_json(path)
    try:
        return Request(
            assets=tuple(map(str, content["assets"])),
            episodes=int(content["episodes"]),
            attempts=int(content["attempts"]),
        )
    except (TypeError, KeyError, ValueError) as error:
        raise MalformedFileError(path, f"is not a request ({error!r})", "delete it and run again") from error


def write_draws(folder: Path, draws: Iterator[dict[str, Any]]) -> None:
    """Store every draw with its outcome, which completes the request.

    Raises:
        StorageError: The file cannot be written.
    """
    write_json(folder / DRAWS_FILE, {"draws": list(draws)})


def read_draws(folder: Path) -> list[dict[str, Any]]:
    """Read every draw of a finished stage: asset, number, variation, outcome and reason.

    The outcome is "committed", "rejected" or "skipped".

    Raises:
        MissingFileError, MalformedFileError: The file is missing or malformed.
    """
    content = read_json(folder / DRAWS_FILE, MAX_LIST_BYTES)
    try:
        return list(content["draws"])
    except (TypeError, KeyError) as error:
        raise MalformedFileError(folder / DRAWS_FILE, "holds no draws", "delete it and run again") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Distribution:
    """Histograms of one quantity over the requested range.

    Attributes:
        name, unit: For example "yaw", "deg".
        edges: Edges of the bins, in that unit.
        drawn, tried, delivered: Draws in each bin; those that were planned; those that became episodes.
    """

    name: str
    unit: str
    edges: Annotated[Array, "_"]
    drawn: Annotated[NDArray[np.int64], "K"]
    tried: Annotated[NDArray[np.int64], "K"]
    delivered: Annotated[NDArray[np.int64], "K"]

    __post_init__ = freeze_arrays


def distributions(draws: Sequence[Mapping[str, Any]], ranges: Ranges, free: int) -> list[Distribution]:
    """Compute histograms of every quantity with a range; the last `free` cameras were added."""
    found = []
    for name, unit, (low, high), values in _quantities([draw["variation"] for draw in draws], ranges, free):
        if low == high or not draws:
            continue
        outcomes = np.array([draw["outcome"] for draw in draws])
        edges = np.linspace(low, high, BINS + 1, dtype=np.float64)
        drawn, tried, delivered = (
            np.histogram(np.asarray(values)[chosen], edges)[0]
            for chosen in (outcomes != "", outcomes != "skipped", outcomes == "committed")
        )
        found.append(
            Distribution(name=name, unit=unit, edges=edges, drawn=drawn, tried=tried, delivered=delivered)
        )
    return found


def _quantities(
    variations: list[Mapping[str, Any]], ranges: Ranges, free: int
) -> Iterator[tuple[str, str, tuple[float, float], list[float]]]:
    """Yield name, unit, range and values of every quantity that may vary."""
    x, y = ranges.x_m, ranges.y_m
    if ranges.polygon:
        x, y = ((min(axis), max(axis)) for axis in zip(*ranges.polygon, strict=True))
    degrees = float(np.rad2deg(1.0))
    yield "x", "m", x, [v["x"] for v in variations]
    yield "y", "m", y, [v["y"] for v in variations]
    yield "yaw", "deg", ranges.yaw_deg, [degrees * v["yaw"] for v in variations]
    yield "scale", "", ranges.scale, [v["scale"] for v in variations]
    yield "speed", "", ranges.speed, [v["speed"] for v in variations]
    light, material = [v["light"] for v in variations], [v["material"] for v in variations]
    yield "light turn", "deg", ranges.light_turn_deg, [degrees * item["turn"] for item in light]
    yield "light intensity", "", ranges.light_intensity, [item["intensity"] for item in light]
    yield "color temperature", "K", ranges.light_temperature_k, [item["temperature_k"] for item in light]
    yield "hue", "deg", ranges.hue_deg, [degrees * item["hue"] for item in material]
    yield "saturation", "", ranges.saturation, [item["saturation"] for item in material]
    yield "brightness", "", ranges.brightness, [item["brightness"] for item in material]
    yield "push", "m", ranges.push_m, [v["push_m"] for v in variations]
    if variations and any(ranges.start_deg):
        offsets = degrees * np.array([v["start_offset"] for v in variations])
        # Prismatic joints have no offset.
        joint = int(np.argmax(offsets.any(0)))
        yield f"start of joint {joint + 1}", "deg", ranges.start_deg, offsets[:, joint].tolist()
    cameras = len(variations[0]["orbits"]) if variations else 0
    for number in range(cameras):
        orbits = [v["orbits"][number] for v in variations]
        orbit = ranges.around if number < cameras - free else ranges.free
        yield f"camera {number} turn", "deg", orbit.turn_deg, [degrees * item["turn"] for item in orbits]
        yield f"camera {number} tilt", "deg", orbit.tilt_deg, [degrees * item["tilt"] for item in orbits]
        yield f"camera {number} distance", "", orbit.distance, [item["distance"] for item in orbits]
