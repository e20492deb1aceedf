"""Stage that writes a LeRobot v3.0 dataset of the committed episodes. [paper 5.2]"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aomgen.core.progress import Progress
from aomgen.datasets.features import ACTION_SPACES, ActionSpace
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.datasets.selection import Choices
from aomgen.errors import ConfigError, suggest
from aomgen.io.episode_folder import list_committed
from aomgen.io.review import leave_out_rejected
from aomgen.results import Results


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetParams:
    """Options of the dataset of a run; `aomgen export` writes other datasets.

    Attributes:
        actions: Action space that policies learn.
    """

    actions: ActionSpace = "joint"

    def __post_init__(self) -> None:
        if self.actions not in ACTION_SPACES:
            raise ConfigError(
                "parameter 'dataset.actions'", f"is '{self.actions}'", suggest(self.actions, ACTION_SPACES)
            )


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Write all episodes of the run that are not rejected in the review."""
    params = results.params("dataset", DatasetParams())
    episodes = leave_out_rejected(results.out, list_committed(results.folders["episodes"]))
    selection = write_lerobot_v3(episodes, folder, Choices(actions=params.actions), progress)
    return {"episodes": len(selection.episodes), "frames": selection.frames}
