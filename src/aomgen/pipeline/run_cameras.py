"""The cameras of a run by their names: of the demonstration, of the episodes, of the scan."""

from aomgen.core.camera import Camera
from aomgen.core.project import Project
from aomgen.errors import ConfigError
from aomgen.pipeline.stage import results_of
from aomgen.pipeline.stages import STAGES


def find_camera(project: Project, name: str) -> Camera:
    """A camera of a run, world frame.

    Args:
        project: Of a run that has its twin.
        name: Of a fixed camera of the demonstration, of a camera of the episodes, or of a scan image. A
            name that demonstration and episodes share means the demonstration's, at the video's size.

    Raises:
        ConfigError: No such camera; lists the known ones.
    """
    results = results_of(project, STAGES)
    scan = results.scan_cameras
    made = results.episode_scene.cameras if results.folders["replacement"].is_dir() else {}
    fixed = made | {key: item.camera for key, item in results.alignment.cameras.items()}
    known = scan | fixed
    if name not in known:
        images = sorted(scan)
        raise ConfigError(
            "--camera",
            f"'{name}' is no camera of this run",
            f"known: {', '.join(fixed)}, and scan images from {images[0]} to {images[-1]}; or give a .json file",
        )
    return known[name]
