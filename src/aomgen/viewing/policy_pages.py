"""Policies in the trials of a suite: results side by side, and the first difference between two policies."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.api.evaluation import EVALUATION_FOLDER
from aomgen.core.values import Array
from aomgen.errors import InputError, MalformedFileError
from aomgen.evaluation.evaluate import (
    ROLLOUTS_FOLDER,
    VIDEOS_FOLDER,
    EvaluationRequest,
    RolloutRecord,
    interval_95,
)
from aomgen.evaluation.suite import Suite, read_suite
from aomgen.io.artifact import load_artifact, read_json
from aomgen.report.episodes import place_words, reasons
from aomgen.saved_units import REQUEST_FILE, unit_name
from aomgen.viewing.draw_page import DIGITS
from aomgen.web.page_server import PageRequest, RequestFields, Response, Route, send_file, send_json

# Two trials differ if the end effectors are this far apart, [mm], or the shares of the planned travel differ this much.
# Both are above the effect of other images of the same scene on the actions of a policy.
APART_MM, APART_SHARE = 10.0, 0.02
# First characters of the file of a suite; other files next to a run may be large.
_SUITE_HEAD, _HEAD_BYTES = '"type": "Suite"', 40


class ShownSuiteRequest(RequestFields):
    """Request of one suite by its number in the list of all suites."""

    suite: int


class TrialRequest(RequestFields):
    """Request of one trial of two policies by their numbers in the list of the suite."""

    suite: int
    trial: int
    first: int
    second: int


class FailureRequest(RequestFields):
    """Request of the video of a failed trial of a policy."""

    suite: int
    policy: int
    trial: int


# Stored evaluation of a policy: folder of its rollouts and videos, request, and records of the finished trials by number.
Evaluation = tuple[Path, EvaluationRequest, Mapping[int, RolloutRecord]]


class PolicyRoutes:
    """Routes of the policies that were evaluated in the run of a folder."""

    def __init__(self, out: Path) -> None:
        self.out = out

    def list_routes(self) -> dict[str, Route]:
        """Return all routes by method and path."""
        return {
            "GET /policies": send_file("aomgen.viewing", "policies.html"),
            "GET /policies.js": send_file("aomgen.viewing", "policies.js"),
            "GET /policies/suites": self.send_suites,
            "GET /policies/suite": self.send_suite,
            "GET /policies/trial": self.send_trial,
            "GET /policies/video": self.send_video,
        }

    def send_suites(self, request: PageRequest) -> Response:
        """Send the names of all suites of the run, their numbers of policies, and messages about damaged files."""
        suites, problems = find_suites(self.out)
        shown = [
            {"name": path.stem, "trials": len(suite.trials), "policies": len(find_evaluations(path, suite))}
            for path, suite in suites
        ]
        return send_json({"suites": shown, "problems": problems})

    def send_suite(self, request: PageRequest) -> Response:
        """Send all trials of a suite and the results of all policies."""
        suite, found = self._find(request.parse(ShownSuiteRequest).suite)
        return send_json(
            {
                "trials": [
                    {
                        "asset": suite.assets[trial.asset],
                        "place": place_words(asdict(trial.variation)),
                        "setting": trial.setting.name,
                    }
                    for trial in suite.trials
                ],
                "policies": [_describe_policy(asked, records) for _, asked, records in found],
                "meanings": reasons(),
            }
        )  # fmt: skip

    def send_trial(self, request: PageRequest) -> Response:
        """Send the values of two policies over one trial, and their first difference."""
        asked = request.parse(TrialRequest)
        suite, found = self._find(asked.suite)
        chosen = [_choose(found, number) for number in (asked.first, asked.second)]
        records = [stored.get(asked.trial) for _, _, stored in chosen]
        first, second = records
        both = (first, second) if first is not None and second is not None else None
        return send_json(
            {
                "fps": suite.fps,
                "courses": [_describe_course(record) for record in records],
                "filmed": [_video_file(folder, asked.trial).is_file() for folder, _, _ in chosen],
                "apart_mm": distances_mm(*both).round(2).tolist() if both else [],
                "differs": first_difference(*both) if both else None,
            }
        )

    def send_video(self, request: PageRequest) -> Response:
        """Send the video of a failed trial."""
        asked = request.parse(FailureRequest)
        folder, _, _ = _choose(self._find(asked.suite)[1], asked.policy)
        path = _video_file(folder, asked.trial)
        if not path.is_file():
            raise ValueError(f"trial {asked.trial} has no video")
        return Response("video/mp4", path.read_bytes())

    def _find(self, number: int) -> tuple[Suite, list[Evaluation]]:
        suites, _ = find_suites(self.out)
        if not 0 <= number < len(suites):
            raise ValueError(f"there is no suite {number}")
        path, suite = suites[number]
        return suite, find_evaluations(path, suite)


def find_suites(out: Path) -> tuple[list[tuple[Path, Suite]], list[str]]:
    """Find the suites in a run's folder of evaluations and next to the run, and list damaged suites in sentences."""
    places = (out / EVALUATION_FOLDER, out.resolve().parent)
    suites, problems = [], []
    for path in (path for place in places for path in sorted(place.glob("*.json")) if _is_suite(path)):
        try:
            suite = read_suite(path)
        except InputError as error:
            problems.append(str(error))
            continue
        if (path.parent / suite.run).resolve() == out.resolve():
            suites.append((path, suite))
    return suites, problems


