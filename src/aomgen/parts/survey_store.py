"""Loading and saving of the coverage maps: of Gaussians, and of the sides of object, robot and table."""

from pathlib import Path

import numpy as np

from aomgen.core.camera import camera_in_world
from aomgen.core.gaussians import Gaussians
from aomgen.core.held_out import held_out
from aomgen.core.structure import Structure
from aomgen.core.values import Array
from aomgen.errors import MalformedFileError
from aomgen.io.arrays import npz_bytes, read_npz
from aomgen.io.atomic import write_bytes
from aomgen.parts.coverage import Coverage
from aomgen.parts.label import Parts
from aomgen.parts.survey import Survey, survey
from aomgen.robots.configuration import RobotConfiguration
from aomgen.splatting.surfaces import view_depths

COVERAGE_FILE = "coverage.npz"
# Of the samples of the survey, fixed so that a run can be repeated.
SEED = 0


def run_survey(
    structure: Structure,
    world: Gaussians,
    S_world_recon: Array,
    parts: Parts,
    configuration: RobotConfiguration,
    folder: Path,
) -> Survey:
    """Look up how the sides of all parts were seen (see `survey`) and write `coverage.npz`.

    Args:
        structure: Cameras, recon frame; held-out ones do not count.
        world: The trained scene, world frame.
        S_world_recon: The alignment.
        parts: Labels of these Gaussians.
        configuration: Robot as scanned.
        folder: Receives the result.
    """
    withheld = set(held_out([*structure.cameras_recon, *structure.dropped]))
    cameras = [
        camera_in_world(S_world_recon, camera)
        for name, camera in structure.cameras_recon.items()
        if name not in withheld
    ]
    views = view_depths(world, cameras)
    found = survey(world, parts.labels, configuration, views, np.random.default_rng(SEED))
    save_survey(folder, found)
    return found


def save_survey(folder: Path, found: Survey) -> None:
    """Write `coverage.npz`; equal surveys give equal bytes."""
    arrays = {
        "names": np.array(found.names, dtype=np.str_),
        "points_world": found.points_world,
        "sides": found.sides,
        "views": found.coverage.views,
        "spread_deg": found.coverage.spread_deg,
    }
    write_bytes(folder / COVERAGE_FILE, npz_bytes(arrays))


def load_survey(folder: Path) -> Survey:
    """Read what `save_survey` wrote.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: As their names say.
    """
    arrays = read_npz(folder / COVERAGE_FILE)
    try:
        return Survey(
            names=tuple(str(name) for name in arrays["names"]),
            points_world=arrays["points_world"],
            sides=arrays["sides"],
            coverage=Coverage(views=arrays["views"], spread_deg=arrays["spread_deg"]),
        )
    except (KeyError, ValueError) as error:
        raise MalformedFileError(
            folder / COVERAGE_FILE, f"does not hold a survey ({error})", "run the parts stage again"
        ) from error
