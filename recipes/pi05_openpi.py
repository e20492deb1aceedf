"""Fine-tune pi0.5 with openpi on AOMGen's demonstrations, as in the paper, sec. 5.1.

Adds the config `pi05_aomgen` to openpi and runs one of openpi's own scripts; nothing there is edited:

    uv run RECIPES/pi05_openpi.py SCRIPT ARGUMENTS...       in openpi's folder; see pi05_openpi.sh

`# open:` marks what the paper does not say. This was never run: no weights, no GPU. Written for openpi 15a9616.
"""

import dataclasses
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
from openpi import transforms
from openpi.models import pi0_config
from openpi.models.model import IMAGE_KEYS
from openpi.training import config, optimizer, weight_loaders

NAME = "pi05_aomgen"
# Yours to change: the dataset's folder in HF_LEROBOT_HOME, its cameras (at most three, that which sees the scene first)
# and the joints of the arm.
REPO_ID = "aomgen/opening"
CAMERAS = ("front",)
ARM_JOINTS = 6
HORIZON = 5
STEPS = 30_000


@dataclasses.dataclass(frozen=True)
class AomgenInputs(transforms.DataTransformFn):
    """From {"images": {camera: picture}, "state", "prompt"} to the model's inputs, in training and in evaluation."""

    def __call__(self, data: dict[str, Any]) -> dict[str, Any]:
        """Cameras that are not there are black and masked."""
        seen = {
            key: picture(data["images"][name])
            for key, name in zip(IMAGE_KEYS[: len(CAMERAS)], CAMERAS, strict=True)
        }
        black = np.zeros_like(seen[IMAGE_KEYS[0]])
        inputs = {
            "state": np.asarray(data["state"]),
            "image": {key: seen.get(key, black) for key in IMAGE_KEYS},
            "image_mask": {key: np.bool_(key in seen) for key in IMAGE_KEYS},
        }
        if "actions" in data:
            # A copy: deltas are taken in place.
            inputs["actions"] = np.array(data["actions"])
        return inputs | {key: data[key] for key in ("prompt",) if key in data}


@dataclasses.dataclass(frozen=True)
class AomgenOutputs(transforms.DataTransformFn):
    """The model's actions without what they were padded with."""

    def __call__(self, data: dict[str, Any]) -> dict[str, Any]:
        """Joint targets and gripper."""
        return {"actions": np.asarray(data["actions"][:, : ARM_JOINTS + 1])}


@dataclasses.dataclass(frozen=True)
class AomgenDataConfig(config.DataConfigFactory):
    """A LeRobot v2.1 dataset of AOMGen's whose action is `joint`."""

    def create(self, assets_dirs: Path, model_config: Any) -> config.DataConfig:
        """Joints are learned as differences from the state, the gripper as it is."""
        mask = transforms.make_bool_mask(ARM_JOINTS, -1)
        repack = transforms.RepackTransform(
            {
                "images": {name: f"observation.images.{name}" for name in CAMERAS},
                "state": "observation.state",
                "actions": "action",
                "prompt": "prompt",
            }
        )
        return dataclasses.replace(
            self.create_base_config(assets_dirs, model_config),
            repack_transforms=transforms.Group(inputs=[repack]),
            data_transforms=transforms.Group(
                inputs=[AomgenInputs(), transforms.DeltaActions(mask)],
                outputs=[transforms.AbsoluteActions(mask), AomgenOutputs()],
            ),
            model_transforms=config.ModelTransformFactory()(model_config),
            action_sequence_keys=("action",),
            prompt_from_task=True,
        )


def picture(image: Any) -> np.ndarray:
    """uint8 (H, W, 3), also from LeRobot's float (3, H, W) in 0..1."""
    array = np.asarray(image)
    if array.dtype.kind == "f":
        array = np.round(255 * array).astype(np.uint8)
    return np.moveaxis(array, 0, -1) if array.shape[0] == 3 else array


def train_config() -> config.TrainConfig:
    """The paper's settings. Frozen weights become bfloat16, trained ones stay float32: that is what openpi does."""
    # open: LoRA's rank (openpi: 16 in the language model, 32 in the action expert); the image encoder is not frozen.
    model = pi0_config.Pi0Config(
        pi05=True,
        action_horizon=HORIZON,
        paligemma_variant="gemma_2b_lora",
        action_expert_variant="gemma_300m_lora",
    )
    return config.TrainConfig(
        name=NAME,
        model=model,
        freeze_filter=model.get_freeze_filter(),
        # open: averaged weights; openpi's LoRA configs have none.
        ema_decay=None,
        data=AomgenDataConfig(repo_id=REPO_ID),
        weight_loader=weight_loaders.CheckpointWeightLoader(
            "gs://openpi-assets/checkpoints/pi05_base/params"
        ),
        # open: the rate at the end, here a tenth of the highest as in openpi's defaults.
        lr_schedule=optimizer.CosineDecaySchedule(
            warmup_steps=10_000, peak_lr=5e-5, decay_steps=STEPS, decay_lr=5e-6
        ),
        # open: betas and weight decay, here openpi's.
        optimizer=optimizer.AdamW(clip_gradient_norm=1.0),
        batch_size=16,
        num_train_steps=STEPS,
        wandb_enabled=False,
        # `aomgen evaluate --policy openpi://...` compares this with its suite.
        policy_metadata={"action_space": "joint", "cameras": list(CAMERAS)},
    )


def run(script: str, *arguments: str) -> None:
    """Run a script of openpi's that knows the config."""
    config._CONFIGS_DICT[NAME] = train_config()
    sys.argv = [script, *arguments]
    runpy.run_path(script, run_name="__main__")


if __name__ == "__main__":
    # By its name, so that processes of the data loader, which begin anew, find its classes.
    import pi05_openpi

    pi05_openpi.run(*sys.argv[1:])
