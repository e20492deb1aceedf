"""`aomgen bench policy`: demonstrations from one recording, policies that LeRobot trains on them, how often they open.

Every table consists of cells: who is tried, and where. A cell's rollouts are made once and kept; figures are counted
from them, so that they can be printed again without training anything.
"""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from scipy.stats import binomtest

from aomgen.core.progress import silent
from aomgen.errors import BackendError, ConfigError
from aomgen.evaluation.evaluate import EvaluationRequest, evaluate, interval_95
from aomgen.evaluation.lerobot_policy import LAST, TRAINING, WEIGHTS
from aomgen.evaluation.policies import LEROBOT, NEAREST, ORACLE
from aomgen.evaluation.suite import open_suite
from aomgen.evaluation.views import VISUALS, Visuals
from aomgen.io.artifact import read_json
from aomgen.io.atomic import remove_folder, write_json
from aomgen.io.schema import suggest
from benchmarks.policy_data import PolicyData, Sight, Trials

# Of every training: AdamW's steps, demonstrations a step, and steps between checkpoints, from which a killed one goes on.
STEPS, BATCH, SAVE_EVERY = 5000, 32, 1000
SEEDS: Final = (0, 1, 2)
FULL: Final = 150
SCALES: Final = (0.6, 0.7, 0.8, 0.9)
MOVED_M: Final = (0.0, 0.05, 0.10, 0.20)
# What is tried where it only matters whether it works.
QUICK_CELLS: Final = ["quick"]
QUICK_STEPS: Final = 3
# Two policies that differ by chance less often than this are said to differ.
SIGNIFICANT: Final = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Training:
    """A policy: the demonstrations of a world that it learns from, none for an untrained one, what these show, its seed."""

    world: str
    demonstrations: int = FULL
    seed: int = 0
    sees: Sight = "splat"

    @property
    def name(self) -> str:
        """For files."""
        name = f"{self.world}-{self.demonstrations}-{self.seed}"
        return name if self.sees == "splat" else f"{name}-{self.sees}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A line of a table: one kind of policy, maybe trained several times, in the same trials.

    Attributes:
        label: What sets it apart from the table's other rows.
        policies: Trained ones; or a name of `evaluation.policies`.
        test: The trials.
        visuals: What is seen.
    """

    label: Mapping[str, Any]
    policies: tuple[Training | str, ...]
    test: Trials
    visuals: Visuals = "splat"


def _curve(world: str) -> list[Row]:
    test = Trials(world=world)
    floors = {name: Row(label={"policy": name}, policies=(name,), test=test) for name in (NEAREST, ORACLE)}
    counts = {0: SEEDS[:1], 1: SEEDS[:1], 50: SEEDS[:1], 100: SEEDS[:1], FULL: SEEDS}
    learned = [
        Row(
            label={"demonstrations": count},
            policies=tuple(Training(world=world, demonstrations=count, seed=seed) for seed in seeds),
            test=test,
        )
        for count, seeds in counts.items()
    ]
    told = Row(label={"policy": "state_policy"}, policies=(Training(world=world, sees="pose"),), test=test)
    return [*learned, *floors.values(), told]


def _scales(world: str) -> list[Row]:
    return [
        Row(
            label={"scale": scale, "sizes_in_training": learned != world},
            policies=(Training(world=learned),),
            test=Trials(world=world, scale=scale),
        )
        for learned in (f"{world}_sizes", world)
        for scale in SCALES
    ]


TABLES: Final = {
    "curve.microwave": _curve("microwave"),
    "curve.drawer": _curve("drawer"),
    "scale_table.microwave": _scales("microwave"),
    "scale_table.drawer": _scales("drawer"),
    "quick": [
        Row(
            label={"demonstrations": 2},
            policies=(Training(world="microwave", demonstrations=2),),
            test=Trials(world="microwave"),
        )
    ],
    "unseen_table": [
        Row(
            label={"training": label},
            policies=(Training(world=world),),
            test=Trials(world="unseen_microwaves"),
        )
        for label, world in (("single", "microwave"), ("mixed", "microwaves"))
    ],
    "renderer_table": [
        Row(
            label={"trained_on": learned, "tested_on": seen},
            policies=(Training(world="microwave", sees=learned),),
            test=Trials(world="microwave"),
            visuals=seen,
        )
        for learned in VISUALS
        for seen in VISUALS
    ],
    "recovery_ablation": [
        Row(
            label={"recovery": world != "microwave"},
            policies=(Training(world=world),),
            test=Trials(world="microwave"),
        )
        for world in ("microwave", "microwave_recovery")
    ],
    "viewpoint_table": [
        Row(
            label={"moved_m": moved, "views_in_training": world != "microwave"},
            policies=(Training(world=world),),
            test=Trials(world="microwave", moved_m=moved),
        )
        for world in ("microwave", "microwave_views")
        for moved in MOVED_M
    ],
}


def chosen_tables(names: list[str]) -> dict[str, list[Row]]:
    """Tables by their names or the beginnings of these; all but the quick one where none is named.

    Raises:
        ConfigError: There is no such table.
    """
    for name in names:
        if not any(table.startswith(name) for table in TABLES):
            raise ConfigError("--cells", f"'{name}' is unknown", suggest(name, TABLES))
    wanted = tuple(names or [table for table in TABLES if table not in QUICK_CELLS])
    return {table: rows for table, rows in TABLES.items() if table.startswith(wanted)}


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

    def figures(self, tables: Mapping[str, list[Row]]) -> dict[str, Any]:
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
        rows = [row for table in tables.values() for row in table]
        trainings = dict.fromkeys(p for row in rows for p in row.policies if isinstance(p, Training))
        for training in trainings:
            self.data.dataset(training.world, training.sees)
        with ThreadPoolExecutor(self.data.workers) as pool:
            list(pool.map(self.train, trainings))
        return {name: table_figures(self.counted(rows)) for name, rows in tables.items()}

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
                "--policy.type=small_act", "--policy.device=cpu", "--policy.push_to_hub=false",
                f"--dataset.repo_id=local/{training.world}", f"--dataset.root={dataset}",
                # Draws fill their ranges evenly from the first on.
                f"--dataset.episodes={list(range(max(training.demonstrations, 1)))}",
                f"--output_dir={home}", f"--seed={training.seed}", f"--steps={steps}",
                f"--batch_size={BATCH}", "--num_workers=0", f"--save_freq={min(SAVE_EVERY, steps)}",
                "--wandb.enable=false", "--eval_freq=0",
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
