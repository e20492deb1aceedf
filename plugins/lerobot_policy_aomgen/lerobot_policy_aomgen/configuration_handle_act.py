"""Settings of the policy `handle_act`, which `lerobot-train` reads from its command line."""

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_policy_aomgen.chunk_configuration import ChunkConfig
from lerobot_policy_aomgen.detector_configuration import DetectorConfig

# Offset of the first frame of an episode: LeRobot clips offsets of frames to the episode, so that any large one refers to it.
FIRST_FRAME = -100_000
# Size of an action: position, quaternion wxyz, gripper.
POSE_SIZE = 8
REMEDY = "export the dataset with --format lerobot-v3 --media keypoints --actions ee_absolute"


@PreTrainedConfig.register_subclass("handle_act")
@dataclass
class HandleACTConfig(ChunkConfig, DetectorConfig):
    """Settings of a policy in which a finder locates handle and joint axis, and a network predicts end effector poses.

    The finder locates the points in the images of all cameras; it is trained separately on labeled images. The network receives
    the points; it is trained on the true points of demonstrations, to which measured errors of the finder are added.

    The demonstrations may have no images. Further settings are those of `ChunkConfig` and `DetectorConfig`.

    Attributes:
        finder: File of the finder; required to create a policy. Afterwards the policy contains the finder.
        hidden_dim, n_layers: Width and number of the hidden layers of the network.
        pose_noise_m, pose_noise_rad: Standard deviations of the noise of the end effector's pose in training, which teaches
            the policy to return to the path after a deviation.
    """

    finder: str = ""
    hidden_dim: int = 384
    n_layers: int = 3
    pose_noise_m: float = 0.005
    pose_noise_rad: float = 0.02

    def validate_features(self) -> None:
        """Check the features of the dataset.

        Raises:
            ValueError: Actions are not poses, the state is missing, or a training starts without keypoints, finder or suite.
        """
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
        """Offsets of the observed frames: first frame of the episode, and current frame."""
        return [FIRST_FRAME, 0]
