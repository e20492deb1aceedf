"""One HTML file that shows a run without AOMGen or a network: its twin, some episodes, and an overview of all."""

import base64
import importlib.resources
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.errors import AomgenError, MissingFileError
from aomgen.evaluation.evaluate import place_side_by_side
from aomgen.io.atomic import write_text
from aomgen.io.episode_folder import episode_folder, read_episode
from aomgen.io.images import encode_jpeg
from aomgen.io.review import Review, read_reviews
from aomgen.io.video import encode_video, read_video
from aomgen.pipeline.manifest import read_manifest
from aomgen.pipeline.rendering import open_twin, render_twin
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import REPORT_FILE, STAGES, find_project
from aomgen.report.episodes import reasons
from aomgen.report.page import OFFLINE_PAGE, write_report
from aomgen.results import Results
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import TwinModel
from aomgen.viewing.draw_list import Draw, DrawList
from aomgen.viewing.review_pages import describe_draw
from aomgen.viewing.thumbnails import encode_thumbnail

# Number of images of the twin over the range of its joint: steps of about 3 degrees for a door.
STRIP_IMAGES: Final = 24
# Quality of the embedded JPEG images and videos: a page of a few MB can still be sent by mail.
JPEG_QUALITY, VIDEO_CRF = 85, 28
# Number of playable episodes per asset, and their largest total number.
PLAYED_EACH, MOST_PLAYED = 1, 4
# Largest number of episodes whose first and last image are embedded; an image has about 10 kB.
MOST_SHOWN: Final = 300
# Placeholder of the content in the template.
SLOT: Final = "__CONTENT__"


def write_offline_page(out: Path, path: Path) -> int:
    """Write the page of a run; sections without results are omitted.

    The report of the run links to the page if it is `page.html` in the folder of the run.

    Returns:
        Size of the page, [bytes].

    Raises:
        MissingFileError: The run does not exist, or has neither a twin nor an episode.
        CorruptArtifactError, MalformedFileError: A file of the run is damaged.
        StorageError: Writing to the disk failed.
    """
    results = results_of(find_project(out), STAGES)
    folder, reviews = results.folders["episodes"], read_reviews(results.out)
    draws = DrawList(results.out, folder).read()
    kept = [draw for draw in draws if draw.outcome == "committed" and not _is_rejected(draw, reviews)]
    twin = read_manifest(results.folders["twin"]) is not None
    if not (twin or kept):
        raise MissingFileError(out, "has neither a twin nor an episode", f"finish it with `aomgen run {out}`")
    kept.sort(key=lambda draw: draw.room or 0.0)
    players = [_embed_episode(folder, draw) for draw in choose_played(kept)]
    content = {
        "run": results.out.resolve().name,
        "instruction": next((player["instruction"] for player in players), ""),
        "strip": _describe_strip(results) if twin else None,
        "players": players,
        "episodes": [
            describe_draw(draw, reviews) | _embed_images(folder, draw) for draw in kept[:MOST_SHOWN]
        ],
        "kept": len(kept),
        "rejected_by_review": sum(_is_rejected(draw, reviews) for draw in draws),
        "reasons": _count_reasons(draws),
    }
    template = (importlib.resources.files("aomgen.viewing") / "offline.html").read_text("utf-8")
    # "</script>" in a name would end the script that contains the content.
    page = template.replace(SLOT, json.dumps(content, allow_nan=False).replace("</", "<\\/"))
    write_text(path, page)
    if path.resolve() == results.out.resolve() / OFFLINE_PAGE and (results.out / REPORT_FILE).is_file():
        write_report(results.out)  # the report links to the page
    return len(page.encode())


def choose_played(draws: Sequence[Draw]) -> list[Draw]:
    """Choose the episodes that can be played: for each asset those with the largest margins to their limits."""
    counts, chosen = Counter[str](), []
    for draw in sorted(draws, key=lambda draw: -(draw.room or 0.0)):
        if counts[draw.asset] < PLAYED_EACH and len(chosen) < MOST_PLAYED:
            counts[draw.asset] += 1
            chosen.append(draw)
    return sorted(chosen, key=lambda draw: draw.number)


def draw_strip(twin: TwinModel, robot: RobotModel, camera: Camera, values: Array) -> list[str]:
    """Render the twin at joint values (K,), [rad] or [m], otherwise as scanned; return data URLs of JPEG images."""
    images = []
    for value in values.tolist():
        state = replace(twin.scan_state, theta=value)
        images.append(
            _embed("image/jpeg", encode_jpeg(render_twin(twin, robot, camera, state)[0], JPEG_QUALITY))
        )
    return images


def _describe_strip(results: Results) -> dict[str, Any]:
    """Render the twin over the recorded range of its joint with the first camera of the recording."""
    twin, robot = open_twin(results.out)
    name, fixed = next(iter(results.alignment.cameras.items()))
    values = np.linspace(results.motion.thetas.min(), results.motion.thetas.max(), STRIP_IMAGES)
    turning = results.motion.joint.type == "revolute"
    return {
        "camera": name,
        "unit": "deg" if turning else "mm",
        "values": (values * (np.degrees(1.0) if turning else 1000.0)).round(2).tolist(),
        "images": draw_strip(twin, robot, fixed.camera, values),
    }


def _embed_episode(folder: Path, draw: Draw) -> dict[str, Any]:
    """Embed all views of an episode side by side as one video."""
    committed = read_episode(episode_folder(folder, draw.number))
    videos = [read_video(path).frames_srgb for path in committed.videos.values()]
    shown = map(place_side_by_side, zip(*videos, strict=True))
    data = encode_video(shown, committed.episode.fps, crf=VIDEO_CRF)
    return {
        "number": draw.number,
        "asset": draw.asset,
        "instruction": committed.episode.instruction,
        "views": list(committed.videos),
        "video": _embed("video/mp4", data),
    }


def _embed_images(folder: Path, draw: Draw) -> dict[str, str]:
    """Embed the first and last image of an episode; for a damaged video, return the error message instead."""
    video = episode_folder(folder, draw.number) / f"{draw.cameras[0]}.mp4"
    try:
        return {frame: _embed("image/jpeg", encode_thumbnail(video, frame)) for frame in ("first", "last")}
    except AomgenError as error:
        return {"problem": str(error)}


def _count_reasons(draws: Sequence[Draw]) -> list[dict[str, Any]]:
    """Count the reasons of the samples without an episode, the most frequent first."""
    meanings = reasons()
    counts = Counter(draw.reason for draw in draws if draw.outcome in ("rejected", "skipped"))
    return [
        {"reason": reason, "count": count, "meaning": meanings.get(reason, "")}
        for reason, count in counts.most_common()
    ]


def _is_rejected(draw: Draw, reviews: dict[int, Review]) -> bool:
    review = reviews.get(draw.number, Review())
    return review.decision == "rejected" and review.content == draw.content


def _embed(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
