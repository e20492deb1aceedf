"""`aomgen bench policy`: demonstrations from one recording, policies that LeRobot trains on them, how often they open.

Every table consists of cells: who is tried, and where. A cell's rollouts are made once and kept; figures are counted
from them, so that they can be printed again without training anything.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from scipy.stats import binomtest

from aomgen.core.progress import silent
from aomgen.errors import BackendError
from aomgen.evaluation.evaluate import EvaluationRequest, evaluate, interval_95
from aomgen.evaluation.lerobot_policy import IMAGES, LAST, STATE, TRAINING, WEIGHTS
from aomgen.evaluation.policies import LEROBOT
from aomgen.evaluation.suite import open_suite
from aomgen.io.artifact import read_json
from aomgen.io.atomic import remove_folder, write_json
from benchmarks.policy_data import PolicyData, Trials
from benchmarks.policy_tables import FILMED, TABLES, VIDEO, Kind, Row, Training
from benchmarks.policy_video import mean_trajectory_error, video_error

# Of every training: AdamW's steps, demonstrations a step, and steps between checkpoints, from which a killed one goes on.
STEPS, BATCH, SAVE_EVERY = 5000, 32, 1000
QUICK_STEPS: Final = 3
# LeRobot's own policies would ask its hub for the weights of an encoder.
ON_GPU: Final = ("--policy.device=cuda", "--policy.pretrained_backbone_weights=null")
NETWORKS: Final[Mapping[Kind, tuple[str, ...]]] = {
    "small_act": ("--policy.type=small_act", "--policy.device=cpu"),
    "act": ("--policy.type=act", *ON_GPU),
    "diffusion": ("--policy.type=diffusion", *ON_GPU),
}
# Two policies that differ by chance less often than this are said to differ.
SIGNIFICANT: Final = 0.05


@dataclass(frozen=True, kw_only=True)
class PolicyBench:
    """Trains and tries.

    Attributes:
        data: Runs, datasets and suites.
        steps: Of each training.
        lerobot_train: LeRobot's own command.
    """

    data: PolicyData
    steps: int = STEPS
    lerobot_train: Path = field(default_factory=lambda: Path(sys.executable).with_name("lerobot-train"))

    def figures(self, tables: Sequence[str]) -> dict[str, Any]:
        """Figures of the tables, after everything that is missing has been made.

        Raises:
            BackendError: LeRobot is not installed here.
            AomgenError: Whatever a run, a training or a rollout refuses.
        """
        if not self.lerobot_train.is_file():
            raise BackendError(
                "lerobot-train",
                "is not beside this python",
                "make policy-env; .venv-policy/bin/aomgen bench policy ...",
            )
        rows = {name: TABLES[name] for name in tables if name != VIDEO}
        policies = [policy for table in rows.values() for row in table for policy in row.policies]
        trainings = dict.fromkeys(policy for policy in policies if isinstance(policy, Training))
        if VIDEO in tables:
            trainings |= dict.fromkeys(FILMED.values())
        for training in trainings:
            self.data.dataset(training.world, training.sees)
        with ThreadPoolExecutor(self.data.workers) as pool:
            list(pool.map(self.train, trainings))
        figures: dict[str, Any] = {name: table_figures(self.counted(table)) for name, table in rows.items()}
        return figures | ({VIDEO: self.video_errors()} if VIDEO in tables else {})

    def video_errors(self) -> dict[str, float]:
        """How far from the recorded hand it is that policies foresee from the recorded video, [mm]."""
        suite, results = open_suite(self.data.suite(Trials(world="microwave")))
        learned = {name: video_error(self._home(item), suite, results) for name, item in FILMED.items()}
        return learned | {"mean_trajectory": mean_trajectory_error(results)}

    def _home(self, training: Training) -> Path:
        return self.data.folder / "trainings" / training.name

    def train(self, training: Training) -> Path:
        """Folder of a policy; LeRobot goes on where it was killed."""
        home, steps = self._home(training), self.steps if training.demonstrations else 1
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
                # Draws fill their ranges evenly from the first on.
                f"--dataset.episodes={list(range(max(training.demonstrations, 1)))}",
                f"--output_dir={home}", f"--seed={training.seed}", f"--steps={steps}",
                f"--batch_size={BATCH}", "--num_workers=0", f"--save_freq={min(SAVE_EVERY, steps)}",
                "--wandb.enable=false", "--eval_freq=0",
                *([f"--policy.input_features={json.dumps(front_features(dataset))}"] if training.fixed_camera else []),
            ]  # fmt: skip
        self.data.tell(f"training {training.name}")
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
        log = home.with_suffix(".log")
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as sink:
            done = subprocess.run(
                [self.lerobot_train, *words], env=environment, stdout=sink, stderr=sink, check=False
            )
        if done.returncode:
            raise BackendError("lerobot-train", f"ended with exit code {done.returncode}", f"see {log}")
        return home

    def counted(self, rows: list[Row]) -> Iterator[tuple[Row, list[dict[str, Any]]]]:
        """Every row with what came of each of its policies."""
        for row in rows:
            yield row, [self.tried(policy, row) for policy in row.policies]

    def tried(self, policy: Training | str, row: Row) -> dict[str, Any]:
        """Figures of a policy in a row's trials, as `aomgen evaluate` gives them."""
        name = policy if isinstance(policy, str) else policy.name
        place = self.data.folder / "rollouts" / f"{name}-on-{row.test.name}-{row.visuals}"
        kept = place.with_suffix(".json")
        if not kept.is_file():
            suite, results = open_suite(self.data.suite(row.test))
            address = policy if isinstance(policy, str) else f"{LEROBOT}{self._home(policy)}"
            self.data.tell(f"rollouts {place.name}")
            request = EvaluationRequest(policy=address, visuals=row.visuals)
            write_json(kept, evaluate(suite, results, place, request, self.data.workers, silent))
        return read_json(kept)


