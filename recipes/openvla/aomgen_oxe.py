"""Let OpenVLA and OpenVLA-OFT know AOMGen's RLDS dataset, then run one of their scripts; nothing there is edited:

    torchrun ... RECIPES/openvla/aomgen_oxe.py SCRIPT ARGUMENTS...      in their folder; see finetune.sh

The dataset is `aomgen export OUT DATA/opening --format rlds --size 224x224`: the folder's name is its name in the registry
and the key of its statistics, with which answers are un-normalized. Written for openvla c8f03f4, openvla-oft 213c5ff.
"""

import runpy
import sys
from typing import Any

from prismatic.vla.datasets.rlds.oxe.configs import OXE_DATASET_CONFIGS, ActionEncoding, StateEncoding
from prismatic.vla.datasets.rlds.oxe.transforms import OXE_STANDARDIZATION_TRANSFORMS

DATASET = "opening"
# Yours to change: the camera that is learned from, one of the dataset's.
CAMERA = "front"
NO_CAMERAS: dict[str, str | None] = {"primary": None, "secondary": None, "wrist": None}


def dataset_config() -> dict[str, Any]:
    """The registry's entry. `state`: seven joints (zeros for those an arm does not have) and the gripper."""
    return {
        "image_obs_keys": {**NO_CAMERAS, "primary": CAMERA},
        "depth_obs_keys": NO_CAMERAS,
        "state_obs_keys": ["state"],
        "state_encoding": StateEncoding.JOINT,
        "action_encoding": ActionEncoding.EEF_POS,
    }


def standardize(trajectory: dict[str, Any]) -> dict[str, Any]:
    """Actions are OpenVLA's already: translation, roll, pitch, yaw in the world's axes; gripper 1 open, 0 closed.

    Raises:
        ValueError: The dataset was exported with another action space.
    """
    if "ee_delta" in trajectory["annotation"]["action"]:
        raise ValueError("the dataset's action is not ee_delta; export it without --actions")
    return {key: trajectory[key] for key in ("observation", "action", "language_instruction")}


def run(script: str, *arguments: str) -> None:
    """Run a script that knows the dataset."""
    OXE_DATASET_CONFIGS[DATASET] = dataset_config()
    OXE_STANDARDIZATION_TRANSFORMS[DATASET] = standardize
    sys.argv = [script, *arguments]
    runpy.run_path(script, run_name="__main__")


if __name__ == "__main__":
    run(*sys.argv[1:])
