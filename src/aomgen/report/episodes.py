"""The report's sections on the episodes: videos and verdicts, all draws against their ranges, and rejections."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.assets.mjcf import GRAVITY
from aomgen.core.plan import Variation
from aomgen.episodes.joint_limits import IkLimits
from aomgen.episodes.ledger import DRAWS_FILE, Distribution, distributions, read_draws
from aomgen.episodes.parameters import GenerationParams
from aomgen.episodes.reach_map import OUTCOMES, REACH_MAP, ReachMap, Shape, draw_map, front_line, scene_shapes
from aomgen.executors import LOST
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
# Number of rejected samples that are listed for each reason.
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
    """Return cards with videos of the first episodes, and a table of all with the limits of its metrics."""
    made = [read_episode(folder) for folder in list_committed(results.folders["episodes"])]
    rule = PassRule()
    count = len({run["name"] for item in made for run in item.episode.verdict["dynamic"]})
    cards = "".join(_card(item) for item in made[:SHOWN])
    more = f" The first {SHOWN} of {len(made)} are shown; the table has all." if len(made) > SHOWN else ""
    return [
        paragraph(
            f"{len(made)} episodes, each verified in simulation before it was rendered: contact alone moves the passive "
            f"joint, by at least {rule.target_share:.0%} of the planned travel, and for {rule.contact_share:.0%} "
            f"of the travel with a pad on the handle. Each was simulated in the nominal setting and in two opposite "
            f"settings, which differ in joint resistance, mass, friction and latch; {count} settings in all.{more}"
        ),
        f'<div class="cards">{cards}</div>',
        heading("Verdicts"),
        paragraph("Worst values over all settings. " + force_limits(results, made)),
        fold(f"all {len(made)} episodes", _verdicts(made), opened=len(made) <= SHOWN),
    ]


def place_words(variation: Mapping[str, Any]) -> str:
    """Format x, y and yaw of a stored `Variation`; a position in the world, not a displacement, begins with "at"."""
    place = (100 * variation["x"], 100 * variation["y"], np.degrees(variation["yaw"]))
    x, y, yaw = (round(float(value)) for value in place)
    if variation.get("frame") == "polygon":
        return f"at {x} cm, {y} cm, {yaw:+d} deg"
    return f"{x:+d} cm, {y:+d} cm, {yaw:+d} deg"


def force_limits(results: Results, made: list[CommittedEpisode]) -> str:
    """Return sentences about the force limits of the verdicts, and about forces without a limit."""
    words = "The grip force has no separate limit; the penetration of handle and pads that it causes has one."
    if not all(item.episode.verdict["bolted"] for item in made):
        slide_mm = PassRule().drift_mm
        return f"{words} The force on the object is limited by its base, which may slide {slide_mm:g} mm."
    friction = PassRule().base_friction
    holds = [
        f"{fitted.asset.name} from {friction * GRAVITY * (fitted.asset.static.mass + fitted.asset.moving.mass):.0f} N"
        for fitted in results.fitted_assets
    ]
    return (
        f"{words} The force on the object has no limit either, because the object is simulated as fixed to the table. "
        f"If it were held by friction alone ({friction:g}), it would slide: {', '.join(holds)}."
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
        f'{text(episode.asset)}, opened {opened} <span class="dim">object {text(place_words(episode.verdict["variation"]))}; '
        f"{text(' and '.join(item.videos))}, {len(episode.thetas) / episode.fps:.1f} s</span></figcaption></figure>"
    )


def _link(item: CommittedEpisode, path: Path) -> str:
    """Return the path of an episode's file relative to the page."""
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
                Markup(f'<span class="whole">{item.folder.name} {videos}</span>'),
                whole(item.episode.asset),
                whole(place_words(item.episode.verdict["variation"])),
                *figures,
            ]
        )
    titles = [read_figure("verdict", name, 0.0).title for name in WORST]
    return table(["episode", "asset", "object: x, y, yaw", *titles], rows)


def rejects_section(results: Results) -> list[str]:
    """Return one table for each reason of rejection, the most frequent reason first."""
    folder = results.folders["episodes"]
    failed = [item for item in read_draws(folder) if item["outcome"] != "committed"]
    if not failed:
        return [paragraph("Every sampled pose gave an episode.")]
    meanings = reasons()
    parts = [
        paragraph(
            "Samples that gave no episode. Most of them were rejected before planning, and none is rendered. If planning "
            "failed, the line describes the grasp that progressed farthest."
        )
    ]
    for reason, count in Counter(item["reason"] for item in failed).most_common():
        found = [item for item in failed if item["reason"] == reason]
        parts.append(heading(f"{count} {reason.replace('_', ' ')}: {meanings.get(reason, reason)}"))
        parts.append(table(["asset", "object: x, y, yaw", "result"], [_row(item) for item in found[:LISTED]]))
        if len(found) > LISTED:
            parts.append(paragraph(f"{len(found) - LISTED} more in {folder.name}/{DRAWS_FILE}."))
    return parts


