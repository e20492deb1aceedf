"""The unchanged LeRobot trains our small policy on a run's dataset and evaluates it in the run's twin.

It lives in .venv-policy; `make datasets-test` creates it, and names the EPISODES of a finished run.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

BIN = Path(__file__).parents[2] / ".venv-policy" / "bin"
STEPS, TRIALS = 3, 2
pytestmark = pytest.mark.slow


def call(tmp_path: Path, program: str, *words: str) -> None:
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [BIN / program, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


def evaluate(tmp_path: Path, suite: str = "suite.json") -> dict[str, Any]:
    words = ("evaluate", suite, "--policy", "lerobot:trained", "--workers", "1", "--json", "ours.json")
    call(tmp_path, "aomgen", *words)
    return json.loads((tmp_path / "ours.json").read_text())


def train(tmp_path: Path, *policy: str) -> None:
    call(
        tmp_path,
        "lerobot-train",
        *policy,
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=local/opening",
        "--dataset.root=dataset",
        "--output_dir=trained",
        f"--steps={STEPS}",
        f"--save_freq={STEPS}",
        "--batch_size=4",
        "--num_workers=0",
        "--wandb.enable=false",
        "--eval_freq=0",
    )


@pytest.mark.parametrize("part", ["small_act", "finder", "handle_act", "handle_plan"])
def test_a_part_of_the_plugin_keeps_its_laws(part: str) -> None:
    if not (BIN / "python").is_file():
        pytest.skip("needs .venv-policy: make policy-env")
    script = Path(__file__).with_name(f"{part}_laws.py")
    done = subprocess.run([BIN / "python", script], capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr[-4000:]


def test_lerobot_trains_and_evaluates(tmp_path: Path) -> None:
    if "EPISODES" not in os.environ or not (BIN / "lerobot-train").is_file():
        pytest.skip("needs a finished run and .venv-policy: make datasets-test")
    run, size = str(Path(os.environ["EPISODES"]).parent), ("--size", "96x96")
    call(tmp_path, "aomgen", "evaluate", "suite", run, "suite.json", "--trials", str(TRIALS), *size)
    call(tmp_path, "aomgen", "export", run, "dataset", "--format", "lerobot-v3", "--media", "image", *size)
    train(tmp_path, "--policy.type=small_act")
    call(
        tmp_path,
        "lerobot-eval",
        "--policy.path=trained/checkpoints/last/pretrained_model",
        "--policy.device=cpu",
        "--env.type=aomgen",
        "--env.suite=suite.json",
        f"--eval.n_episodes={TRIALS}",
        "--eval.batch_size=1",
        "--output_dir=evaluated",
    )
    theirs = json.loads((tmp_path / "evaluated" / "eval_info.json").read_text())["overall"]
    assert theirs["n_episodes"] == TRIALS
    ours = evaluate(tmp_path)
    # Three steps teach nothing, and both judges say so.
    assert np.isclose(theirs["pc_success"], 0.0)
    assert ours["successes"] == 0
    assert ours["trials"] == TRIALS


def test_a_policy_with_a_finder_is_trained_and_evaluated(tmp_path: Path) -> None:
    if "EPISODES" not in os.environ or not (BIN / "lerobot-train").is_file():
        pytest.skip("needs a finished run and .venv-policy: make datasets-test")
    run, poses = str(Path(os.environ["EPISODES"]).parent), ("--actions", "ee_absolute")
    size = ("--size", "96x96")
    call(tmp_path, "aomgen", "evaluate", "suite", run, "suite.json", "--trials", str(TRIALS), *poses, *size)
    words = ("--format", "lerobot-v3", "--media", "keypoints", *poses)
    call(tmp_path, "aomgen", "export", run, "dataset", *words)
    images = ("--format", "images", "--n", "12", "--per-object", "12", "--workers", "1", *size)
    call(tmp_path, "aomgen", "export", run, "images", *images)
    finder = ("images", "finder", "--validation", "images", "--steps", "1", "--from-scratch", "--crop", "48")
    call(tmp_path, "python", "-m", "lerobot_policy_aomgen.train_finder", *finder)
    located = ("--policy.finder=finder/finder.safetensors", "--policy.suite=suite.json")
    train(tmp_path, "--policy.type=handle_act", *located)
    ours = evaluate(tmp_path)
    assert (ours["trials"], ours["successes"]) == (TRIALS, 0)
    # One step teaches a finder nothing, which its errors show.
    assert ours["finder_error_mm"]["grasp"]["median_mm"] > 20
    assert ours["finder_error_mm"]["grasp"]["number"] >= TRIALS
    call(tmp_path, "aomgen", "evaluate", "suite", run, "joint.json", "--trials", str(TRIALS), *size)
    create = ("-m", "lerobot_policy_aomgen.create_handle_plan", "joint.json", "trained")
    create = (*create, "--library", run, "finder/finder.safetensors", "--known", "1")
    shutil.rmtree(tmp_path / "trained")
    words = [BIN / "python", *create, "--cameras", "front", "nowhere"]
    refused = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (refused.returncode, (tmp_path / "trained").exists()) == (2, False)
    assert "cameras ['nowhere'] are unknown" in refused.stderr
    call(tmp_path, "python", *create)
    planned = evaluate(tmp_path, "joint.json")
    assert (planned["trials"], planned["finder_error_mm"]["grasp"]["number"]) == (TRIALS, TRIALS)
