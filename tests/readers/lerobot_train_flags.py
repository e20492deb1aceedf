"""Stands in for `lerobot-train`: reads its command line with lerobot's own classes and prints the settings as JSON.

Run with .venv-policy's python. Instead of the checkpoint on the hub there is a folder with pi0.5's default settings.
"""

import json
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import pi05
from lerobot.policies.pi05.configuration_pi05 import PI05Config

CHECKPOINT = "--policy.path=lerobot/pi05_base"


@parser.wrap()
def main(config: TrainPipelineConfig) -> None:
    """Print what training would begin with, and which of the layers that are trained as a whole the model has."""
    config.validate()
    model = Path(pi05.__file__).with_name("modeling_pi05.py").read_text("utf-8")
    layers = config.peft.full_training_modules or []
    report = {
        "type": config.policy.type,
        "policy": {key: getattr(config.policy, key) for key in ("chunk_size", "n_action_steps", "dtype")},
        "optimizer": {"kind": type(config.optimizer).__name__, **asdict(config.optimizer)},
        "scheduler": {"kind": type(config.scheduler).__name__, **asdict(config.scheduler)},
        "steps": config.steps,
        "batch_size": config.batch_size,
        "peft": asdict(config.peft),
        "rename_map": config.rename_map,
        "layers": [name for name in layers if f"self.{name} = " in model],
    }
    sys.stdout.write(json.dumps(report) + "\n")


with tempfile.TemporaryDirectory() as folder:
    PI05Config(push_to_hub=False, device="cpu").save_pretrained(folder)
    sys.argv[sys.argv.index(CHECKPOINT)] = f"--policy.path={folder}"
    main()
