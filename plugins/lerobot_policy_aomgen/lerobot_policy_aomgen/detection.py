"""Detection of keypoints in the images of a policy, by finders that the policy contains."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_policy_aomgen.detector_configuration import DetectorConfig
from lerobot_policy_aomgen.finder import Finder, FinderErrors, FinderSettings, load_finder
from lerobot_policy_aomgen.geometry import Geometry, pose_end_effector, pose_views, read_geometry
from lerobot_policy_aomgen.lifting import Views


@torch.no_grad()
def detect_points(
    finder: Finder, geometry: Geometry, batch: dict[str, Tensor]
) -> tuple[Views, Tensor, Tensor]:
    """Detect the keypoints in the images of a batch.

    Returns:
        Views of the C cameras, pixels (B, C, P, 2) and their standard deviations (B, C, P), [px].
    """
    cameras = list(geometry["K"])
    images = torch.stack([batch[f"{OBS_IMAGES}.{name}"] for name in cameras], 1)
    pixels, spreads = finder.find(images.flatten(0, 1))
    views = pose_views(geometry, cameras, pose_end_effector(geometry, batch[OBS_STATE][:, :-1]))
    shape = images.shape[:2]
    return views, pixels.unflatten(0, shape), spreads.unflatten(0, shape)


def open_finders(config: DetectorConfig, files: Sequence[str]) -> tuple[list[Finder], list[FinderErrors]]:
    """Read the finders of a new policy and their errors, and complete its settings from suite and finders.

    The images of the cameras become inputs of the policy instead of the keypoints, which only demonstrations contain.
    """
    geometry = read_geometry(Path(config.suite), config.cameras)
    finders, errors = zip(*(load_finder(Path(file)) for file in files), strict=True)
    config.geometry = json.dumps(geometry)
    config.finder_settings = json.dumps([asdict(finder.settings) for finder in finders])
    width, height = geometry["size"]
    image = PolicyFeature(FeatureType.VISUAL, (3, height, width))
    state = PolicyFeature(FeatureType.STATE, (len(geometry["screws"]) + 1,))
    config.input_features = {
        OBS_STATE: state,
        **{f"{OBS_IMAGES}.{name}": image for name in geometry["K"]},
    }
    return list(finders), list(errors)


def create_finders(config: DetectorConfig) -> list[Finder]:
    """Create the finders of a stored policy, whose weights are then loaded from its checkpoint."""
    return [Finder(FinderSettings(**settings)) for settings in json.loads(config.finder_settings)]
