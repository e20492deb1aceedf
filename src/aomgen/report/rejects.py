"""The report's section on poses that gave no episode: why, and what got in the way."""

from typing import Any

from aomgen.core.plan import Variation
from aomgen.generalization.ik import IkLimits
from aomgen.io.jsonfile import read_json
from aomgen.report.episodes import place_words
from aomgen.report.html import heading, paragraph, table, whole
from aomgen.results import Results
from aomgen.simulation.collision_check import KinematicLimits
from aomgen.simulation.verify import PassRule

# Rejects listed for each reason.
LISTED = 20


def rejects_section(results: Results) -> list[str]:
    """One table for each reason, the commonest first."""
    path = results.folders["plans"] / "rejected.json"
    rejected = read_json(path)
    if not rejected["rejected"]:
        return [paragraph("Every pose that was tried gave an episode.")]
    meanings = reasons()
    parts = [
        paragraph(
            "Poses that were tried and gave no episode; they are counted, never drawn. Each line tells of the "
            "grasp that came farthest."
        )
    ]
    for reason, count in sorted(rejected["reasons"].items(), key=lambda item: -item[1]):
        found = [item for item in rejected["rejected"] if item["reason"] == reason]
        parts.append(heading(f"{count} {reason.replace('_', ' ')}: {meanings.get(reason, reason)}"))
        parts.append(
            table(["asset", "moved: x, y, turn", "what was found"], [_row(item) for item in found[:LISTED]])
        )
        if len(found) > LISTED:
            parts.append(paragraph(f"{len(found) - LISTED} more in {path.parent.name}/{path.name}."))
    return parts


def reasons() -> dict[str, str]:
    """What each reason of a rejection means, with its limit."""
    ik, contact, rule = IkLimits(), KinematicLimits(), PassRule()
    return {
        "unreachable": f"the arm misses an asked pose by more than {ik.residual_mm:g} mm or {ik.residual_deg:g} deg",
        "joint_limit": "a joint comes too near to its limit",
        "branch": "the arm's way back from the grasp ends in another joint configuration than the demonstrated one",
        "too_fast": f"a joint is faster than {ik.speed:g} rad/s, also when the motion is slowed down",
        "collision": f"robot and scene overlap by more than {contact.max_penetration_mm:g} mm",
        "self_collision": "two parts of the robot overlap",
        "grip_collision": f"fingers and handle overlap by more than {contact.max_handle_penetration_mm:g} mm",
        "no_grip": f"a finger pad stays more than {contact.max_gap_mm:g} mm away from the handle",
        "no_grasp": "the asset offers no grasp",
        "target_too_small": "the planned opening is too small to count",
        "diverged": "the simulation became unstable",
        "pre_opened": "the part had moved before the gripper arrived",
        "target": f"the part reached less than {rule.target_share:.0%} of the planned opening",
        "contact": f"less than {rule.contact_share:.0%} of the way was made in contact",
        "slides": f"the object's base slid by more than {1000 * rule.max_drift_m:g} mm",
    }


def _row(item: dict[str, Any]) -> list[object]:
    return [item["asset"], whole(place_words(Variation(**item["variation"]))), item["detail"]]