def table_figures(rows: Iterator[tuple[Row, list[dict[str, Any]]]]) -> list[dict[str, Any]]:
    """A table's rows: counts over all seeds, and which other rows of the same trials are beaten."""
    made = list(rows)
    found = []
    for row, tried in made:
        trials, successes = sum(item["trials"] for item in tried), sum(item["successes"] for item in tried)
        beaten = [
            other.label
            for other, theirs in made
            if other.test == row.test and other.visuals == row.visuals and beats(tried[0], theirs[0])
        ]
        found.append(
            {
                **row.label,
                "success_rate": successes / trials,
                "interval_95": interval_95(successes, trials),
                "trials": trials,
                "seeds": [policy.seed for policy in row.policies if isinstance(policy, Training)],
                "by_seed": [item["success_rate"] for item in tried],
                "suite": tried[0]["suite"],
                "redrawn": tried[0]["redrawn"],
                "nearest_mm": tried[0]["nearest_mm"],
                "nearest_deg": tried[0]["nearest_deg"],
                "failures": tried[0]["failures"],
                "beats": beaten,
            }
        )
    return found


def beats(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> bool:
    """Whether a policy succeeds more often than another in the same trials: McNemar's exact test, two-sided."""
    pairs = [
        (not a["fail_reason"], not b["fail_reason"])
        for a, b in zip(mine["rollouts"], theirs["rollouts"], strict=True)
    ]
    won, lost = pairs.count((True, False)), pairs.count((False, True))
    return won > lost and float(binomtest(won, won + lost).pvalue) < SIGNIFICANT


def front_features(dataset: Path) -> dict[str, Any]:
    """What a policy sees that has only the dataset's first camera, as LeRobot's settings say it."""
    features = read_json(dataset / "meta" / "info.json")["features"]
    first = next(name for name in features if name.startswith(IMAGES))
    height, width, channels = features[first]["shape"]
    return {
        STATE: {"type": "STATE", "shape": features[STATE]["shape"]},
        first: {"type": "VISUAL", "shape": [channels, height, width]},
    }
