"""Detection of keypoints in the images of a policy, by a finder that the policy contains."""

import json
from dataclasses import asdict
from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_policy_aomgen.detector_configuration import DetectorConfig
from lerobot_policy_aomgen.finder import Finder, FinderSettings, load_finder
from lerobot_policy_aomgen.finder_noise import TABLE_SHAPE, tabulate_errors
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


def begin_finder(config: DetectorConfig) -> tuple[Finder, Tensor]:
    """Load the finder and its errors for a new policy, and complete the settings from suite and finder.

    The images of the cameras become inputs of the policy instead of the keypoints, which only demonstrations contain.
    """
    geometry = read_geometry(Path(config.suite), config.cameras)
    finder, errors = load_finder(Path(config.finder))
    config.geometry = json.dumps(geometry)
    config.finder_settings = json.dumps(asdict(finder.settings))
    width, height = geometry["size"]
    image = PolicyFeature(FeatureType.VISUAL, (3, height, width))
    state = PolicyFeature(FeatureType.STATE, (len(geometry["screws"]) + 1,))
    config.input_features = {
        OBS_STATE: state,
        **{f"{OBS_IMAGES}.{name}": image for name in geometry["K"]},
    }
    return finder, tabulate_errors(errors, list(geometry["K"]))


def continue_finder(config: DetectorConfig) -> tuple[Finder, Tensor]:
    """Create a finder and a table of errors, whose values are then loaded from a checkpoint."""
    cameras = len(json.loads(config.geometry)["K"])
    finder = Finder(FinderSettings(**json.loads(config.finder_settings)))
    return finder, torch.zeros(cameras, *TABLE_SHAPE)
