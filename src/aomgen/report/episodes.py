"""The report's sections on the episodes: videos and verdicts, all draws against their ranges, and rejections."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.assets.mjcf import GRAVITY
from aomgen.core.plan import Variation
from aomgen.episodes.factory import GenerationParams
from aomgen.episodes.generate import LOST
from aomgen.episodes.joint_limits import IkLimits
from aomgen.episodes.ledger import DRAWS_FILE, Distribution, distributions, read_draws
from aomgen.episodes.reach_map import OUTCOMES, REACH_MAP, ReachMap, Shape, draw_map, front_line, scene_shapes
from aomgen.io.artifact import load_artifact
from aomgen.io.episode_folder import CommittedEpisode, list_committed, read_episode
from aomgen.io.video import read_frames
from aomgen.pipeline.figures import read_figure
from aomgen.report.html import Markup, fold, heading, link, paragraph, table, text, video, whole
from aomgen.results import Results
from aomgen.simulation.collision_check import KinematicLimits
from aomgen.simulation.judge import PassRule

# Episodes shown with videos; each adds two posters of some 15 kB to the page.
SHOWN = 24
# Size of one histogram, [px].
WIDTH, HEIGHT = 230, 92
# Rejects listed for each reason.
LISTED = 20
# Figures of a verdict, and which of its settings is the worst.
WORST = {
    "target_share": min,
    "contact_share": min,
    "tracking_mm": max,
    "torque_share": max,
    "handle_penetration_mm": max,
    "robot_force_n": max,
    "peak_force_n": max,
    "peak_reaction_n": max,
}


def episodes_section(results: Results) -> list[str]:
    """Cards with videos of the first episodes, a table of all, and what its figures are held against."""
    made = [read_episode(folder) for folder in list_committed(results.folders["episodes"])]
    rule = PassRule()
    count = len({run["name"] for item in made for run in item.episode.verdict["dynamic"]})
    cards = "".join(_card(item) for item in made[:SHOWN])
    more = f" The first {SHOWN} of {len(made)} are shown; the table has all." if len(made) > SHOWN else ""
    return [
        paragraph(
            f"{len(made)} episodes, each verified in physics before it was drawn: contact alone moves the passive "
            f"joint, to at least {rule.target_share:.0%} of the planned way and for {rule.contact_share:.0%} "
            f"of the way in contact. Each was simulated in the nominal setting and two opposite ones, which differ in "
            f"the joint's resistance, mass, grip and latch; {count} settings in all.{more}"
        ),
        f'<div class="cards">{cards}</div>',
        heading("Verdicts"),
        paragraph("The worst of the settings. " + force_limits(results, made)),
        fold(f"all {len(made)} episodes", _verdicts(made), opened=len(made) <= SHOWN),
    ]


def place_words(variation: Mapping[str, Any]) -> str:
    """Displacement of an object from the recorded one, from a stored `Variation`."""
    place = (100 * variation["x"], 100 * variation["y"], np.degrees(variation["yaw"]))
    x, y, yaw = (round(float(value)) for value in place)
    return f"{x:+d} cm, {y:+d} cm, {yaw:+d} deg"


def force_limits(results: Results, made: list[CommittedEpisode]) -> str:
    """Sentences on the limits of the forces of the verdicts, and on forces without a limit."""
    words = "The grip force has no limit of its own: how deep it presses handle and pads into each other has."
    if not all(item.episode.verdict["bolted"] for item in made):
        slide_mm = PassRule().drift_mm
        return f"{words} The force on the object is limited by its base, which may slide {slide_mm:g} mm."
    friction = PassRule().base_friction
    holds = [
        f"{fitted.asset.name} from {friction * GRAVITY * (fitted.asset.static.mass + fitted.asset.moving.mass):.0f} N"
        for fitted in results.fitted_assets
    ]
    return (
        f"{words} None is set on the force on the object either, because it is simulated as fixed to the table; "
        f"standing there by friction alone ({friction:g}) it would slide: {', '.join(holds)}."
    )


def _card(item: CommittedEpisode) -> str:
    episode = item.episode
    widest = int(np.argmax(episode.thetas))
    players = "".join(
        video(_link(item, path), read_frames(path, [widest])[0], f"{item.folder.name}, camera {name}")
        for name, path in item.videos.items()
    )
    reached = float(episode.thetas[widest])
    opened = (
        f"{np.degrees(reached):.0f} deg" if episode.joint.type == "revolute" else f"{1000 * reached:.0f} mm"
    )
    return (
        f'<figure class="card"><div class="views">{players}</div><figcaption><b>{item.folder.name}</b> '
        f'{text(episode.asset)}, opened {opened} <span class="dim">moved {text(place_words(episode.verdict["variation"]))}; '
        f"{text(' and '.join(item.videos))}, {len(episode.thetas) / episode.fps:.1f} s</span>"
        "</figcaption></figure>"
    )


def _link(item: CommittedEpisode, path: Path) -> str:
    """Path of an episode's file, relative to the page."""
    return f"{item.folder.parent.name}/{item.folder.name}/{path.name}"


