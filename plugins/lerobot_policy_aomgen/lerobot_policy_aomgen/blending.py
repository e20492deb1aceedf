"""Execution of predicted chunks: a few actions of each are blended with the predictions of the preceding chunk."""

from collections import deque
from collections.abc import Callable

import torch
from torch import Tensor


class ChunkBlender:
    """Sequence of actions from overlapping chunks.

    The predictions of consecutive chunks differ by millimeters. A step of this size would cause large torques in an arm that
    holds a handle, so the actions change gradually from the preceding chunk to the new one.

    Args:
        steps: Number of actions that are executed before the next prediction.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._left: deque[Tensor] = deque(maxlen=steps)
        # Predictions of the last chunk for the steps after those in `_left`.
        self._ahead: Tensor | None = None

    def next_action(self, predict: Callable[[], Tensor]) -> Tensor:
        """Return the next action (B, A); call `predict` for a new chunk (B, N, A) after `steps` actions."""
        if not self._left:
            chunk, count = predict(), self._steps
            actions, ahead = chunk[:, :count], chunk[:, count:]
            if self._ahead is not None and self._ahead.shape[1] >= count:
                share = torch.arange(1, count + 1, device=chunk.device)[:, None] / (count + 1)
                actions = share * actions + (1 - share) * self._ahead[:, :count]
            self._left.extend(actions.unbind(1))
            self._ahead = ahead
        return self._left.popleft()
