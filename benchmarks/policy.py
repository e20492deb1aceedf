"""`python -m benchmarks policy`: success rates of LeRobot policies trained from one recording.

Every table consists of cells: a policy, and where it is tested. A cell's rollouts are made once and kept;
metrics are computed from them, so that they can be printed again without training.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from scipy.stats import binomtest

from aomgen.core.progress import silent
from aomgen.evaluation.evaluate import EvaluationRequest, evaluate, interval_95
from aomgen.evaluation.policies import LEROBOT
from aomgen.evaluation.suite import open_suite
from aomgen.io.artifact import file_digest, read_json
from aomgen.io.atomic import write_json
from aomgen.pipeline.manifest import text_digest
from benchmarks.policy_data import PolicyData, Trials
from benchmarks.policy_finder import measure_finder
from benchmarks.policy_tables import FILMED, FINDERS, TABLES, VIDEO, Row, Training
from benchmarks.policy_training import Trainer
from benchmarks.policy_video import mean_trajectory_error, video_error

# Packages whose versions are reported with the metrics.
MADE_WITH: Final = ("aomgen", "lerobot", "torch", "mujoco", "numpy")
# Policies whose difference has a smaller p-value than this are reported to differ.
SIGNIFICANT: Final = 0.05


@dataclass(frozen=True, kw_only=True)
class PolicyBench:
    """Benchmark that tests policies and counts successes.

    Attributes:
        data: Runs, datasets and suites.
        trainer: Trainer of the policies.
    """

    data: PolicyData
    trainer: Trainer

    def figures(self, tables: Sequence[str]) -> dict[str, Any]:
        """Compute metrics of the tables, after making everything that is missing; kept rollouts suffice.

        Raises:
            BackendError: LeRobot is not installed here, and policies are missing.
            AomgenError: Any error of a run, a training or a rollout.
        """
        rows = {name: TABLES[name] for name in tables if name in TABLES}
        cells = [(policy, row) for table in rows.values() for row in table for policy in row.policies]
        untried = [policy for policy, row in cells if not self._kept(policy, row).is_file()]
        wanted = [policy for policy in untried if isinstance(policy, Training)]
        self._train([*wanted, *(FILMED.values() if VIDEO in tables else [])])
        figures: dict[str, Any] = {name: table_figures(self.counted(table)) for name, table in rows.items()}
        figures |= {VIDEO: self.video_errors()} if VIDEO in tables else {}
        found = {name: measure_finder(self.data, FINDERS[name]) for name in tables if name in FINDERS}
        return figures | found

    def _train(self, policies: Sequence[Training]) -> None:
        """Train all policies, as many at a time as there are workers."""
        if policies:
            self.trainer.require_lerobot()
        trainings = dict.fromkeys(policies)
        # One after the other, because two processes cannot work on the same run.
        for training in trainings:
            if training.learns:
                self.data.dataset(training.world, training.sees)
                self.trainer.list_finder_options(training)
            else:
                self.trainer.train(training)
        with ThreadPoolExecutor(self.data.workers) as pool:
            list(pool.map(self.trainer.train, [training for training in trainings if training.learns]))

    def video_errors(self) -> dict[str, float]:
        """Compute mean errors of the predicted end effector on the recorded video, [mm]."""
        suite, results = open_suite(self.data.suite(Trials(world="microwave")))
        learned = {
            name: video_error(self.trainer.home(item), suite, results) for name, item in FILMED.items()
        }
        return learned | {"mean_trajectory": mean_trajectory_error(results)}

    def counted(self, rows: list[Row]) -> Iterator[tuple[Row, list[dict[str, Any]]]]:
        """Yield every row with the results of each of its policies."""
        for row in rows:
            yield row, [self.tried(policy, row) for policy in row.policies]

    def tried(self, policy: Training | str, row: Row) -> dict[str, Any]:
        """Test a policy in a row's trials; returns the metrics of `aomgen evaluate` and their inputs."""
        kept = self._kept(policy, row)
        if not kept.is_file():
            ours = isinstance(policy, Training)
            finds = ours and policy.finds
            path = self.data.finder_suite(row.test, policy.actions) if finds else self.data.suite(row.test)
            suite, results = open_suite(path)
            address = f"{LEROBOT}{self.trainer.home(policy)}" if ours else policy
            request = EvaluationRequest(policy=address, visuals=row.visuals)
            self.data.notify(f"rollouts {kept.stem}")
            found = evaluate(suite, results, kept.with_suffix(""), request, self.data.workers, silent)
            learned = self.data.dataset(policy.world, policy.sees) if ours and policy.learns else None
            dataset = folder_digest(learned) if learned else None
            write_json(kept, {**found, "dataset": dataset, "versions": versions()})
        return read_json(kept)

    def _kept(self, policy: Training | str, row: Row) -> Path:
        name = policy if isinstance(policy, str) else policy.name
        return self.data.folder / "rollouts" / f"{name}-on-{row.test.name}-{row.visuals}.json"


def folder_digest(folder: Path) -> str:
    """Compute the digest of the names and contents of all files."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return text_digest("".join(f"{path.relative_to(folder)} {file_digest(path)}\n" for path in files))


def versions() -> dict[str, str]:
    """Return versions of the packages that train and simulate."""
    return {name: version(name) for name in MADE_WITH}


def table_figures(rows: Iterator[tuple[Row, list[dict[str, Any]]]]) -> list[dict[str, Any]]:
    """Compute a table's rows: counts over all seeds, and which other rows of the same trials are beaten."""
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
                "dataset": tried[0]["dataset"],
                "versions": tried[0]["versions"],
                "redrawn": tried[0]["redrawn"],
                "nearest_mm": tried[0]["nearest_mm"],
                "nearest_deg": tried[0]["nearest_deg"],
                "failures": tried[0]["failures"],
                "touched_obstacle": sum(item["touched_obstacle"] for item in tried),
                "beats": beaten,
            }
        )
    return found


def beats(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> bool:
    """Return whether a policy succeeds more often than another in the same trials: McNemar's exact test, two-sided."""
    pairs = [
        (not a["fail_reason"], not b["fail_reason"])
        for a, b in zip(mine["rollouts"], theirs["rollouts"], strict=True)
    ]
    won, lost = pairs.count((True, False)), pairs.count((False, True))
    return won > lost and float(binomtest(won, won + lost).pvalue) < SIGNIFICANT