def _verdicts(made: list[CommittedEpisode]) -> str:
    rows: list[list[object]] = []
    for item in made:
        runs = item.episode.verdict["dynamic"]
        figures = [
            read_figure("verdict", name, worst(run[name] for run in runs)).number
            for name, worst in WORST.items()
        ]
        videos = " ".join(link(_link(item, path), name) for name, path in item.videos.items())
        rows.append(
            [
                Markup(html=f'<span class="whole">{item.folder.name} {videos}</span>'),
                whole(item.episode.asset),
                whole(place_words(item.episode.verdict["variation"])),
                *figures,
            ]
        )
    titles = [read_figure("verdict", name, 0.0).title for name in WORST]
    return table(["episode", "asset", "moved: x, y, turn", *titles], rows)


def rejects_section(results: Results) -> list[str]:
    """One table for each reason, the commonest first."""
    folder = results.folders["episodes"]
    failed = [item for item in read_draws(folder) if item["outcome"] != "committed"]
    if not failed:
        return [paragraph("Every pose that was drawn gave an episode.")]
    meanings = reasons()
    parts = [
        paragraph(
            "Draws that gave no episode, most of them before anything was planned; none is rendered. Where planning "
            "failed, each line tells of the grasp that came farthest."
        )
    ]
    for reason, count in Counter(item["reason"] for item in failed).most_common():
        found = [item for item in failed if item["reason"] == reason]
        parts.append(heading(f"{count} {reason.replace('_', ' ')}: {meanings.get(reason, reason)}"))
        parts.append(
            table(["asset", "moved: x, y, turn", "what was found"], [_row(item) for item in found[:LISTED]])
        )
        if len(found) > LISTED:
            parts.append(paragraph(f"{len(found) - LISTED} more in {folder.name}/{DRAWS_FILE}."))
    return parts


def reasons() -> dict[str, str]:
    """Meaning of each reason of a rejection, with its limit."""
    ik, contact, rule = IkLimits(), KinematicLimits(), PassRule()
    return {
        "outside_area": "the place lies beside the area asked for",
        "off_table": "the object would stand beyond the table's edge",
        "blocked": "the object would stand where something else of the scene does",
        "out_of_reach": "the handle is farther away than the arm can hold anything",
        "out_of_view": "a camera does not show enough of the action",
        **LOST,
        "unreachable": f"the arm misses an asked pose by more than {ik.residual_mm:g} mm or {ik.residual_deg:g} deg",
        "joint_limit": "a joint comes too near to its limit",
        "branch": "the arm's way back from the grasp ends in another joint configuration than the demonstrated one",
        "too_fast": f"a joint is faster than {ik.speed:g} rad/s, also when the motion is slowed down",
        "too_jerky": f"a joint exceeds {ik.acceleration:g} rad/s^2 or {ik.jerk:g} rad/s^3, also when the motion is slowed down",
        "collision": f"robot and scene overlap by more than {contact.max_penetration_mm:g} mm",
        "self_collision": "two parts of the robot overlap",
        "no_path": "the search finds no motion of the arm to the handle without a collision",
        "grip_collision": f"fingers and handle overlap by more than {contact.max_handle_penetration_mm:g} mm",
        "no_grip": f"a finger pad stays more than {contact.max_gap_mm:g} mm away from the handle",
        "no_grasp": "the asset offers no grasp",
        "target_too_small": "the planned way is too short to count",
        "not_finite": "an action is no number",
        "diverged": "the simulation became unstable",
        "imposed": "something else than contact moves the part, or its joint value was written",
        "moved_early": "the part had moved before the robot touched it",
        "door_pushed": f"more than {rule.pushed_share:.0%} of the way was made by other contacts than pads on the handle",
        "robot_contact": f"the robot pressed on other things than the handle with more than {rule.robot_force_n:g} N",
        "torque": f"a drive needed more than {rule.torque_share:.0%} of its torque for {rule.torque_s:g} s",
        "tracking": f"the arm was more than {rule.tracking_mm:g} mm off its command",
        "penetration": f"gripper and handle overlapped by more than {rule.handle_penetration_mm:g} mm, or the robot and "
        f"anything else by {rule.penetration_mm:g} mm",
        "target": f"the part reached less than {rule.target_share:.0%} of the planned way",
        "contact": f"less than {rule.contact_share:.0%} of the way was made in contact",
        "slides": f"the object's base slid by more than {rule.drift_mm:g} mm",
    }


