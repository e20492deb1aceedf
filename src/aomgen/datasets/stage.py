"""A LeRobot v3.0 dataset of the committed episodes. [paper 5.2]"""

from pathlib import Path
from typing import Any

from aomgen.core.progress import Progress
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.io.episode_folder import list_committed
from aomgen.results import Results


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Write all episodes of the run."""
    written = write_lerobot_v3(list_committed(results.folders["episodes"]), folder, progress)
    return {"episodes": written["episodes"], "frames": written["frames"]}
