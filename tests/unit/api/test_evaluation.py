"""Names of the files of `ag.evaluate`."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import aomgen as ag
from aomgen.api import evaluation


def test_every_image_size_has_its_own_suite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run: Any = SimpleNamespace(require_stage=lambda name: None, results=SimpleNamespace(workers=1))
    suites, rollouts = list[Path](), list[Path]()
    monkeypatch.setattr(evaluation, "make_suite", lambda results, path, *_: suites.append(path))
    monkeypatch.setattr(evaluation, "evaluate_policy", lambda suite, results, out, *_: rollouts.append(out))
    for size in (None, (64, 48), (128, 96)):
        ag.evaluate(run, "oracle_replay", trials=9, size=size, out=tmp_path)
    assert [path.name for path in suites] == [
        "9-1-joint.json",
        "9-1-joint-64x48.json",
        "9-1-joint-128x96.json",
    ]
    assert len(set(rollouts)) == 3
