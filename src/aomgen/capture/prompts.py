"""The prompts of a capture: boxes and points that a person draws on scan images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from aomgen.capture.capture_schema import PromptSection
from aomgen.core.recording import Prompt
from aomgen.errors import InputError, MissingFileError, UnitsError

PARTS = ("robot", "static", "moving")
# Least size of a drawn box; boxes in shares of the image are smaller, [px].
MIN_BOX_PX = 4.0
# A click on a part may miss its box by this share of the box.
POINT_SLACK = 0.1


def read_prompts(
    sections: list[PromptSection],
    names: set[str],
    size: tuple[int, int],
    path: Path,
    *,
    complete: bool = True,
) -> tuple[Prompt, ...]:
    """Check the prompts of a capture.

    Args:
        names: Names of the scan images.
        size: Width and height of the scan images, [px].
        complete: Whether every part must have a box.

    Raises:
        MissingFileError: A prompt names no scan image.
        UnitsError: Coordinates that look like shares of the image.
        InputError: A box without extent, outside the image or away from its points, a point that is
            neither on nor off the part, or a part without a box.
    """
    prompts = tuple(check_prompt(section, names, size, path) for section in sections)
    missing = [part for part, images in list_boxed_images(prompts).items() if not images]
    if complete and missing:
        raise InputError(
            path,
            f"has no prompt with a box for {' and '.join(missing)}",
            "mark it on two scan images with `aomgen prompts`, let `aomgen init --propose` find it, "
            "or add [[prompts]] entries with a box to capture.toml",
        )
    return prompts


def prompt_warnings(prompts: tuple[Prompt, ...]) -> list[str]:
    """List warnings about parts that have a prompt on only one image."""
    return [
        f"only '{min(found)}' has a prompt for the {part} part: if this image cannot be registered, the run stops; "
        "draw a box on a second image"
        for part, found in list_boxed_images(prompts).items()
        if len(found) == 1
    ]


def list_proposals(sections: Sequence[PromptSection]) -> list[str]:
    """Warn about proposed prompts that no person has confirmed; empty without any.

    Example:
        >>> list_proposals([PromptSection(part="robot", image="0.jpg", box=[0, 0, 9, 9], proposed=True, confidence=0.6)])
        ['the prompts of capture.toml are proposals (robot 0.60), confirm them with `aomgen prompts CAPTURE`']
    """
    least: dict[str, float] = {}
    for section in sections:
        if section.proposed:
            least[section.part] = min(least.get(section.part, 1.0), section.confidence or 0.0)
    if not least:
        return []
    named = ", ".join(f"{part} {confidence:.2f}" for part, confidence in least.items())
    return [
        f"the prompts of capture.toml are proposals ({named}), confirm them with `aomgen prompts CAPTURE`"
    ]


def list_boxed_images(prompts: Sequence[Prompt | PromptSection]) -> dict[str, set[str]]:
    """List the images with a box around each part, for all parts."""
    return {
        part: {item.image for item in prompts if item.part == part and item.box is not None and len(item.box)}
        for part in PARTS
    }


def check_prompt(section: PromptSection, names: set[str], size: tuple[int, int], path: Path) -> Prompt:
    """Check one prompt; arguments and errors as for `read_prompts`."""
    where = f"{path}: the {section.part} prompt on '{section.image}'"
    if section.image not in names:
        raise MissingFileError(
            path,
            f"a prompt names '{section.image}', which is not a scan image",
            f"correct the name (known: {min(names)} to {max(names)})",
        )
    if not section.points and section.box is None:
        raise InputError(where, "has neither points nor a box", "draw a box around the part")
    if section.proposed == (section.confidence is None):
        raise InputError(
            where,
            "has only one of proposed and confidence",
            "proposals have both; delete both from a prompt that you have checked",
        )
    points = np.array(section.points, np.float64).reshape(-1, 3)
    box = np.array([] if section.box is None else section.box)
    corners = np.concatenate([points[:, :2], box.reshape(-1, 2)])
    if not (np.all(corners >= 0) and np.all(corners <= np.array(size))):
        raise InputError(
            where,
            f"has coordinates outside the image of {size[0]} x {size[1]} px",
            "give pixels inside the image",
        )
    if corners.max() <= 1.0:
        raise UnitsError(
            where,
            f"has coordinates up to {corners.max():g} only, which seem to be relative to the image size",
            "give pixels",
        )
    if not np.isin(points[:, 2], (0, 1)).all():
        raise InputError(
            where,
            "has a point whose third number is neither 1 nor 0",
            "give x, y, and 1 (on the part) or 0 (outside of it)",
        )
    if section.box is not None:
        _check_box(section.box, points, where)
    return Prompt(part=section.part, image=section.image, points=points, box=box)


def _check_box(box: list[float], points: np.ndarray, where: str) -> None:
    x0, y0, x1, y1 = box
    if not (x1 > x0 and y1 > y0):
        raise InputError(
            where, f"has the box {box}, whose second corner is not right of and below the first",
            "give x0, y0, x1, y1, not width and height",
        )  # fmt: skip
    if not min(x1 - x0, y1 - y0) >= MIN_BOX_PX:
        raise InputError(
            where,
            f"has a box of {x1 - x0:g} x {y1 - y0:g} px, expected at least {MIN_BOX_PX:g}",
            "draw it around the part",
        )
    on = points[points[:, 2] == 1, :2]
    slack = POINT_SLACK * np.array([x1 - x0, y1 - y0])
    outside = on[~np.all((on >= (x0, y0) - slack) & (on <= (x1, y1) + slack), axis=1)]
    if len(outside):
        x, y = outside[0]
        raise InputError(
            where,
            f"has a point ({x:g}, {y:g}) on the part, but outside its box {box}",
            "give points as x, y and boxes as x0, y0, x1, y1",
        )
