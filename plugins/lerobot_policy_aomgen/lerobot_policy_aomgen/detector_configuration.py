"""Settings of the policies that contain a finder."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode


@dataclass
class DetectorConfig(PreTrainedConfig):
    """Settings of a policy that detects keypoints in images of calibrated cameras.

    Attributes:
        suite: File of a suite, whose cameras and arm the policy uses; required to create a policy.
        cameras: Names of the cameras that the policy uses, at least two; by default all cameras of the suite.
        geometry: JSON of the geometry of the suite, stored by the policy.
        finder_settings: JSON list of the settings of the finders that the policy contains, stored by the policy.
    """

    suite: str = ""
    cameras: list[str] = field(default_factory=list)
    geometry: str = ""
    finder_settings: str = ""
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )
