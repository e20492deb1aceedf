"""Policies that run on another machine, `openpi://HOST:PORT` and `openvla://HOST:PORT`, trained as in `recipes/`.

A server returns one action or a chunk of them; it is called again when they are used up.
"""

import re
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from aomgen.core.demonstration import Kinematics
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.datasets.features import ee_deltas, ee_targets
from aomgen.errors import ConfigError, PolicyServerError, UnknownNameError
from aomgen.evaluation.policy_servers import NUMBERS, OpenpiServer, OpenvlaServer
from aomgen.evaluation.suite import Suite
from aomgen.pipeline.manifest import text_digest

SCHEMES: Final = ("openpi", "openvla")
_NAME: Final = re.compile(r"([a-z]+)://([\w.-]+|\[[0-9a-fA-F:.]+\]):([0-9]{1,5})(?:/([\w.+-]+))?")
# Size of OpenVLA's actions (a motion and the gripper), and number of joints in its state.
OPENVLA_ACTION, OPENVLA_JOINTS = 7, 7
# Keys in the metadata of the recipes' policies, see recipes/pi05_openpi.py.
ACTION_SPACE, CAMERAS = "action_space", "cameras"
Ask = Callable[[Mapping[str, Any]], Array]
Convert = Callable[[Array, Array], Array]


class RemotePolicy:
    """Policy that executes a server's chunks of actions.

    Args:
        ask: Returns a chunk (T, D) for an observation.
        conversion: Creates for each trial a function that converts an action of a chunk and the measured state into the
            environment's action.
        digest: SHA-256 of what the server states about its policy; empty if it states nothing.
    """

    points_world: Array | None = None

    def __init__(self, ask: Ask, conversion: Callable[[], Convert], digest: str = "") -> None:
        self._ask, self._conversion, self.digest = ask, conversion, digest
        self._convert, self._left = conversion(), deque[Array]()

    def reset(self, rollout: object) -> None:
        """Discard the state of the last trial."""
        self._convert = self._conversion()
        self._left.clear()

    def looks(self, frame: int) -> bool:
        """Return whether the last chunk is used up."""
        return not self._left

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the next action (D,).

        Raises:
            PolicyServerError: The server is unreachable, failed, or returned no actions.
        """
        if not self._left:
            self._left.extend(self._ask(observation))
        return self._convert(self._left.popleft(), np.asarray(observation["agent_pos"], np.float64))


def open_remote(name: str, suite: Suite, robot: Kinematics) -> RemotePolicy:
    """Connect to the policy at an address; it has to be compatible with a suite and its robot.

    Raises:
        ConfigError: The address is invalid, or the policy has another action space or other cameras.
        BackendError: A library is missing.
        PolicyServerError: The server is unreachable or incompatible.
    """
    found = _NAME.fullmatch(name)
    if not found or not 0 < int(found[3]) < 1 << 16:
        raise ConfigError(
            "--policy", f"'{name}' is not the address of a server", "expected openpi://HOST:PORT"
        )
    scheme, address, dataset = found[1], f"{found[2]}:{found[3]}", found[4]
    if scheme not in SCHEMES:
        raise UnknownNameError("--policy", scheme, SCHEMES)
    if scheme == "openvla":
        return _open_openvla(address, dataset, suite, robot)
    if dataset:
        raise ConfigError(
            "--policy",
            f"'{name}' names a dataset",
            "an openpi server has one dataset; use openpi://HOST:PORT",
        )
    return _open_openpi(address, suite)


def _open_openpi(address: str, suite: Suite) -> RemotePolicy:
    server, where = OpenpiServer(address), f"openpi://{address}"
    space, cameras = (server.metadata.get(name) for name in (ACTION_SPACE, CAMERAS))
    if space is None or not isinstance(cameras, list):
        raise PolicyServerError(
            where,
            "does not state on which data its policy was trained",
            "serve a config of recipes/pi05_openpi.py",
        )
    _require_space(where, str(space), suite)
    if missing := [str(name) for name in cameras if name not in suite.cameras]:
        raise ConfigError(
            where, f"requires the camera {missing[0]}", f"the suite has {', '.join(suite.cameras)}"
        )

    def ask(observation: Mapping[str, Any]) -> Array:
        images = {name: observation["pixels"][name] for name in cameras}
        answer = server.infer({"images": images, "state": observation["agent_pos"], "prompt": suite.task})
        return _chunk(where, answer.get("actions"), len(observation["agent_pos"]))

    return RemotePolicy(ask, lambda: lambda action, _: action, text_digest(repr(server.metadata)))


def _open_openvla(address: str, dataset: str | None, suite: Suite, robot: Kinematics) -> RemotePolicy:
    """Connect to OpenVLA's server; `dataset` selects the statistics of a checkpoint that scale its actions."""
    where, joints = f"openvla://{address}", len(suite.joint_names)
    _require_space(where, "ee_delta", suite)
    if not joints <= OPENVLA_JOINTS:
        raise ConfigError(where, f"supports {OPENVLA_JOINTS} joints, the arm has {joints}", "use openpi")
    server, camera = OpenvlaServer(address), next(iter(suite.cameras))

    def ask(observation: Mapping[str, Any]) -> Array:
        image, measured = observation["pixels"][camera], observation["agent_pos"]
        state = np.zeros(OPENVLA_JOINTS + 1, np.float32)
        state[:joints], state[-1] = measured[:-1], 1 - measured[-1]
        # OpenVLA reads "image"; OpenVLA-OFT reads "full_image" and "state".
        payload = {"image": image, "full_image": image, "state": state, "instruction": suite.task}
        payload |= {"unnorm_key": dataset} if dataset else {}
        return _chunk(where, server.act(payload), OPENVLA_ACTION)

    return RemotePolicy(ask, lambda: make_openvla_conversion(robot))


