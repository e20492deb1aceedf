"""The recipe for lerobot: the paper's numbers, and flags that lerobot's own classes read."""

import json
import os
import re
import subprocess

import pytest

from vla_interfaces import INTERFACES, RECIPES, REPOSITORY, flags_of, record_commands

PYTHON = REPOSITORY / ".venv-policy/bin/python"
FLAGS = REPOSITORY / "tests/readers/lerobot_train_flags.py"
IMAGE_KEYS = INTERFACES["openpi"]["modules"]["openpi.models.model"]["constants"]["IMAGE_KEYS"]


def recipe(folder) -> dict[str, str]:
    (call,) = record_commands("pi05_lerobot.sh", ["out/dataset", "runs"], "lerobot-train", folder)
    return flags_of(call)


def test_settings_are_the_papers(tmp_path):
    flags = recipe(tmp_path)
    wanted = {
        "--policy.path": "lerobot/pi05_base",
        "--dataset.root": "out/dataset",
        "--output_dir": "runs/pi05_aomgen",
        "--batch_size": "16",
        "--steps": "30000",
        "--policy.optimizer_lr": "5e-5",
        "--policy.optimizer_grad_clip_norm": "1.0",
        "--policy.scheduler_warmup_steps": "10000",
        "--policy.scheduler_decay_steps": "30000",
        "--policy.chunk_size": "5",
        "--policy.dtype": "bfloat16",
        "--peft.method_type": "LORA",
    }
    assert {key: flags.get(key) for key in wanted} == wanted


def test_cameras_get_the_names_of_the_checkpoint(tmp_path):
    renamed = json.loads(recipe(tmp_path)["--rename_map"])
    prefix = "observation.images."
    assert set(renamed.values()) <= {prefix + key for key in IMAGE_KEYS}
    assert all(name.startswith(prefix) for name in renamed)


@pytest.mark.parametrize(
    ("layer", "adapted"),
    [
        ("model.paligemma_with_expert.paligemma.model.language_model.layers.0.self_attn.q_proj", True),
        ("model.paligemma_with_expert.paligemma.model.language_model.layers.17.mlp.down_proj", True),
        ("model.paligemma_with_expert.gemma_expert.model.layers.3.mlp.gate_proj", True),
        ("model.paligemma_with_expert.paligemma.model.vision_tower.encoder.layers.0.self_attn.q_proj", False),
        ("model.action_in_proj", False),
    ],
)
def test_both_language_models_are_adapted(tmp_path, layer, adapted):
    assert bool(re.fullmatch(recipe(tmp_path)["--peft.target_modules"], layer)) is adapted


def test_without_a_dataset_nothing_is_started(tmp_path):
    done = subprocess.run(["sh", RECIPES / "pi05_lerobot.sh"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode != 0
    assert "DATASET" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON.exists(), reason="needs the real lerobot: make policy-env")
def test_lerobots_own_classes_read_the_command(tmp_path):
    stand_in = tmp_path / "lerobot-train"
    stand_in.write_text(f'#!/bin/sh\nexec "{PYTHON}" "{FLAGS}" "$@"\n', "utf-8")
    stand_in.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(
        ["sh", RECIPES / "pi05_lerobot.sh", "out/dataset", "runs"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["type"] == "pi05"
    assert report["policy"] == {"chunk_size": 5, "n_action_steps": 5, "dtype": "bfloat16"}
    assert (report["steps"], report["batch_size"]) == (30_000, 16)
    assert report["optimizer"]["kind"] == "AdamWConfig"
    assert (report["optimizer"]["lr"], report["optimizer"]["grad_clip_norm"]) == (5e-5, 1.0)
    assert report["scheduler"]["kind"] == "CosineDecayWithWarmupSchedulerConfig"
    scheduler = {key: report["scheduler"][key] for key in ("num_warmup_steps", "num_decay_steps", "decay_lr")}
    assert scheduler == {"num_warmup_steps": 10_000, "num_decay_steps": 30_000, "decay_lr": 5e-6}
    assert report["rename_map"] == {"observation.images.front": "observation.images.base_0_rgb"}
    assert (report["peft"]["method_type"], report["peft"]["r"]) == ("LORA", 16)
    # Layers that are trained as a whole are layers of the model.
    assert report["layers"] == report["peft"]["full_training_modules"] != []
