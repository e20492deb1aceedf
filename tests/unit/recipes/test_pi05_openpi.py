"""The recipe for openpi: its names, the paper's numbers, and that it fits our datasets and our client."""

import os
import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aomgen.datasets.features import feature_names
from aomgen.evaluation.remote import open_remote
from drawer_episode import corner_camera, drawer_episode
from served_policies import msgpack_array, openpi_server
from vla_interfaces import (
    INTERFACES,
    RECIPES,
    REPOSITORY,
    flags_of,
    record_commands,
    stated_commands,
    write_stand_ins,
)

IMAGE = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
SCRIPTS = INTERFACES["openpi"]["scripts"]


def data_config(pi05):
    config = pi05.train_config()
    return config.data.create(None, config.model)


def test_settings_are_the_papers(pi05):
    config = pi05.train_config()
    assert (config.batch_size, config.num_train_steps) == (16, 30_000)
    schedule = config.lr_schedule
    assert type(schedule).__name__ == "CosineDecaySchedule"
    assert (schedule.peak_lr, schedule.warmup_steps, schedule.decay_steps) == (5e-5, 10_000, 30_000)
    assert schedule.decay_lr < schedule.peak_lr
    assert type(config.optimizer).__name__ == "AdamW"
    assert config.optimizer.clip_gradient_norm == 1.0
    assert config.model.action_horizon == 5
    assert config.model.pi05 is True
    assert config.freeze_filter == ("all but LoRA of", config.model)
    variants = config.model.paligemma_variant, config.model.action_expert_variant
    assert all(name in INTERFACES["openpi"]["variants"] and name.endswith("_lora") for name in variants)


def test_the_dataset_has_every_feature_that_is_repacked(pi05):
    episode = drawer_episode(0, np.zeros((3, 6)), np.zeros(3), {"front": corner_camera(8, 6)}, {}, {})
    features = {*feature_names(episode), *(f"observation.images.{name}" for name in episode.cameras)}
    data = data_config(pi05)
    (repack,) = data.repack_transforms.inputs
    # openpi makes the prompt of the dataset's task before it repacks, and keeps only what is repacked.
    assert data.prompt_from_task is True
    assert repack.structure.pop("prompt") == "prompt"
    images = repack.structure.pop("images")
    assert set(images) == set(pi05.CAMERAS)
    assert {*repack.structure.values(), *images.values()} <= features
    assert list(data.action_sequence_keys) == [repack.structure["actions"]]
    assert data.repo_id == pi05.REPO_ID


def test_pictures_of_the_dataset_and_of_the_evaluation_are_one(pi05):
    ours = {"images": {"front": IMAGE}, "state": np.zeros(7, np.float32), "prompt": "open"}
    lerobot = np.moveaxis(IMAGE, -1, 0).astype(np.float32) / 255
    actions = np.ones((5, 7), np.float32)
    seen = pi05.AomgenInputs()(ours)
    trained = pi05.AomgenInputs()({**ours, "images": {"front": lerobot}, "actions": actions})
    assert "actions" not in seen
    for inputs in (seen, trained):
        assert (
            list(inputs["image"])
            == INTERFACES["openpi"]["modules"]["openpi.models.model"]["constants"]["IMAGE_KEYS"]
        )
        np.testing.assert_array_equal(inputs["image"]["base_0_rgb"], IMAGE)
        assert inputs["image"]["left_wrist_0_rgb"].shape == IMAGE.shape
        assert not inputs["image"]["right_wrist_0_rgb"].any()
        assert list(inputs["image_mask"].values()) == [True, False, False]
        assert inputs["prompt"] == "open"
    trained["actions"] -= 1
    assert actions.all()


def test_more_cameras_than_the_model_has_are_refused(pi05, monkeypatch):
    monkeypatch.setattr(pi05, "CAMERAS", ("front", "a", "b", "c"))
    images = dict.fromkeys(pi05.CAMERAS, IMAGE)
    with pytest.raises(ValueError, match="zip"):
        pi05.AomgenInputs()({"images": images, "state": np.zeros(7)})