def reasons() -> dict[str, str]:
    """Return the meaning of each reason of a rejection, with its limit."""
    ik, contact, rule = IkLimits(), KinematicLimits(), PassRule()
    return {
        "outside_area": "the position is outside the requested area",
        "off_table": "the object would protrude beyond the edge of the table",
        "blocked": "the object would overlap with an obstacle of the scene",
        "out_of_reach": "the handle is out of reach of the arm",
        "out_of_view": "a camera does not show enough of the action",
        **LOST,
        "unreachable": f"the arm misses a requested pose by more than {ik.residual_mm:g} mm or {ik.residual_deg:g} deg",
        "joint_limit": "a joint is too close to its limit",
        "branch": "the approach begins in another joint configuration than the demonstrated one",
        "too_fast": f"a joint is faster than {ik.speed:g} rad/s, also when the motion is slowed down",
        "too_jerky": f"a joint exceeds {ik.acceleration:g} rad/s^2 or {ik.jerk:g} rad/s^3, also when the motion is slowed down",
        "collision": f"robot and scene overlap by more than {contact.max_penetration_mm:g} mm",
        "self_collision": "two parts of the robot overlap",
        "no_path": "the search finds no motion of the arm to the handle without a collision",
        "grip_collision": f"fingers and handle overlap by more than {contact.max_handle_penetration_mm:g} mm",
        "no_grip": f"a finger pad stays more than {contact.max_gap_mm:g} mm away from the handle",
        "target_too_small": "the planned travel is too short to be evaluated",
        "not_finite": "an action is not a number",
        "diverged": "the simulation became unstable",
        "imposed": "the part is moved by something other than contact, or its joint value was written",
        "moved_early": "the part had moved before the robot touched it",
        "door_pushed": f"contacts other than pads on the handle caused over {rule.pushed_share:.0%} of the travel",
        "robot_contact": f"the robot pressed on bodies other than the handle with more than {rule.robot_force_n:g} N",
        "torque": f"a drive needed more than {rule.torque_share:.0%} of its torque for {rule.torque_s:g} s",
        "tracking": f"the arm deviated from its command by more than {rule.tracking_mm:g} mm",
        "penetration": f"gripper and handle overlapped by more than {rule.handle_penetration_mm:g} mm, or the robot and "
        f"another body by {rule.penetration_mm:g} mm",
        "target": f"the part reached less than {rule.target_share:.0%} of the planned travel",
        "contact": f"less than {rule.contact_share:.0%} of the travel was made in contact",
        "slides": f"the object's base slid by more than {rule.drift_mm:g} mm",
    }


def _row(item: dict[str, Any]) -> list[object]:
    return [item["name"], whole(place_words(item["variation"])), item["detail"]]


def draws_section(results: Results) -> list[str]:
    """Return histograms of all variations, and a map of the sampled positions."""
    draws = read_draws(results.folders["episodes"])
    if not draws:
        return []
    params = results.params("episodes", GenerationParams())
    found = distributions(draws, params.ranges, params.free_cameras)
    charts = "".join(draw_histogram(item) for item in found)
    return [
        paragraph(
            "Gray: all samples, distributed evenly over the requested range. Blue: samples that were planned. "
            "Green: samples that became episodes."
        ),
        f'<div class="head">{charts}</div>',
        paragraph(
            "Top view of the sampled positions; the cross marks the robot, and a line the direction of the object's front. "
            "Green: episode. Red: planning or verification failed. Gray: rejected before planning, for the reasons "
            "below. Pale green area: the arm can hold the handle, the darker, the more yaw angles are possible. Brown: "
            "free table. Dark boxes: obstacles."
        ),
        _map(results, draws),
    ]


def draw_histogram(item: Distribution) -> str:
    """Draw the histogram of one variation as an SVG."""
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
    """Draw a map of the objects of all draws, with the scene and the reach of the arm."""
    folder, count = results.folders["episodes"], len(results.fitted_assets)
    maps = [load_artifact(folder, REACH_MAP.format(number), ReachMap) for number in range(count)]
    ordered = sorted(draws, key=lambda draw: list(OUTCOMES)[::-1].index(draw["outcome"]))
    lines = [_line(results, draw) for draw in ordered]
    return draw_map([*scene_shapes(results.episode_scene, maps), *lines])


def _line(results: Results, draw: Mapping[str, Any]) -> Shape:
    stored = draw["variation"]
    place = {name: stored[name] for name in ("seed", "index", "x", "y", "yaw", "frame", "scale")}
    return front_line(results.fitted_assets[draw["asset"]], Variation(**place), draw["outcome"])
