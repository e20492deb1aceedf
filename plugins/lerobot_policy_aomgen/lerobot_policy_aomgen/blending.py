"""Execution of predicted chunks: a few actions of each, blended with what the last chunk predicted for them."""

from collections import deque
from collections.abc import Callable

import torch
from torch import Tensor


class ChunkBlender:
    """Actions of overlapping chunks, one after the other.

    Predictions differ by millimetres, and an arm that holds a handle follows steps of millimetres with all its torque. The
    actions therefore change gradually from the last chunk to the new one.

    Args:
        steps: Number of actions that are executed before the next prediction.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._left: deque[Tensor] = deque(maxlen=steps)
        # The last chunk's prediction of the steps after those.
        self._ahead: Tensor | None = None

    def next_action(self, predict: Callable[[], Tensor]) -> Tensor:
        """The next action (B, A); a new chunk (B, N, A) is predicted when the actions of the last one are used up."""
        if not self._left:
            chunk, count = predict(), self._steps
            actions, ahead = chunk[:, :count], chunk[:, count:]
            if self._ahead is not None and self._ahead.shape[1] >= count:
                share = torch.arange(1, count + 1, device=chunk.device)[:, None] / (count + 1)
                actions = share * actions + (1 - share) * self._ahead[:, :count]
            self._left.extend(actions.unbind(1))
            self._ahead = ahead
        return self._left.popleft()
