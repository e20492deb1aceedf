"""The digital twin of a recorded scene: states and rendering."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.api.arguments import require_array, require_known_keys, require_poses
from aomgen.core.camera import Camera
from aomgen.core.joint import Joint
from aomgen.errors import ConfigError
from aomgen.pipeline.rendering import render_twin
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import TwinModel as TwinModel
from aomgen.twin.twin import TwinState


@dataclass(frozen=True, slots=True)
class Twin:
    """A robot, an articulated object and their surroundings as Gaussians that move with their bodies.

    Attributes:
        model: Gaussians, bodies and joint.
        robot: Kinematics of the robot.

    Example:
        >>> twin = ag.Run.open("out").twin
        >>> twin.robot.name
        'ur5e_2f85'
        >>> twin.joint.type
        'revolute'
    """

    model: TwinModel
    robot: RobotModel

    @property
    def joint(self) -> Joint:
        """Joint of the object, object frame; value 0 is the scanned state."""
        return self.model.joint

    @property
    def scan_state(self) -> TwinState:
        """State in which the scene was scanned."""
        return self.model.scan_state

    def state(
        self,
        *,
        joints: ArrayLike | Mapping[str, float] | None = None,
        gripper: float | None = None,
        theta: float | None = None,
        T_world_object: ArrayLike | None = None,
    ) -> TwinState:
        """Return a state; arguments that are not given have their values during the scan.

        Args:
            joints: Arm joints (J,), or a dictionary of some joints by name, [rad].
            gripper: 0 open .. 1 closed.
            theta: Joint value of the object, [rad] or [m].
            T_world_object: Pose (4, 4) of the object.

        Raises:
            ShapeError, NonFiniteError, PoseError: An array has another shape, is not finite, or is not a pose.
            UnknownNameError: The robot has no joint with this name.
            ConfigError: The gripper is not within 0..1.

        Example:
            >>> twin = ag.Run.open("out").twin
            >>> twin.state(theta=0.5, joints={"elbow_joint": 1.2}).theta
            0.5
        """
        rest = self.scan_state
        if joints is None:
            joints = rest.joints
        elif isinstance(joints, Mapping):
            require_known_keys("joints", joints, self.robot.joint_names)
            measured = zip(self.robot.joint_names, rest.joints, strict=True)
            joints = [joints.get(name, value) for name, value in measured]
        closed = rest.gripper if gripper is None else float(require_array("gripper", gripper, ()))
        if not 0 <= closed <= 1:
            raise ConfigError("gripper", f"is {closed:g}", "pass 0 (open) to 1 (closed)")
        placed = rest.T_world_object if T_world_object is None else T_world_object
        return TwinState(
            joints=require_array("joints", joints, (len(self.robot.joint_names),)),
            gripper=closed,
            theta=rest.theta if theta is None else float(require_array("theta", theta, ())),
            T_world_object=require_poses("T_world_object", placed, single=True),
        )

    def render(
        self, state: TwinState, camera: Camera, size: tuple[int, int] | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]:
        """Render a state from a camera.

        Args:
            state: See `Twin.state`.
            camera: For example one of `Run.cameras`.
            size: Width and height of the image, [px]; None selects those of the camera.

        Returns:
            Image (H, W, 3) uint8 sRGB, depth (H, W) float32 [m] (0 for empty pixels), and part labels (H, W) uint8
            (0 background, 1 robot, 2 static part, 3 moving part).

        Raises:
            ShapeError: The state has another number of joints than the robot.
            PoseError: The camera's pose is not rigid.

        Example:
            >>> run = ag.Run.open("out")
            >>> image, depth, labels = run.twin.render(run.twin.state(theta=0.5), run.cameras["front"], size=(160, 120))
            >>> image.shape, depth.shape, sorted(np.unique(labels).tolist())
            ((120, 160, 3), (120, 160), [0, 1, 2, 3])
        """
        joints = require_array("state.joints", state.joints, (len(self.robot.joint_names),))
        require_poses("camera.T_world_cam", camera.T_world_cam, single=True)
        view = camera if size is None else camera.resize(*size)
        return render_twin(self.model, self.robot, view, replace(state, joints=joints))
