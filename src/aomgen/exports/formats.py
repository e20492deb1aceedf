"""Export a twin and its motions to a file in the format of its suffix."""

import importlib.util
from pathlib import Path
from typing import Final

from aomgen.errors import BackendError, ConfigError, UnknownNameError
from aomgen.exports.scene_motion import SceneMotion, first_episode, open_motion
from aomgen.io.usd import SUFFIXES as USD_SUFFIXES
from aomgen.pipeline.stages import require_stage
from aomgen.results import Results

GAUSSIAN_SUFFIXES: Final = (".ply", ".splat", ".spz", ".glb")
MJCF, RERUN, MCAP = ".xml", ".rrd", ".mcap"
TWIN_SUFFIXES: Final = (*USD_SUFFIXES, MJCF, *GAUSSIAN_SUFFIXES, RERUN, MCAP)
# Packages required for a suffix: name of the module, and of the extra that installs it.
PACKAGES: Final = {RERUN: ("rerun", "rerun"), MCAP: ("mcap", "mcap")}


def export_twin(
    results: Results,
    path: Path,
    *,
    episode: int | None = None,
    joint: float | None = None,
    time_s: float | None = None,
) -> str:
    """Write a twin and a motion to one file in the format of its suffix; an existing file is replaced.

    Args:
        results: Results of a run.
        path: File with one of `TWIN_SUFFIXES`; a folder of meshes and a CSV of controls are written next to an .xml.
        episode: Number of an episode; None selects the recorded demonstration, or the first episode for an .xml.
        joint: Value of the object's joint in its range, [rad] or [m]; only for files of Gaussians.
        time_s: Time of the motion, [s], whose state is written; only for files of Gaussians.

    Returns:
        Description of what was written.

    Raises:
        UnknownNameError: The suffix is unknown, or the episode does not exist.
        ConfigError: The format does not support an option, a value is outside of its range, or the folder of an .xml was not
            written by AOMGen.
        MissingFileError: A required stage has not finished.
        BackendError: A package is missing.
        StorageError: Writing to the disk failed.
    """
    suffix = path.suffix.lower()
    if suffix not in TWIN_SUFFIXES:
        raise UnknownNameError(path, path.suffix or path.name, TWIN_SUFFIXES)
    if suffix not in GAUSSIAN_SUFFIXES and (joint is not None or time_s is not None):
        option = "--time" if joint is None else "--joint"
        known = ", ".join(GAUSSIAN_SUFFIXES)
        raise ConfigError(option, f"has no meaning for {suffix}", f"it is for a state: {known}; leave it out")
    _require_package(suffix)
    writes_physics = suffix in (*USD_SUFFIXES, MJCF)
    if suffix == MJCF and episode is None:
        episode = first_episode(results)
    require_stage(results, "replacement" if writes_physics or episode is not None else "twin")
    motion = open_motion(results, episode)
    write_motion(results, motion, path, joint=joint, time_s=time_s)
    what = "the recorded demonstration" if episode is None else f"episode {episode}"
    return f"{what}, {len(motion.trajectory)} frames, {len(motion.twin.gaussians)} Gaussians"


def write_motion(
    results: Results,
    motion: SceneMotion,
    path: Path,
    *,
    joint: float | None = None,
    time_s: float | None = None,
) -> None:
    """Write a motion in the format of a known suffix; arguments as in `export_twin`."""
    suffix = path.suffix.lower()
    if suffix in GAUSSIAN_SUFFIXES:
        from aomgen.exports.posed_gaussians import write_posed_gaussians

        write_posed_gaussians(motion, path, joint=joint, time_s=time_s)
    elif suffix in USD_SUFFIXES:
        from aomgen.exports.usd_scene import write_usd_scene

        write_usd_scene(results, motion, path)
    elif suffix == MJCF:
        from aomgen.exports.mjcf_scene import write_mjcf

        write_mjcf(results, motion, path)
    elif suffix == RERUN:
        from aomgen.exports.rerun_recording import write_rerun

        write_rerun(motion, path)
    else:
        from aomgen.exports.mcap_recording import write_mcap

        write_mcap(motion, path)


def _require_package(suffix: str) -> None:
    """Refuse a suffix whose package is missing."""
    module, extra = PACKAGES.get(suffix, ("", ""))
    if module and importlib.util.find_spec(module) is None:
        raise BackendError(module, "is not installed", f"pip install 'aomgen[{extra}]'")