def _require_space(where: str, space: str, suite: Suite) -> None:
    if space != suite.action_space:
        raise ConfigError(
            where, f"acts in {space}, the suite's actions are {suite.action_space}", f"pass --actions {space}"
        )


def _chunk(where: str, answer: Any, size: int) -> Array:
    """Read the actions (T, size) of a response, also a single one; the environment checks whether they are finite.

    Raises:
        PolicyServerError: The response contains no actions, or they have another shape.
    """
    try:
        actions = np.atleast_2d(np.asarray(answer))
    except ValueError:
        actions = np.zeros(0, object)
    if actions.dtype.kind not in NUMBERS:
        raise PolicyServerError(where, "sent a reply without actions", "is it another server?")
    if not len(actions) or actions.shape[1:] != (size,):
        raise PolicyServerError(
            where,
            f"sent actions of shape {actions.shape}",
            f"expected (N, {size}): is it another robot's policy?",
        )
    return actions.astype(np.float64)


def make_openvla_conversion(robot: Kinematics) -> Convert:
    """Make the conversion of OpenVLA's actions of one trial, which are relative to the previous target, to `ee_delta`.

    The first action (7,) is relative to the measured joints and gripper (J + 1,).
    """
    T_world_last: Array | None = None

    def convert(action: Array, measured: Array) -> Array:
        nonlocal T_world_last
        last = robot.ee_poses(measured[None, :-1])[0] if T_world_last is None else T_world_last
        delta = delta_of_openvla(action, last)
        T_world_last = ee_targets(last[None], delta[None, :6])[0]
        return delta

    return convert


def delta_of_openvla(action: Array, T_world_last: Array) -> Array:
    """Convert OpenVLA's action (7,) to `ee_delta` (7,), both relative to the target T_world_last (4, 4).

    OpenVLA's action uses the axes of the world, roll, pitch and yaw, and 1 for an open gripper; see `datasets.rlds`.
    """
    roll, pitch, yaw = (
        matrix_from_rotvec(angle * axis) for angle, axis in zip(action[3:6], np.eye(3), strict=True)
    )
    T_world_target = transform(yaw @ pitch @ roll @ T_world_last[:3, :3], T_world_last[:3, 3] + action[:3])
    return np.append(ee_deltas(T_world_last[None], T_world_target[None])[0], 1 - action[6])
