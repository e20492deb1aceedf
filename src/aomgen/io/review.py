"""Decisions of a person on the episodes of a run, in one small file: `review.json` in the run's folder.

A decision applies to the content of an episode. If the run has since generated another episode with the same number,
the decision is ignored.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, StringConstraints, ValidationError

from aomgen.errors import ConfigError, MalformedFileError
from aomgen.io.artifact import read_json
from aomgen.io.atomic import lock_folder, write_json
from aomgen.io.episode_folder import EPISODE_FILE
from aomgen.io.schema import complaint

REVIEW_FILE: Final = "review.json"
# Longest note and longest tag, [characters].
MAX_NOTE, MAX_TAG = 2000, 40

Decision = Literal["", "accepted", "rejected"]
Tag = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=MAX_TAG)]
Note = Annotated[str, StringConstraints(strip_whitespace=True, max_length=MAX_NOTE)]


class Review(BaseModel):
    """Decision of a person about one episode.

    Attributes:
        content: Digest of the reviewed episode; see `read_content`.
        decision: Decision; empty until the person has decided.
        tags: Sorted tags.
        note: Free text.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    content: str = ""
    decision: Decision = ""
    tags: tuple[Tag, ...] = ()
    note: Note = ""

    def merge(self, change: "ReviewChange", content: str) -> "Review":
        """Return the review after a change; if `content` differs from the reviewed one, the change starts from an empty review."""
        old = self if self.content == content else Review()
        return Review(
            content=content,
            decision=old.decision if change.decision is None else change.decision,
            tags=tuple(sorted((set(old.tags) | set(change.add_tags)) - set(change.remove_tags))),
            note=old.note if change.note is None else change.note,
        )


class ReviewChange(BaseModel):
    """Change of one episode's review; None leaves the decision or the note unchanged."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    decision: Decision | None = None
    add_tags: tuple[Tag, ...] = ()
    remove_tags: tuple[Tag, ...] = ()
    note: Note | None = None


class _ReviewFile(BaseModel):
    model_config = ConfigDict(extra="forbid")

    episodes: dict[str, Review] = {}


def read_reviews(out: Path) -> dict[int, Review]:
    """Read the reviews of a run by episode number; the result is empty if the run has no review file.

    Raises:
        MalformedFileError: The file is damaged.
    """
    path = out / REVIEW_FILE
    if not path.is_file():
        return {}
    try:
        stored = _ReviewFile.model_validate(read_json(path))
        return {int(number): review for number, review in stored.episodes.items()}
    except ValidationError as error:
        problem, _ = complaint(error, _ReviewFile)
        raise MalformedFileError(path, problem, _remedy(path)) from error
    except ValueError as error:
        raise MalformedFileError(path, f"names no episode ({error})", _remedy(path)) from error
    except MalformedFileError as error:
        raise MalformedFileError(path, error.problem, _remedy(path)) from error


def change_review(out: Path, episode_folder: Path, change: ReviewChange) -> Review:
    """Change the review of one episode on disk; concurrent changes by several processes are all kept.

    Args:
        out: Folder of the run.
        episode_folder: Folder of the committed episode.
        change: Decision of the person.

    Returns:
        The review after the change.

    Raises:
        MissingFileError, MalformedFileError: The episode or the review file cannot be read; nothing is written.
        StorageError: Writing to the disk failed.
    """
    number, content = int(episode_folder.name), read_content(episode_folder)
    with lock_folder(out):
        reviews = read_reviews(out)
        reviews[number] = reviews.get(number, Review()).merge(change, content)
        stored = {f"{key:06d}": review.model_dump() for key, review in reviews.items()}
        write_json(out / REVIEW_FILE, {"episodes": stored})
    return reviews[number]


def read_content(episode_folder: Path) -> str:
    """Read the digest that identifies an episode in a review: the SHA-256 of its `frames.npz`.

    That file holds the per-frame arrays and the color statistics of the videos.

    Raises:
        MissingFileError, MalformedFileError: episode.json cannot be read.
    """
    path = episode_folder / EPISODE_FILE
    return content_of(read_json(path), path)


def content_of(header: Any, path: Path) -> str:
    """Return the digest of `read_content` from `header`, the parsed content of the episode.json at `path`.

    Raises:
        MalformedFileError: The header holds no digest of `frames.npz`.
    """
    try:
        return str(header["sha256"]["frames.npz"])
    except (TypeError, KeyError) as error:
        raise MalformedFileError(path, "holds no digests", "generate the episode again") from error


def leave_out_rejected(out: Path, episode_folders: Sequence[Path]) -> list[Path]:
    """Return the episodes that no review rejects, in their order.

    Args:
        out: Folder of the run.
        episode_folders: Folders of committed episodes.

    Raises:
        MalformedFileError: The review file is damaged.
        ConfigError: All episodes are rejected.
    """
    rejected = {number: item for number, item in read_reviews(out).items() if item.decision == "rejected"}
    kept = [
        folder
        for folder in episode_folders
        if int(folder.name) not in rejected or rejected[int(folder.name)].content != read_content(folder)
    ]
    if episode_folders and not kept:
        raise ConfigError(
            out / REVIEW_FILE,
            f"rejects all {len(episode_folders)} episodes",
            f"accept some of them in `aomgen view {out}`",
        )
    return kept


def _remedy(path: Path) -> str:
    return f"correct it, or delete {path.name} and with it all decisions"
