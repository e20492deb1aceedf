"""The twin as a Gymnasium environment: importing this module registers `aomgen/Open-v0`.

```
import aomgen.evaluation.environment
env = gymnasium.make("aomgen/Open-v0", suite="suite.json")
```
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.errors import BackendError, ConfigError, UnknownNameError
from aomgen.evaluation.rollout import Rollout, World
from aomgen.evaluation.suite import open_suite
from aomgen.evaluation.views import VISUALS, Visuals

try:
    import gymnasium
except ImportError as error:
    raise BackendError("gymnasium", "is not installed", "pip install 'aomgen[env]'") from error

ENV_ID: Final = "aomgen/Open-v0"


class OpenEnv(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    """Trials of a suite. An episode ends when the object stays open, when the trial has failed, or at the time limit.

    The reward is 1 in the step that succeeds, else 0. Every `info` contains `is_success`, `opening_share`,
    `fail_reason` (empty unless the trial has failed) and `trial`.

    Args:
        suite: File of a suite, or an open world.
        visuals: "splat", or "simulator" for MuJoCo's renderer.
        render_mode: In the mode "rgb_array", `render` returns the image of the first camera.

    Attributes:
        task, task_description: Language instruction.

    Raises:
        ConfigError: The visuals are unknown, or the suite belongs to another twin.
        AomgenError: See `open_suite`.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self, suite: str | Path | World, visuals: Visuals = "splat", render_mode: str | None = "rgb_array"
    ) -> None:
        if visuals not in VISUALS:
            raise UnknownNameError("visuals", visuals, VISUALS)
        self._world = suite if isinstance(suite, World) else World(*open_suite(Path(suite)), visuals)
        self.render_mode = render_mode
        chosen = self._world.suite
        self.task = self.task_description = chosen.task
        self.metadata = {**self.metadata, "render_fps": chosen.fps}
        self._rollout: Rollout | None = None
        self._seen: dict[str, Any] = {}
        box = gymnasium.spaces.Box
        images: dict[str, gymnasium.Space[Any]] = {
            name: box(0, 255, (camera.height, camera.width, 3), np.uint8)
            for name, camera in chosen.cameras.items()
        }
        state = box(-np.inf, np.inf, (len(chosen.joint_names) + 1,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            {"pixels": gymnasium.spaces.Dict(images), "agent_pos": state}
        )
        self.action_space = box(-np.inf, np.inf, (chosen.action_size,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin the trial `options["trial"]`, or one sampled with the seed.

        Raises:
            ConfigError: The suite has no such trial.
        """
        super().reset(seed=seed)
        count = len(self._world.suite.trials)
        number = (options or {}).get("trial")
        if number is None:
            number = int(self.np_random.integers(count))
        if not (isinstance(number, int | np.integer) and 0 <= number < count):
            raise ConfigError(
                "options['trial']", f"is {number!r}", f"expected a number from 0 to {count - 1}"
            )
        self._rollout = self._world.rollout(int(number))
        self._seen = self._rollout.observation()
        return self._seen, self._info(self._rollout)

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute an action; raises ConfigError if it has another shape."""
        rollout = self._rollout
        if rollout is None or rollout.fail_reason is not None:
            raise ConfigError("step", "was called without an active trial", "call reset first")
        rollout.step(np.asarray(action, np.float64))
        self._seen, info = rollout.observation(), self._info(rollout)
        over = rollout.fail_reason is not None
        late = over and not info["is_success"] and rollout.frame >= self._world.suite.max_frames
        return self._seen, float(info["is_success"]), over and not late, late, info

    def render(self) -> NDArray[np.uint8]:
        """Return the image (H, W, 3) of the first camera."""
        return self._seen["pixels"][next(iter(self._world.suite.cameras))]

    @staticmethod
    def _info(rollout: Rollout) -> dict[str, Any]:
        return {
            "is_success": rollout.fail_reason == "",
            "opening_share": rollout.opening_share,
            "fail_reason": rollout.fail_reason or "",
            "trial": rollout.number,
        }


gymnasium.register(id=ENV_ID, entry_point=f"{__name__}:{OpenEnv.__name__}")
