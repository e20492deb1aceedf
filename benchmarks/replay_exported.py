"""`python -m benchmarks replay-exported`: success of exported actions in a foreign scene."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from aomgen.datasets.features import ACTION_SPACES, ee_targets
from aomgen.errors import MissingFileError
from aomgen.io.artifact import read_json
from aomgen.robots.loading import load_stored_robot
from aomgen.robots.robot import RobotModel
from benchmarks.exported import (
    OPENED_SHARE,
    STATE,
    Exported,
    Replay,
    exported_from,
    poses_of,
)
from benchmarks.foreign_scene import foreign_scene

TWIN_FOLDER, EPISODES_FOLDER = "06_twin", "08_episodes"


def run_replay(outs: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """Replay all exported episodes of some runs, unchanged and with the object displaced.

    Args:
        outs: Folders of finished runs.

    Returns:
        By category: `episodes`, `opened` (at least 90 % of the plan), `theta_rmse`, `theta_worst` and
        `final_error` (replayed joint actions against stored joint values, in `unit`; the last after
        another second), `opened_when_moved`; `opened_by_ee_absolute`, `opened_by_ee_delta`, and
        `ee_delta_summed_error_mm` (see `summed_error_m`).

    Raises:
        MissingFileError: A run has no dataset.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    for out in outs:
        robot = load_stored_robot(out / TWIN_FOLDER)
        for episode in exported_episodes(out):
            category, row = _replayed(robot, episode)
            rows.setdefault(category, []).append(row)
    return {category: _summary(items) for category, items in sorted(rows.items())}


def exported_episodes(out: Path) -> Iterator[Exported]:
    """Yield the episodes of a run's dataset, one after the other.

    Raises:
        MissingFileError: The run has no dataset.
    """
    meta = out / "dataset" / "meta"
    if not (meta / "info.json").is_file():
        raise MissingFileError(meta, "is missing", "finish the run first")
    fps = int(read_json(meta / "info.json")["fps"])
    table = pq.read_table(out / "dataset" / "data")
    columns = {
        name: np.array(table[name].to_pylist(), np.float64)
        for name in table.column_names
        if name.startswith(("action", "annotation.", STATE))
    }
    owner = np.array(table["episode_index"])
    for row in pq.read_table(meta / "episodes").to_pylist():
        folder = out / EPISODES_FOLDER / f"{row['aomgen/source_index']:06d}"
        described = read_json(folder / "episode.json")
        mine = owner == row["episode_index"]
        yield exported_from(
            {name: values[mine] for name, values in columns.items()},
            folder / described["asset_usd"],
            np.array(described["T_world_object"]),
            described["verdict"],
            fps,
        )


def summed_error_m(episode: Exported) -> float:
    """Compute the distance of the summed deltas, from the first pose on, from the planned path, [m]."""
    T, worst = poses_of(episode.ee_poses[:1]), 0.0
    for delta, target in zip(episode.actions["ee_delta"], episode.actions["ee_absolute"], strict=True):
        T = ee_targets(T, delta[None, :6])
        worst = max(worst, float(np.linalg.norm(T[0, :3, 3] - target[:3])))
    return worst


def _replayed(robot: RobotModel, episode: Exported) -> tuple[str, dict[str, Any]]:
    scene = foreign_scene(robot, episode.usd, episode.T_world_object)
    scale = np.rad2deg(1.0) if scene.revolute else 1000.0
    row: dict[str, Any] = {
        "unit": "deg" if scene.revolute else "mm",
        "summed_mm": 1000 * summed_error_m(episode),
    }
    for space in ACTION_SPACES:
        thetas = Replay(scene, robot, episode, space).run().thetas
        row[space] = {
            "opened": bool(episode.shares(thetas)[-1] >= OPENED_SHARE),
            "errors": scale * (thetas[:-1] - episode.thetas),
            "final_error": scale * abs(float(thetas[-1] - episode.thetas[-1])),
        }
    away = episode.moved_away(robot)
    missed = Replay(foreign_scene(robot, away.usd, away.T_world_object), robot, away).run().thetas
    return scene.category, row | {"opened_when_moved": bool(episode.shares(missed)[-1] >= OPENED_SHARE)}


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    by_joint = [row["joint"] for row in rows]
    errors = np.concatenate([row["errors"] for row in by_joint])
    return {
        "episodes": len(rows),
        "opened": sum(row["opened"] for row in by_joint),
        "opened_by_ee_absolute": sum(row["ee_absolute"]["opened"] for row in rows),
        "opened_by_ee_delta": sum(row["ee_delta"]["opened"] for row in rows),
        "opened_when_moved": sum(row["opened_when_moved"] for row in rows),
        "theta_rmse": float(np.sqrt(np.mean(errors**2))),
        "theta_worst": float(np.abs(errors).max()),
        "final_error": max(row["final_error"] for row in by_joint),
        "unit": rows[0]["unit"],
        "ee_delta_summed_error_mm": max(row["summed_mm"] for row in rows),
    }
