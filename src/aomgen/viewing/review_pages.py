"""The review of a run: all samples, one episode, and decisions."""

import hashlib
import json
from collections.abc import Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from aomgen.errors import AomgenError
from aomgen.io.episode_folder import episode_folder
from aomgen.io.review import Review, ReviewChange, change_review, read_reviews
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import STAGES, find_project
from aomgen.report.episodes import place_words, reasons
from aomgen.viewing.coverage_pages import CoverageRoutes
from aomgen.viewing.draw_list import Draw, DrawList
from aomgen.viewing.draw_page import describe_episode, describe_rejected
from aomgen.viewing.policy_pages import PolicyRoutes
from aomgen.viewing.thumbnails import encode_thumbnail
from aomgen.web.page_server import PageRequest, RequestFields, Response, Route, send_file, send_json

PACKAGE: Final = "aomgen.viewing"
# Number of thumbnails that stay in memory, about 20 MB.
THUMBNAILS: Final = 4000


class WallRequest(RequestFields):
    """Request of all samples; the version is that of the last response, which is not sent again."""

    version: str = ""


class ShownDrawRequest(RequestFields):
    """Request of one sample by its number."""

    number: int


class ThumbnailRequest(ShownDrawRequest):
    """Request of a thumbnail of an episode's first camera."""

    frame: Literal["first", "last"]


class VideoRequest(ShownDrawRequest):
    """Request of an episode's video; cameras are numbered in the order of the episode."""

    camera: int


class ChangeRequest(RequestFields):
    """Change of the review of one episode."""

    number: int
    change: ReviewChange


class ReviewRoutes:
    """Routes of the review of the run in a folder.

    Args:
        out: Folder of the run.
        draws: Samples of the run.
    """

    def __init__(self, out: Path, draws: DrawList) -> None:
        self.out, self.draws = out, draws
        # The key contains the digest of the episode, so no image of an earlier episode with this number is sent.
        self._thumbnail = lru_cache(THUMBNAILS)(lambda video, content, frame: encode_thumbnail(video, frame))

    def list_routes(self) -> dict[str, Route]:
        """Return all routes by method and path."""
        files = ("review.html", "review.css", "review.js", "episode.js", "plots.js", "map.js")
        return {
            "GET /review": send_file(PACKAGE, "review.html"),
            **{f"GET /{name}": send_file(PACKAGE, name) for name in files[1:]},
            "GET /review/draws": self.send_wall,
            "GET /review/draw": self.send_draw,
            "GET /review/thumbnail": self.send_thumbnail,
            "GET /review/video": self.send_video,
            "POST /review/change": self.change,
        }

    def send_wall(self, request: PageRequest) -> Response:
        """Send all samples with their reviews, unless the page has the current version."""
        asked = request.parse(WallRequest)
        reviews = read_reviews(self.out)
        content = {
            "run": self.out.name,
            "draws": [describe_draw(draw, reviews) for draw in self.draws.read()],
            "meanings": reasons(),
        }
        version = hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]
        return send_json({"version": version} if version == asked.version else content | {"version": version})

    def send_draw(self, request: PageRequest) -> Response:
        """Send the data of the page of one sample."""
        draw = self.draws.find(request.parse(ShownDrawRequest).number)
        committed = draw.outcome == "committed"
        slides = self._slides
        shown = describe_episode(self._folder(draw), slides) if committed else describe_rejected(draw, slides)
        return send_json(describe_draw(draw, read_reviews(self.out)) | shown)

    def send_thumbnail(self, request: PageRequest) -> Response:
        """Send the first or last image of an episode's first camera."""
        asked = request.parse(ThumbnailRequest)
        draw = self.draws.find(asked.number)
        if not draw.cameras:
            raise ValueError(f"draw {draw.number} has no images")
        video = self._folder(draw) / f"{draw.cameras[0]}.mp4"
        return Response("image/jpeg", self._thumbnail(video, draw.content, asked.frame))

    def send_video(self, request: PageRequest) -> Response:
        """Send one stored video of an episode."""
        asked = request.parse(VideoRequest)
        draw = self.draws.find(asked.number)
        if not 0 <= asked.camera < len(draw.cameras):
            raise ValueError(f"draw {draw.number} has no camera {asked.camera}")
        path = self._folder(draw) / f"{draw.cameras[asked.camera]}.mp4"
        return Response("video/mp4", path.read_bytes())

    def change(self, request: PageRequest) -> Response:
        """Store a decision, and send the stored review."""
        asked = request.parse(ChangeRequest)
        draw = self.draws.find(asked.number)
        return send_json(describe_review(change_review(self.out, self._folder(draw), asked.change)))

    @cached_property
    def _slides(self) -> list[int]:
        """Indices of the prismatic arm joints; all joints count as revolute where the capture cannot be read."""
        try:
            robot = results_of(find_project(self.out), STAGES).robot
        except AomgenError:
            return []
        return np.flatnonzero(robot.slides).tolist()

    def _folder(self, draw: Draw) -> Path:
        return episode_folder(self.draws.episodes, draw.number)


def list_review_routes(out: Path) -> dict[str, Route]:
    """List the routes of the pages "Review", "Coverage" and "Policies" of a run, finished or not."""
    folder = next(stage.folder for stage in STAGES if stage.name == "episodes")
    draws = DrawList(out, out / folder)
    pages = (ReviewRoutes(out, draws), CoverageRoutes(out, draws), PolicyRoutes(out))
    return {path: route for page in pages for path, route in page.list_routes().items()}


def describe_draw(draw: Draw, reviews: Mapping[int, Review]) -> dict[str, Any]:
    """Describe a sample for the overview of all samples."""
    review = reviews.get(draw.number, Review())
    valid = bool(draw.content) and review.content == draw.content
    return {
        "number": draw.number,
        "asset": draw.asset,
        "outcome": draw.outcome,
        "reason": draw.reason,
        "detail": draw.detail,
        "room": draw.room,
        "place": place_words(draw.variation) if draw.variation else "",
        **describe_review(review if valid else Review()),
    }


def describe_review(review: Review) -> dict[str, Any]:
    """Describe decision, tags and note."""
    return review.model_dump(exclude={"content"})
