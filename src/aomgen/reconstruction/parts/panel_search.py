"""Coordinate descent over the numbers of a panel (see `panel`)."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from aomgen.conventions import MOVING
from aomgen.core.values import Array
from aomgen.reconstruction.parts.panel import Panel
from aomgen.reconstruction.parts.panel_crops import Crop

# Steps of the search, as shares of the panel's diagonal: coarse ones on fewer pixels.
COARSE_STEPS = (0.2, 0.1, 0.05, 0.025)
FINE_STEPS = (0.05, 0.025, 0.012, 0.006, 0.003)
# Most steps in one direction at once: far starts (a wall behind the object) are walked back so.
MAX_STRIDES = 50
# Thickness of the object's outer faces, in which their Gaussians scatter, as share of the panel's
# diagonal; half of it while boxes are compared, which show where the face itself is.
SKIN_SHARE = 0.02
# Of the numbers of every shape: how far handles stand out past the panel's edges.
BESIDE = slice(12, 16)
# Handles past an edge are looked for up to this share of the panel's diagonal; masks of every prompted view
# have to agree better with one, by this loss (0.6 % of the mask): one view alone takes other things for it.
MAX_BESIDE_SHARE, BESIDE_STEP_SHARE = 0.15, 0.01
BESIDE_GAIN = 0.003
# Price of size, so that edges lie on the outermost points and not somewhere in the air beyond.
SIZE_PRICE = 0.03


class Shapes(Protocol):
    """What the numbers of a shape mean."""

    @property
    def size(self) -> float:
        """Diagonal of the panel, [m]."""
        ...

    def panel(self, shape: Array, skin_m: float) -> Panel:
        """The panel of a shape, the object's outer faces that thick."""
        ...

    def extent(self, shape: Array) -> float:
        """Sum of all sizes, [m]; infinite where a shape is impossible."""
        ...

    def trials(self, shape: Array, step_m: float) -> list[Array]:
        """The shapes one step away."""
        ...

    def bounded(self, shape: Array) -> Array:
        """The possible shape nearest to this one."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """Finds the shape that explains prompted images."""

    shapes: Shapes

    def panel(self, shape: Array) -> Panel:
        """As compared with boxes: half a skin thick."""
        return self.shapes.panel(shape, 0.5 * SKIN_SHARE * self.shapes.size)

    def result(self, shape: Array) -> Panel:
        """As Gaussians are labelled."""
        return self.shapes.panel(shape, SKIN_SHARE * self.shapes.size)

    def loss(self, shape: Array, crops: list[Crop]) -> float:
        """Misfit to all images, and a little for size."""
        extent = self.shapes.extent(shape)
        if not np.isfinite(extent):
            return np.inf
        panel = self.panel(shape)
        return sum(crop.loss(panel) for crop in crops) + SIZE_PRICE * extent / self.shapes.size

    def descend(self, shape: Array, crops: list[Crop], steps: tuple[float, ...]) -> tuple[Array, float]:
        """The best shape that steps lead to, each a share of the panel's diagonal, and its loss."""
        best = self.loss(shape, crops)
        for step in self.shapes.size * np.array(steps):
            for _ in range(4):
                before = best
                for trial in self.shapes.trials(shape, step):
                    for _ in range(MAX_STRIDES):
                        moved = self.shapes.bounded(shape + trial)
                        loss = self.loss(moved, crops)
                        if not loss < best - 1e-4:
                            break
                        shape, best = moved, loss
                if not best < before:
                    break
        return shape, best

    def with_handles(self, shape: Array, crops: list[Crop]) -> Array:
        """The shape with handles past the panel's edges where the masks of every view show one."""
        moving = [crop for crop in crops if crop.part == MOVING]
        steps = np.arange(BESIDE_STEP_SHARE, MAX_BESIDE_SHARE, BESIDE_STEP_SHARE) * self.shapes.size
        for edge in range(BESIDE.start, BESIDE.stop):
            before = np.array([crop.loss(self.panel(shape)) for crop in moving])
            best, found = self.loss(shape, crops), shape
            for step in steps:
                wider = shape.copy()
                wider[edge] = step
                gains = before - [crop.loss(self.panel(wider)) for crop in moving]
                loss = self.loss(wider, crops)
                if loss < best and (gains > BESIDE_GAIN).all():
                    best, found = loss, wider
            shape = found
        return shape