def find_evaluations(path: Path, suite: Suite) -> list[Evaluation]:
    """Find the evaluations of a suite whose folders are next to its file, by name."""
    found = []
    for place in sorted(path.parent.glob(f"*/{ROLLOUTS_FOLDER}/{REQUEST_FILE}")):
        request = read_json(place)
        if not isinstance(request, dict) or request.get("suite") != suite.digest:
            continue
        try:
            asked = EvaluationRequest(
                policy=request["policy"],
                visuals=request["visuals"],
                action_space=request["action_space"] or suite.action_space,
            )
        except KeyError as error:
            raise MalformedFileError(place, f"lacks {error}", "evaluate the policy again") from error
        numbers = sorted(int(file.stem) for file in place.parent.glob("[0-9]*.json"))
        records = {k: load_artifact(place.parent, unit_name(k), RolloutRecord) for k in numbers}
        found.append((place.parent.parent, asked, records))
    return found


def distances_mm(first: RolloutRecord, second: RolloutRecord) -> Array:
    """Compute the distances between the end effectors after each action of both trials (F,), [mm]."""
    count = min(first.frames, second.frames)
    return 1000 * np.linalg.norm(first.ee_world[:count] - second.ee_world[:count], axis=1)


def first_difference(first: RolloutRecord, second: RolloutRecord) -> dict[str, Any] | None:
    """Describe the first action after which two trials differ, see `APART_MM`; None if they do not differ."""
    apart_mm = distances_mm(first, second)
    count = len(apart_mm)
    openings = first.opening_shares[:count] - second.opening_shares[:count]
    differing = np.flatnonzero((apart_mm > APART_MM) | (np.abs(openings) > APART_SHARE))
    if len(differing):
        frame = int(differing[0])
        return {"frame": frame, "mm": float(apart_mm[frame]), "opening": float(openings[frame])}
    if first.fail_reason != second.fail_reason:
        return {"frame": count - 1, "mm": float(apart_mm[-1]), "opening": float(openings[-1])}
    return None


def _is_suite(path: Path) -> bool:
    with path.open("rb") as file:
        return _SUITE_HEAD in file.read(_HEAD_BYTES).decode("utf-8", "replace")


def _choose(found: list[Evaluation], number: int) -> Evaluation:
    if not 0 <= number < len(found):
        raise ValueError(f"there is no policy {number}")
    return found[number]


def _video_file(folder: Path, trial: int) -> Path:
    return folder / VIDEOS_FOLDER / f"{unit_name(trial)}.mp4"


def _describe_policy(asked: EvaluationRequest, records: Mapping[int, RolloutRecord]) -> dict[str, Any]:
    failures = Counter(record.fail_reason for record in records.values() if record.fail_reason)
    successes = len(records) - failures.total()
    return {
        "name": asked.policy,
        "sees": f"{asked.visuals}, {asked.action_space}",
        "done": len(records),
        "successes": successes,
        "interval": interval_95(successes, len(records)) if records else [0.0, 1.0],
        "failures": dict(failures.most_common()),
        "trials": {number: _describe_result(record) for number, record in records.items()},
    }


def _describe_result(record: RolloutRecord) -> dict[str, Any]:
    return {
        "fail_reason": record.fail_reason,
        "opening": round(record.opening_share, DIGITS),
        "frames": record.frames,
    }


def _describe_course(record: RolloutRecord | None) -> dict[str, Any] | None:
    if record is None:
        return None
    return _describe_result(record) | {"openings": record.opening_shares.round(DIGITS).tolist()}
