"""A generated demonstration as an immutable value."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.joint import Joint
from aomgen.core.keypoints import KEYPOINTS
from aomgen.core.values import Array, freeze_arrays

PHASES: Final = ("approach", "contact", "retreat")
FINGERS: Final = ("left", "right")
# Name of the camera of an episode that is added to the recorded one.
NEW_CAMERA: Final = "side"


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactLog:
    """Finger contacts of an episode, one row for each contact, ordered by frame.

    Attributes:
        frames: Frame index of each contact (C,).
        fingers: Index into `FINGERS` (C,).
        points_world: Contact points (C, 3), [m].
        normals_world: Unit normals (C, 3), from the object toward the finger.
        forces: Normal forces (C,), [N].
    """

    frames: Annotated[NDArray[np.int64], "C"]
    fingers: Annotated[NDArray[np.int64], "C"]
    points_world: Annotated[Array, "C 3"]
    normals_world: Annotated[Array, "C 3"]
    forces: Annotated[Array, "C"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode(SceneTrajectory):
    """All data of one demonstration except its images, with T frames at a constant rate and J arm joints.

    Inherited fields hold the states that the robot has reached at frame t. An action at frame t is the robot's target for
    frame t + 1; at the last frame, it is the target that the robot holds.

    Attributes:
        index: Number of the variation that this episode renders, and of its folder.
        seed: Seed of the generation.
        instruction: Language instruction.
        robot: Robot model, for example "ur5e_2f85".
        asset: Name of the articulated object.
        asset_usd: Path of its USD file, relative to the episode's folder.
        joint_names: Names of the J arm joints.
        fps: Frames per second.
        action_joints: Target joints (T, J), [rad] or [m].
        action_gripper: Target gripper (T,), 0 open .. 1 closed.
        Ts_world_ee, Ts_world_ee_action: Reached and target end-effector poses (T, 4, 4).
        phases: Index into `PHASES` (T,).
        contacts: Finger contacts.
        joint: The object's joint, world frame, at the object's pose in this episode.
        keypoints: Positions of `core.keypoints.KEYPOINTS` (5, 3) at joint value 0, world frame, [m].
        cameras: Camera of each video, by name; a moving camera has its first pose.
        verdict: Results of the verification, as JSON values.
        simulation: Assumptions of the verification about object and control, as JSON values.
        camera_poses: Poses T_world_cam (T, 4, 4) of the moving cameras, by name.
        visible: Mask (T, 5) of the keypoints that are visible to each camera, by name; empty before the images are rendered.
    """

    index: int
    seed: int
    instruction: str
    robot: str
    asset: str
    asset_usd: str
    joint_names: Annotated[tuple[str, ...], "J"]
    fps: int
    action_joints: Annotated[Array, "T J"]
    action_gripper: Annotated[Array, "T"]
    Ts_world_ee: Annotated[Array, "T 4 4"]
    Ts_world_ee_action: Annotated[Array, "T 4 4"]
    phases: Annotated[NDArray[np.int64], "T"]
    contacts: ContactLog
    joint: Joint
    keypoints: Annotated[Array, "5 3"]
    cameras: Mapping[str, Camera]
    verdict: Mapping[str, Any]
    simulation: Mapping[str, Any]
    camera_poses: Mapping[str, Array] = field(default_factory=dict)
    visible: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze_arrays(self)
        for name, Ts in self.camera_poses.items():
            if name not in self.cameras or np.shape(Ts) != (len(self), 4, 4):
                raise ValueError(f"Episode.camera_poses of {name} have shape {np.shape(Ts)}, or no camera")
        for name, shown in self.visible.items():
            if name not in self.cameras or np.shape(shown) != (len(self), len(KEYPOINTS)):
                raise ValueError(f"Episode.visible of {name} has shape {np.shape(shown)}, or no camera")

    def camera_at(self, name: str, frame: int) -> Camera:
        """Return a camera with its pose at a frame."""
        poses = self.camera_poses.get(name)
        return self.cameras[name] if poses is None else self.cameras[name].move(poses[frame])
