"""How what was delivered is spread over what was asked for, by everything that differs from episode to episode."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array, freeze_arrays
from aomgen.episodes.variations import Ranges

# Bars of a histogram: each still holds some of a few dozen episodes.
BINS: Final = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Distribution:
    """Of one quantity over the range asked for.

    Attributes:
        name, unit: For example "yaw", "deg".
        edges: Of the bins, in that unit.
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
    """Of every quantity that has a range, from a ledger's draws; the last `free` cameras were added."""
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
    """Name, unit, range and values of everything that may differ."""
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
        first = [v["start_offset"][0] for v in variations]
        yield "start of joint 1", "deg", ranges.start_deg, [degrees * value for value in first]
    cameras = len(variations[0]["orbits"]) if variations else 0
    for number in range(cameras):
        orbits = [v["orbits"][number] for v in variations]
        orbit = ranges.around if number < cameras - free else ranges.free
        yield f"camera {number} turn", "deg", orbit.turn_deg, [degrees * item["turn"] for item in orbits]
        yield f"camera {number} tilt", "deg", orbit.tilt_deg, [degrees * item["tilt"] for item in orbits]
        yield f"camera {number} distance", "", orbit.distance, [item["distance"] for item in orbits]
