"""How the recording's cameras show brightness and color: a power of it, and the brighter the less colorful."""

from typing import NamedTuple

import numpy as np

from aomgen.core.values import Array


class ToneCurve(NamedTuple):
    """From light to what pictures show, both linear, 1 = white.

    Attributes:
        gamma: Power of the light; below 1 contrasts are flattened.
        color_loss: Share of its distance from grey that a color as bright as white loses, below 1; darker ones lose less
            in proportion.
    """

    gamma: float = 1.0
    color_loss: float = 0.0

    def show(self, light: Array) -> Array:
        """Colors (..., 3) that pictures show of light."""
        powered = np.maximum(light, 0) ** self.gamma
        grey = powered.mean(-1, keepdims=True)
        return np.asarray(grey + self._kept(grey) * (powered - grey), np.float64)

    def undo(self, shown: Array) -> Array:
        """Light (..., 3) of which pictures show colors."""
        grey = shown.mean(-1, keepdims=True)
        colorful = grey + (shown - grey) / self._kept(grey)
        return np.asarray(np.maximum(colorful, 0) ** (1 / self.gamma), np.float64)

    def _kept(self, grey: Array) -> Array:
        return 1 - self.color_loss * np.minimum(grey, 1)
