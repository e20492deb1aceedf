"""Every capture of a corpus is accounted for, whatever happens to its worker."""

import importlib.util
import json
import os
from functools import partial
from pathlib import Path

import pytest

from aomgen.api import corpus
from aomgen.api.corpus import CORPUS_FILE, open_corpus, run_corpus
from aomgen.errors import InputError
from aomgen.executors import Executor, Processes
from aomgen.io.atomic import write_json
from aomgen.pipeline.manifest import MANIFEST
from aomgen.ray_cluster import RayCluster
from command_line import aomgen, one_sentence
from corpus_work import InThisProcess, open_stub

HELPERS = Path(__file__).parents[2] / "helpers"
NAMES = ("fails", "kills-always", "kills-once", "microwave", "window")
LIMIT_S = 300.0


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    for name in NAMES:
        (tmp_path / "captures" / name).mkdir(parents=True)
        (tmp_path / "captures" / name / "capture.toml").touch()
    (tmp_path / "captures" / "notes").mkdir()
    return tmp_path / "captures"


def check_rows(captures: Path, out: Path, executor: Executor) -> None:
    told: list[str] = []
    rows = run_corpus(captures, out, executor, lambda name, row: told.append(name))
    assert sorted(told) == sorted(rows) == sorted(NAMES)
    assert {name: row["state"] for name, row in rows.items()} == {
        "fails": "failed",
        "kills-always": "failed",
        "kills-once": "done",
        "microwave": "done",
        "window": "done",
    }
    assert rows["fails"]["error"] == "demo/joints.csv: is missing"
    assert rows["kills-always"]["error"] == "the process that worked on it died repeatedly"
    assert json.loads((out / CORPUS_FILE).read_text())["captures"] == rows


def test_every_capture_is_accounted_for(captures, tmp_path):
    out = tmp_path / "out"
    check_rows(captures, out, Processes(partial(open_stub, out), 2, LIMIT_S))


@pytest.mark.slow
def test_every_capture_is_accounted_for_on_ray(captures, tmp_path, monkeypatch):
    if importlib.util.find_spec("ray") is None:
        pytest.skip("ray is not installed")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(HELPERS), os.environ.get("PYTHONPATH", "")]))
    out = tmp_path / "out"
    check_rows(captures, out, RayCluster(partial(open_stub, out), "local", LIMIT_S))


def test_an_interrupted_corpus_lists_what_is_waiting(captures, tmp_path):
    def stop(name: str, row: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_corpus(captures, tmp_path, InThisProcess(lambda: lambda name: ""), stop)
    rows = json.loads((tmp_path / CORPUS_FILE).read_text())["captures"]
    assert [rows[name]["state"] for name in NAMES] == ["done", *["waiting"] * 4]


def test_a_row_has_the_metrics_of_the_stages(captures, tmp_path):
    def work(name: str) -> str:
        for folder, figures in (
            ("02_gaussians", {"heldout_psnr": 30.25}),
            ("05_motion", {"joint": "revolute", "axis_ci95_deg": 0.5}),
        ):
            manifest = {"stage": folder, "version": 1, "inputs": {}, "parameters": {}, "files": {}}
            write_json(
                tmp_path / name / folder / MANIFEST, manifest | {"figures": figures, "warnings": ["dark"]}
            )
        return ""

    rows = run_corpus(captures, tmp_path, InThisProcess(lambda: work), lambda name, row: None)
    assert rows["window"] == {
        "state": "done",
        "error": "",
        "stage": "motion",
        "warnings": 2,
        "psnr_db": 30.25,
        "joint": "revolute",
        "axis_ci95_deg": 0.5,
    }


def test_an_error_of_a_capture_becomes_its_message(captures, tmp_path, small_copy, monkeypatch):
    work = open_corpus(captures, tmp_path / "out", "", ())
    assert "capture.toml" in work("window")
    (tmp_path / "captures" / "small").symlink_to(small_copy)
    asked = []

    def refuse(project, **options):
        asked.append((project.out, options))
        raise InputError("scan", "is dark", "add light")

    monkeypatch.setattr(corpus, "bring_up_to_date", refuse)
    work = open_corpus(captures, tmp_path / "out", "twin", ("original",))
    assert work("small") == "scan: is dark; add light"
    assert asked == [(tmp_path / "out" / "small", {"until": "twin", "progress": False, "workers": 1})]


def test_the_command_prints_a_table_and_ends_with_an_exit_code(captures, tmp_path, monkeypatch):
    monkeypatch.setattr("aomgen.executors.Processes", InThisProcess)
    monkeypatch.setattr(
        corpus, "_run_capture", lambda captures, out, until, assets, name: open_stub(out)(name)
    )
    for name in ("kills-always", "kills-once"):
        (captures / name / "capture.toml").unlink()
    result = aomgen("corpus", "captures", "out", folder=tmp_path)
    one_sentence(
        result, 1, "out/corpus.json: lists 1 of 3 captures that failed", "run the same command again"
    )
    lines = result.stdout.splitlines()
    assert lines[:3] == [
        "  failed  fails: demo/joints.csv: is missing",
        "  done    microwave",
        "  done    window",
    ]
    assert lines[3].split() == [
        "capture",
        "state",
        "stage",
        "warnings",
        "psnr_db",
        "joint",
        "axis_ci95_deg",
        "episodes",
    ]
    assert lines[4].split() == ["fails", "failed", *"------"]
    (captures / "fails" / "capture.toml").unlink()
    assert aomgen("corpus", "captures", "out", folder=tmp_path).returncode == 0


def test_a_folder_without_captures_or_an_unknown_stage_is_refused(captures, tmp_path):
    one_sentence(aomgen("corpus", tmp_path, "out", folder=tmp_path), 3, "has no capture", "capture.toml")
    words = ("corpus", "captures", "out", "--until", "twinn")
    one_sentence(aomgen(*words, folder=tmp_path), 2, "did you mean 'twin'?")
    assert not (tmp_path / "out").exists()