def test_joints_are_learned_as_differences_and_come_back(pi05):
    """`DeltaActions` takes the state off what its mask names, `AbsoluteActions` puts it back on the model's answer."""
    data = data_config(pi05)
    inputs, deltas = data.data_transforms.inputs
    absolutes, outputs = data.data_transforms.outputs
    assert [type(item).__name__ for item in (inputs, deltas)] == ["AomgenInputs", "DeltaActions"]
    assert [type(item).__name__ for item in (absolutes, outputs)] == ["AbsoluteActions", "AomgenOutputs"]
    assert deltas.mask == absolutes.mask == (True,) * 6 + (False,)
    random = np.random.default_rng(0)
    state, actions = random.normal(size=7), random.normal(size=(5, 7))
    offset = np.where(deltas.mask, state, 0)
    answer = np.pad(actions - offset, ((0, 0), (0, 25)))
    answer[:, :7] += offset
    np.testing.assert_allclose(outputs({"state": state, "actions": answer})["actions"], actions)


def test_our_client_and_the_recipe_speak_of_the_same(pi05):
    inputs = pi05.AomgenInputs()
    suite = SimpleNamespace(task="open the drawer", action_space="joint", cameras=("side", "front"))

    def answer(observation):
        seen = inputs(observation)
        assert seen["prompt"] == "open the drawer"
        np.testing.assert_array_equal(seen["image"]["base_0_rgb"], IMAGE)
        return {"actions": msgpack_array(np.tile(seen["state"], (pi05.HORIZON, 1)))}

    with openpi_server(answer, pi05.train_config().policy_metadata) as served:
        policy = open_remote(f"openpi://{served.address}", suite, None)
        measured = np.arange(7, dtype=np.float32)
        action = policy.act({"pixels": {"side": 255 - IMAGE, "front": IMAGE}, "agent_pos": measured})
    np.testing.assert_array_equal(action, measured)


SCRIPT = """
import multiprocessing, sys
from concurrent.futures import ProcessPoolExecutor
from openpi.training.config import _CONFIGS_DICT

if __name__ == "__main__":
    config = _CONFIGS_DICT["pi05_aomgen"]
    inputs = config.data.create(None, config.model).data_transforms.inputs[0]
    # Reports a process that cannot start; a `Pool` would start another one without end.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        print(*sys.argv, pool.submit(type, inputs).result().__module__)
"""


def test_openpis_scripts_are_run_with_the_config_and_their_processes_find_its_classes(tmp_path):
    write_stand_ins(tmp_path, "openpi")
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, RECIPES / "pi05_openpi.py", "script.py", "pi05_aomgen", "--exp-name", "opening"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        # A second alone; far more where other programs keep the processors busy, [s].
        timeout=300,
    )
    assert done.stderr == ""
    assert done.stdout.split() == ["script.py", "pi05_aomgen", "--exp-name", "opening", "pi05_openpi"]


def test_configs_are_pickled(pi05):
    data = data_config(pi05)
    assert pickle.loads(pickle.dumps(data.data_transforms)) == data.data_transforms


def check(command: list[str]) -> None:
    script = next(word for word in command if word in SCRIPTS)
    assert set(flags_of(command)) <= set(SCRIPTS[script])


def test_commands_have_openpis_flags(pi05, tmp_path):
    calls = record_commands("pi05_openpi.sh", [], "uv", tmp_path, HF_LEROBOT_HOME=str(tmp_path))
    assert [call[2] for call in calls] == ["scripts/compute_norm_stats.py", "scripts/train.py"]
    for call in calls:
        check(call)
        assert pi05.NAME in call
        assert (tmp_path / call[1]).resolve() == RECIPES / "pi05_openpi.py"
    stated = stated_commands((REPOSITORY / "docs/vla.md").read_text("utf-8"), "scripts/serve_policy.py")
    assert len(stated) == 1
    check(stated[0])


def test_without_a_dataset_nothing_is_started(tmp_path):
    environment = {key: value for key, value in os.environ.items() if key != "HF_LEROBOT_HOME"}
    done = subprocess.run(
        ["sh", RECIPES / "pi05_openpi.sh"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode != 0
    assert "the folder that holds aomgen/opening" in done.stderr
    assert list(Path(tmp_path).iterdir()) == []
