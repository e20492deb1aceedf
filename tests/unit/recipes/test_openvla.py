"""The recipes for OpenVLA and OpenVLA-OFT: their names, the paper's numbers, and that they fit our RLDS datasets."""

import os
import subprocess
import sys

import numpy as np
import pytest

from aomgen.evaluation.remote import OPENVLA_ACTION, OPENVLA_JOINTS
from vla_interfaces import (
    INTERFACES,
    RECIPES,
    REPOSITORY,
    constants_by_words,
    flags_of,
    record_commands,
    stated_commands,
    write_stand_ins,
)

FINETUNE, DEPLOY = "vla-scripts/finetune.py", "vla-scripts/deploy.py"
# Folders whose names OpenVLA-OFT would take for a robot's.
DATA, RUNS = "data/bridge", "runs/aloha"


def trajectory(space: str) -> dict:
    """Steps of an RLDS dataset whose action is the space, see docs/datasets.md: OpenVLA reads images undecoded."""
    random, sizes = np.random.default_rng(0), {"joint": 7, "ee_absolute": 8, "ee_delta": 7}
    return {
        "observation": {
            "front": np.array([b"jpeg"] * 3),
            "state": random.normal(size=(3, 8)).astype(np.float32),
        },
        "action": random.normal(size=(3, sizes[space])).astype(np.float32),
        "annotation": {
            "action": {name: np.zeros((3, size)) for name, size in sizes.items() if name != space},
            "ee_pose": np.zeros((3, 7)),
        },
        "language_instruction": np.array([b"open the microwave"] * 3),
        "reward": np.array([0, 0, 1], np.float32),
    }


def test_the_entry_has_the_keys_of_the_registrys_own(oxe, request):
    library = INTERFACES[request.node.callspec.params["oxe"]]
    known = library["modules"]["prismatic.vla.datasets.rlds.oxe.configs"]["constants"]["OXE_DATASET_CONFIGS"][
        "bridge_orig"
    ]
    entry = oxe.dataset_config()
    assert list(entry) == list(known)
    for key in ("image_obs_keys", "depth_obs_keys"):
        assert list(entry[key]) == list(known[key])
    # The motion is normalized, the gripper is not; a state of seven joints and the gripper.
    assert entry["action_encoding"].name == "EEF_POS"
    assert entry["state_encoding"].name == "JOINT"


def test_our_steps_are_in_openvlas_form(oxe):
    entry, steps = oxe.dataset_config(), trajectory("ee_delta")
    standard = oxe.standardize(steps)
    assert set(standard) == {"observation", "action", "language_instruction"}
    assert standard["action"].shape == (3, OPENVLA_ACTION)
    np.testing.assert_array_equal(standard["action"], steps["action"])
    wanted = [*filter(None, entry["image_obs_keys"].values()), *entry["state_obs_keys"]]
    assert set(wanted) <= set(standard["observation"])
    proprio = np.concatenate([standard["observation"][key] for key in entry["state_obs_keys"]], axis=1)
    assert proprio.shape == (3, OPENVLA_JOINTS + 1)


@pytest.mark.parametrize("space", ["joint", "ee_absolute"])
def test_other_action_spaces_are_refused(oxe, space):
    with pytest.raises(ValueError, match="action is not ee_delta; export it without --actions"):
        oxe.standardize(trajectory(space))


SCRIPT = """
import sys
from prismatic.vla.datasets.rlds.oxe.configs import OXE_DATASET_CONFIGS
from prismatic.vla.datasets.rlds.oxe.transforms import OXE_STANDARDIZATION_TRANSFORMS

if __name__ == "__main__":
    name = sys.argv[2]
    print(*sys.argv, OXE_DATASET_CONFIGS[name]["state_obs_keys"][0], OXE_STANDARDIZATION_TRANSFORMS[name].__name__)
"""


def test_scripts_are_run_with_the_dataset_in_the_registry(tmp_path):
    write_stand_ins(tmp_path, "openvla")
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, RECIPES / "openvla/aomgen_oxe.py", "script.py", "--dataset_name", "opening"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stderr == ""
    assert done.stdout.split() == ["script.py", "--dataset_name", "opening", "state", "standardize"]


def finetune(library: str, folder) -> tuple[list[str], dict[str, str]]:
    """The words after the script, and its flags."""
    (call,) = record_commands(f"{library}/finetune.sh", [DATA, RUNS], "torchrun", folder)
    words = call[call.index(FINETUNE) :]
    launcher = (folder / call[call.index(FINETUNE) - 1]).resolve()
    assert launcher == RECIPES / "openvla/aomgen_oxe.py"
    return words, flags_of(words)


@pytest.mark.parametrize("library", ["openvla", "openvla_oft"])
def test_commands_have_the_flags_of_the_scripts(library, tmp_path):
    scripts = INTERFACES[library]["scripts"]
    _, flags = finetune(library, tmp_path)
    assert set(flags) <= set(scripts[FINETUNE])
    assert (flags["--lora_rank"], flags["--max_steps"]) == ("32", "50000")
    assert (flags["--data_root_dir"], flags["--run_root_dir"]) == (DATA, RUNS)
    deploys = stated_commands((REPOSITORY / "docs/vla.md").read_text("utf-8"), DEPLOY)
    stated = [flags_of(words) for words in deploys if set(flags_of(words)) <= set(scripts[DEPLOY])]
    assert stated != []


def test_the_dataset_is_called_the_same_everywhere(oxe, tmp_path):
    for library in ("openvla", "openvla_oft"):
        folder = tmp_path / library
        folder.mkdir()
        assert finetune(library, folder)[1]["--dataset_name"] == oxe.DATASET
    text = (REPOSITORY / "docs/vla.md").read_text("utf-8")
    keys = [flags_of(words).get("--unnorm_key") for words in stated_commands(text, DEPLOY)]
    assert keys == [None, oxe.DATASET]


def test_ofts_constants_are_ours_whatever_folders_are_called(tmp_path):
    words, _ = finetune("openvla_oft", tmp_path)
    deploy = stated_commands((REPOSITORY / "docs/vla.md").read_text("utf-8"), DEPLOY)[1]
    assert constants_by_words([DATA, RUNS])["ACTION_DIM"] != OPENVLA_ACTION
    for command in (words, deploy):
        constants = constants_by_words([DATA, RUNS, *command])
        assert constants["ACTION_DIM"] == OPENVLA_ACTION
        assert constants["PROPRIO_DIM"] == OPENVLA_JOINTS + 1
        assert constants["NUM_ACTIONS_CHUNK"] == 8


def test_the_server_does_as_the_training_did(tmp_path):
    _, flags = finetune("openvla_oft", tmp_path)
    deploy = flags_of(stated_commands((REPOSITORY / "docs/vla.md").read_text("utf-8"), DEPLOY)[1])
    shared = set(flags) & set(deploy)
    assert {"--use_proprio", "--num_images_in_input", "--use_film", "--lora_rank"} <= shared
    assert {name: flags[name] for name in shared} == {name: deploy[name] for name in shared}
    # Training on crops, answers on the middle.
    assert deploy["--center_crop"] == flags["--image_aug"]
