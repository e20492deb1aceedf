"""Read an exported dataset and learn a first policy from it: python examples/05_learn_from_the_dataset.py RUN/dataset

No robot-learning library is needed: LeRobot v3.0 is parquet and MP4. The policy is the smallest there is: behavior cloning by
least squares, from the last step and the gripper to the next step. It sees no image and does not know where the object is, so it
only shows that `action` is what to do next: on a held-out episode it must come nearer to the action than standing still does.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    folder = parser.parse_args().dataset
    info = json.loads((folder / "meta" / "info.json").read_text("utf-8"))
    print(f"{info['total_episodes']} episodes at {info['fps']} frames a second, {info['robot_type']}")

    rows = pq.read_table(sorted((folder / "data").rglob("*.parquet")))
    state, action = (np.stack(rows[name].to_numpy()) for name in ("observation.state", "action"))
    episode = rows["episode_index"].to_numpy()
    held_out = episode == episode.max()

    first = np.r_[True, np.diff(episode) > 0]
    last_step = np.where(first[:, None], 0, state - np.roll(state, 1, 0))
    seen = np.column_stack([last_step, state[:, -1], np.ones(len(state))])
    motion = action - state
    weights = np.linalg.lstsq(seen[~held_out], motion[~held_out], rcond=1e-3)[0]
    policy = np.abs(seen[held_out] @ weights - motion[held_out]).mean()
    still = np.abs(motion[held_out]).mean()
    print(f"mean error of the next action: cloned {policy:.4f}, standing still {still:.4f}")
    assert policy < still


if __name__ == "__main__":
    main()
