"""Settings of the policy with a finder, as `lerobot-train` takes them from its command line."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_policy_aomgen.chunk_configuration import ChunkConfig

# A chunk that begins this number of frames before an observation begins at the first frame of its episode: LeRobot repeats it.
FIRST_FRAME = -100_000
# Numbers of an action: position, quaternion wxyz, gripper.
POSE_SIZE = 8
REMEDY = "export the dataset with --format lerobot-v3 --media keypoints --actions ee_absolute"


@PreTrainedConfig.register_subclass("handle_act")
@dataclass
class HandleACTConfig(ChunkConfig):
    """A finder locates handle and joint axis in all cameras; a small network predicts end effector poses from the points.

    The finder is trained before, on labelled images. The network is trained on the true points of demonstrations with the
    errors that were measured for the finder.

    The settings of chunks and optimizer are those of `ChunkConfig`.

    Attributes:
        finder: File of the finder; needed when a training begins, afterwards the policy contains it.
        suite: File of a suite, whose cameras and arm the policy uses; needed when a training begins. The demonstrations may
            have no images.
        cameras: Names of the cameras that the policy uses, at least two; by default all of the suite. Without the wrist
            camera, for example, for an ablation.
        geometry, finder_settings: JSON that the policy keeps of suite and finder.
        hidden_dim, n_layers: Size of the network.
        pose_noise_m, pose_noise_rad: Standard deviation of the changes of the end effector's pose in training, so that the
            policy returns to the path after a deviation.
    """

    finder: str = ""
    suite: str = ""
    cameras: list[str] = field(default_factory=list)
    geometry: str = ""
    finder_settings: str = ""
    hidden_dim: int = 384
    n_layers: int = 3
    pose_noise_m: float = 0.005
    pose_noise_rad: float = 0.02
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )

    def validate_features(self) -> None:
        """Raises ValueError without poses as actions, or if a training begins without keypoints, finder or suite."""
        if self.action_feature is None or self.action_feature.shape != (POSE_SIZE,):
            raise ValueError(f"actions are no poses: {REMEDY}")
        if self.robot_state_feature is None:
            raise ValueError("the dataset needs the feature observation.state")
        if self.geometry:
            return
        if OBS_ENV_STATE not in (self.input_features or {}):
            raise ValueError(f"the dataset has no keypoints: {REMEDY}")
        if not (self.finder and self.suite):
            raise ValueError("add --policy.finder=finder.safetensors --policy.suite=suite.json")

    @property
    def observation_delta_indices(self) -> list[int]:
        """First frame of the episode, and now."""
        return [FIRST_FRAME, 0]
