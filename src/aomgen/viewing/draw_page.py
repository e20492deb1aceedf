"""Data of the page of one episode or rejected sample: motion of robot and object, and all limits."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.episode import FINGERS, PHASES, Episode
from aomgen.core.values import Array
from aomgen.datasets.features import finger_forces
from aomgen.io.episode_folder import read_episode
from aomgen.report.episodes import place_words, reasons
from aomgen.viewing.draw_list import Draw
from aomgen.viewing.limit_readings import read_limits, read_rejected

# Number of digits of plotted values, finer than the resolution of a plot.
DIGITS: Final = 4


def describe_episode(folder: Path, slides: Collection[int]) -> dict[str, Any]:
    """Collect the data of an episode's page: cameras, series over the frames, and limits.

    Args:
        folder: Folder of the episode.
        slides: Indices of the prismatic arm joints.

    Returns:
        `series` is a list of plots, each with a title, a unit, and lines of T values; `phases` is a list of names with
        first and last frame; for `limits` see `LimitReading`.

    Raises:
        CorruptArtifactError, MalformedFileError: A file of the episode is missing or damaged.
    """
    committed = read_episode(folder)
    episode, verdict = committed.episode, committed.episode.verdict
    return {
        "instruction": episode.instruction,
        "asset": episode.asset,
        "fps": episode.fps,
        "frames": len(episode),
        "cameras": [
            {"name": name, "width": camera.width, "height": camera.height}
            for name, camera in episode.cameras.items()
        ],
        "place": place_words(verdict["variation"]),
        "variation": describe_variation(verdict["variation"], slides),
        "grasp": verdict.get("grasp", ""),
        "phases": list_phases(episode.phases),
        "series": list_series(episode, slides),
        "limits": [asdict(item) for item in read_limits(verdict)],
        "settings": [run["name"] for run in verdict["dynamic"]],
        "mb": sum(path.stat().st_size for path in committed.videos.values()) / 1e6,
    }


def describe_rejected(draw: Draw, slides: Collection[int]) -> dict[str, Any]:
    """Collect the data of the page of a sample without an episode, or of a damaged episode; see `describe_episode`."""
    return {
        "asset": draw.asset,
        "meaning": reasons().get(draw.reason, ""),
        "pair": " and ".join(draw.bodies),
        "place": place_words(draw.variation) if draw.variation else "",
        "variation": describe_variation(draw.variation, slides),
        "figures": read_rejected(draw.metrics),
    }


def list_phases(phases: NDArray[np.int64]) -> list[dict[str, Any]]:
    """List the runs of equal phases (T,): name, first and last frame."""
    starts = np.flatnonzero(np.diff(phases, prepend=-1))
    ends = [*(starts[1:] - 1).tolist(), len(phases) - 1]
    return [
        {"name": PHASES[phases[first]], "first": first, "last": last}
        for first, last in zip(starts.tolist(), ends, strict=True)
    ]


def list_series(episode: Episode, slides: Collection[int]) -> list[dict[str, Any]]:
    """List the plots of an episode: joint value of the object, finger forces, gripper, arm joints, tracking error.

    The prismatic arm joints, whose indices are `slides`, have a separate plot.
    """
    turning = episode.joint.type == "revolute"
    verdict, factor = episode.verdict, (np.degrees(1.0) if turning else 1000.0)
    goal = [(factor * verdict[name], name.removesuffix("_theta")) for name in ("start_theta", "target_theta")]
    errors = 1000 * np.linalg.norm(
        episode.Ts_world_ee_action[:-1, :3, 3] - episode.Ts_world_ee[1:, :3, 3], axis=1
    )
    return [
        _plot("object joint", "deg" if turning else "mm", {"reached": factor * episode.thetas}, goal),
        _plot("finger force", "N", dict(zip(FINGERS, finger_forces(episode).T, strict=True))),
        _plot(
            "gripper", "0 open, 1 closed", {"reached": episode.gripper, "commanded": episode.action_gripper}
        ),
        *_plot_arm(episode, slides),
        _plot("end effector off its command", "mm", {"distance": np.append(0.0, errors)}),
    ]


def describe_variation(variation: Mapping[str, Any], slides: Collection[int]) -> dict[str, str]:
    """Describe the nonzero differences of a sample from the recording in words, by their names.

    `slides` are the indices of the prismatic arm joints.
    """
    if not variation:
        return {}
    light, material = variation["light"], variation["material"]
    found = {
        "size": _factor(variation["scale"]),
        "speed": _factor(variation["speed"]),
        "light turned": _degrees(light["turn"]),
        "light intensity": _factor(light["intensity"]),
        "light temperature": "" if light["temperature_k"] == 6500 else f"{light['temperature_k']:.0f} K",
        "hue": _degrees(material["hue"]),
        "saturation": _factor(material["saturation"]),
        "brightness": _factor(material["brightness"]),
        "push": f"{1000 * variation['push_m']:.0f} mm" if variation["push_m"] else "",
        "start": ", ".join(
            f"{1000 * value:+.0f} mm" if joint in slides else f"{np.degrees(value):+.0f} deg"
            for joint, value in enumerate(variation["start_offset"])
        ),
    }
    for number, orbit in enumerate(variation["orbits"]):
        words = [_degrees(orbit["turn"]), _degrees(orbit["tilt"]), _factor(orbit["distance"])]
        found[f"camera {number} moved"] = ", ".join(filter(None, words))
    return {name: words for name, words in found.items() if words}


def _plot_arm(episode: Episode, slides: Collection[int]) -> list[dict[str, Any]]:
    plots = []
    for title, unit, factor, sliding in (
        ("arm joints", "deg", np.degrees(1.0), False),
        ("sliding arm joints", "mm", 1000.0, True),
    ):
        lines = {
            name: factor * values
            for joint, (name, values) in enumerate(zip(episode.joint_names, episode.joints.T, strict=True))
            if (joint in slides) == sliding
        }
        plots += [_plot(title, unit, lines)] if lines else []
    return plots


def _plot(
    title: str, unit: str, lines: Mapping[str, Array], levels: Sequence[tuple[float, str]] = ()
) -> dict[str, Any]:
    return {
        "title": title,
        "unit": unit,
        "lines": [
            {"name": name, "values": np.round(values, DIGITS).tolist()} for name, values in lines.items()
        ],
        "levels": [{"value": round(float(value), DIGITS), "name": name} for value, name in levels],
    }


def _factor(value: float) -> str:
    return "" if value == 1 else f"x {value:.2f}"


def _degrees(radians: float) -> str:
    return "" if radians == 0 else f"{np.degrees(radians):+.0f} deg"
