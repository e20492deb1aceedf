"""How the recording's cameras show light: the brighter, the more they compress it, and the more color is lost."""

from typing import Final, NamedTuple

import numpy as np

from aomgen.core.values import Array

# Light is told from what pictures show up to this share of the brightest that a curve shows at all.
BRIGHTEST: Final = 0.95


class ToneCurve(NamedTuple):
    """From light to what pictures show, both linear, dark light as it is.

    Attributes:
        shoulder: How much brightness is compressed, 0 or more: light of 1 is shown as 1 / (1 + shoulder).
        color_loss: Share of its distance from grey that a color as bright as white loses, below 1; darker ones lose less
            in proportion.
    """

    shoulder: float = 0.0
    color_loss: float = 0.0

    def show(self, light: Array) -> Array:
        """Colors (..., 3) that pictures show of light."""
        positive = np.maximum(light, 0)
        bent = positive / (1 + self.shoulder * positive)
        grey = bent.mean(-1, keepdims=True)
        return np.asarray(grey + self._kept(grey) * (bent - grey), np.float64)

    def undo(self, shown: Array) -> Array:
        """Light (..., 3) of which pictures show colors."""
        grey = shown.mean(-1, keepdims=True)
        bent = np.maximum(grey + (shown - grey) / self._kept(grey), 0)
        return np.asarray(bent / (1 - np.minimum(self.shoulder * bent, BRIGHTEST)), np.float64)

    def _kept(self, grey: Array) -> Array:
        return 1 - self.color_loss * np.minimum(grey, 1)
