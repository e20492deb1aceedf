"""Settings of the policies that contain a finder."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode


@dataclass
class DetectorConfig(PreTrainedConfig):
    """Settings of a policy that detects keypoints in images of calibrated cameras.

    Attributes:
        finder: File of the finder; required to create a policy. Afterwards the policy contains the finder.
        suite: File of a suite, whose cameras and arm the policy uses; required to create a policy.
        cameras: Names of the cameras that the policy uses, at least two; by default all cameras of the suite.
        geometry, finder_settings: JSON of the geometry of the suite and of the settings of the finder, stored by the policy.
    """

    finder: str = ""
    suite: str = ""
    cameras: list[str] = field(default_factory=list)
    geometry: str = ""
    finder_settings: str = ""
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )
