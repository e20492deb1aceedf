"""Training of policies by LeRobot's command on the datasets of `python -m benchmarks policy`."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from pyarrow.parquet import read_table

from aomgen.datasets.lerobot_tables import ASSET
from aomgen.errors import BackendError, NotEnoughEpisodesError
from aomgen.evaluation.lerobot_policy import IMAGES, LAST, STATE, TRAINING, WEIGHTS
from aomgen.evaluation.suite import fixed_cameras, open_suite
from aomgen.io.artifact import read_json
from aomgen.io.atomic import remove_folder
from benchmarks.policy_data import UNSEEN, WORLDS, PolicyData, Trials
from benchmarks.policy_finder import import_plugin, train_finder
from benchmarks.policy_tables import Kind, Training

# Settings of every training: AdamW steps, batch size, and steps between checkpoints,
# from which a killed training continues.
STEPS, BATCH, SAVE_EVERY = 5000, 32, 1000
QUICK_STEPS: Final = 3
# LeRobot's own policies would download the weights of an encoder from its hub.
ON_GPU: Final = ("--policy.device=cuda", "--policy.pretrained_backbone_weights=null")
NETWORKS: Final[Mapping[Kind, tuple[str, ...]]] = {
    "small_act": ("--policy.type=small_act", "--policy.device=cpu"),
    "handle_act": ("--policy.type=handle_act", "--policy.device=cpu"),
    "act": ("--policy.type=act", *ON_GPU),
    "diffusion": ("--policy.type=diffusion", *ON_GPU),
}


@dataclass(frozen=True, kw_only=True)
class Trainer:
    """Trainer of policies.

    Attributes:
        data: Folders of datasets and policies.
        steps: Number of steps of each training.
        command: `lerobot-train`.
    """

    data: PolicyData
    steps: int = STEPS
    command: Path = field(default_factory=lambda: Path(sys.executable).with_name("lerobot-train"))

    def require_lerobot(self) -> None:
        """Refuse an environment without LeRobot.

        Raises:
            BackendError: It is not installed here.
        """
        if not self.command.is_file():
            raise BackendError(
                "lerobot-train",
                "is not installed next to this python",
                "make policy-env; .venv-policy/bin/python -m benchmarks policy ...",
            )

    def home(self, training: Training) -> Path:
        """Return the folder of a policy."""
        return self.data.folder / "trainings" / training.name

    def train(self, training: Training) -> Path:
        """Train a policy and return its folder; LeRobot continues a killed training."""
        if not training.learns:
            return self.create_planning_policy(training)
        home, steps = self.home(training), self.steps if training.demonstrations else 1
        last = home / LAST
        if (last / WEIGHTS).is_file() and (home / "checkpoints" / "last").resolve().name == f"{steps:06d}":
            return home
        dataset = self.data.dataset(training.world, training.sees)
        if (last / TRAINING).is_file():
            words = [f"--config_path={last / TRAINING}", "--resume=true", f"--steps={steps}"]
        else:
            if home.is_dir():
                remove_folder(home)
            words = [
                *NETWORKS[training.kind], "--policy.push_to_hub=false",
                f"--dataset.repo_id=local/{training.world}", f"--dataset.root={dataset}",
                f"--dataset.episodes={first_draws(dataset, max(training.demonstrations, 1))}",
                f"--output_dir={home}", f"--seed={training.seed}", f"--steps={steps}",
                f"--batch_size={BATCH}", "--num_workers=0", f"--save_freq={min(SAVE_EVERY, steps)}",
                "--wandb.enable=false", "--eval_freq=0",
                *([f"--policy.input_features={json.dumps(front_features(dataset))}"] if training.fixed_camera else []),
                *self.list_finder_options(training),
            ]  # fmt: skip
        self.data.notify(f"training {training.name}")
        # Mixed precision is a third faster than float32, at an equal loss.
        precision = {"ACCELERATE_MIXED_PRECISION": "bf16"}
        environment = {**precision, **os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
        log = home.with_suffix(".log")
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as sink:
            done = subprocess.run(
                [self.command, *words], env=environment, stdout=sink, stderr=sink, check=False
            )
        if done.returncode:
            raise BackendError("lerobot-train", f"ended with exit code {done.returncode}", f"see {log}")
        return home

    def create_planning_policy(self, training: Training) -> Path:
        """Create the policy `handle_plan` with the objects of its worlds and return its folder; an existing one is kept."""
        home = self.home(training)
        if not (home / WEIGHTS).is_file():
            create = import_plugin("create_handle_plan").create_policy
            suite = self._find_suite(training)
            libraries = [
                (
                    self.data.run(world, until="replacement"),
                    train_finder(self.data, WORLDS[world].recording, training.seed, training.variant),
                )
                for world in training.worlds
            ]
            create(suite, home, libraries, list_cameras(training, suite), training.known)
        return home

    def list_finder_options(self, training: Training) -> list[str]:
        """Return the options of a policy with a finder, after making finder and suite; none for other policies."""
        if not training.finds:
            return []
        finder, suite = train_finder(self.data, training.category), self._find_suite(training)
        cameras = json.dumps(list_cameras(training, suite))
        return [f"--policy.finder={finder}", f"--policy.suite={suite}", f"--policy.cameras={cameras}"]

    def _find_suite(self, training: Training) -> Path:
        """Return the file of a suite whose cameras and arm are those of all worlds with the policy's recording."""
        return self.data.finder_suite(Trials(world=UNSEEN[training.category]), training.actions)


def list_cameras(training: Training, suite: Path) -> list[str]:
    """List the cameras that a policy with a finder uses, as its setting names them: empty for all cameras of the suite."""
    if training.wrist_camera:
        return []
    trials, results = open_suite(suite)
    return list(fixed_cameras(trials.cameras, results.robot))


def first_draws(dataset: Path, count: int) -> list[int]:
    """Select demonstrations of all objects; draws fill their ranges evenly from the first on.

    Raises:
        NotEnoughEpisodesError: The dataset has fewer.
    """
    assets = read_table(dataset / "meta" / "episodes", columns=[ASSET])[ASSET].to_pylist()
    if len(assets) < count:
        raise NotEnoughEpisodesError(dataset.name, f"has {len(assets)} episodes, want {count}", "add objects")
    before = [assets[:number].count(name) for number, name in enumerate(assets)]
    return sorted(sorted(range(len(assets)), key=before.__getitem__)[:count])


def front_features(dataset: Path) -> dict[str, Any]:
    """Return features of a policy with only the dataset's first camera, as LeRobot's settings name them."""
    features = read_json(dataset / "meta" / "info.json")["features"]
    first = next(name for name in features if name.startswith(IMAGES))
    height, width, channels = features[first]["shape"]
    return {
        STATE: {"type": "STATE", "shape": features[STATE]["shape"]},
        first: {"type": "VISUAL", "shape": [channels, height, width]},
    }