def _row(item: dict[str, Any]) -> list[object]:
    return [item["name"], whole(place_words(item["variation"])), item["detail"]]


def draws_section(results: Results) -> list[str]:
    """Histograms of everything that differs, and a map of the places."""
    draws = read_draws(results.folders["episodes"])
    if not draws:
        return []
    params = results.params("episodes", GenerationParams())
    found = distributions(draws, params.ranges, params.free_cameras)
    charts = "".join(draw_histogram(item) for item in found)
    return [
        paragraph(
            "Grey: all draws, spread evenly over the range asked for. Blue: those that were planned. Green: those that "
            "became episodes."
        ),
        f'<div class="head">{charts}</div>',
        paragraph(
            "The places from above, the robot at the cross; a line points where the object's front looks. Green: an "
            "episode. Red: planned in vain. Grey: not worth planning; the reasons follow below. Pale green below: where "
            "the arm can hold the handle, the stronger, the more turns of the object. Brown: the free table; dark "
            "boxes: what else stands there."
        ),
        _map(results, draws),
    ]


def draw_histogram(item: Distribution) -> str:
    """One small chart."""
    count, tallest = len(item.drawn), max(int(item.drawn.max()), 1)
    wide = WIDTH / count
    bars = "".join(
        f'<rect x="{k * wide + 1:.1f}" y="{14 + 56 * (1 - number / tallest):.1f}" width="{wide - 2:.1f}" '
        f'height="{56 * number / tallest:.1f}" fill="{color}"/>'
        for numbers, color in (
            (item.drawn, "#dde2e9"),
            (item.tried, "#9fc3d0"),
            (item.delivered, OUTCOMES["committed"]),
        )
        for k, number in enumerate(numbers.tolist())
    )
    name = f"{item.name} [{item.unit}]" if item.unit else item.name
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" style="width:{WIDTH}px">{bars}'
        f'<text x="2" y="11">{text(name)}: {item.delivered.sum()} of {item.drawn.sum()}</text>'
        f'<text x="2" y="{HEIGHT - 6}">{item.edges[0]:g}</text>'
        f'<text x="{WIDTH - 2}" y="{HEIGHT - 6}" text-anchor="end">{item.edges[-1]:g}</text></svg>'
    )


def _map(results: Results, draws: list[dict[str, Any]]) -> str:
    """Map of the objects of all draws, on the scene and the reach of the arm."""
    folder, count = results.folders["episodes"], len(results.fitted_assets)
    maps = [load_artifact(folder, REACH_MAP.format(number), ReachMap) for number in range(count)]
    ordered = sorted(draws, key=lambda draw: list(OUTCOMES)[::-1].index(draw["outcome"]))
    lines = [_line(results, draw) for draw in ordered]
    return draw_map([*scene_shapes(results.episode_scene, maps), *lines])


def _line(results: Results, draw: Mapping[str, Any]) -> Shape:
    stored = draw["variation"]
    place = {name: stored[name] for name in ("seed", "index", "x", "y", "yaw", "frame")}
    return front_line(results.fitted_assets[draw["asset"]], Variation(**place), draw["outcome"])
