"""The unknowns of the photometric refinement, their prior, and its solution."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.joint import Joint
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.motion.kinematic_prior import KinematicPrior
from aomgen.motion.part_renderer import PartRenderer
from aomgen.motion.photometric_residuals import (
    BLOCKS,
    Band,
    LinearizedFrame,
    choose_steps,
    linearize_frame,
    shift_joint,
)

# Independent part of the values' deviations, as share of their variance.
_ROUGHNESS = 0.05
# Deviations of the values are alike over this share of the motion's duration.
_ALIKE_SHARE = 0.5
# The scan's shape and the cameras' poses are known to a fraction of a pixel: smooth displacements of
# the picture by this much are no evidence, [px]. They persist, so all frames have about two of them.
_DISTORTION_PX = 0.1
# Independent displacements in all frames together.
_INDEPENDENT_FRAMES = 2.0
# Before it is measured.
_FIRST_REPETITION = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometricProblem:
    """What the hand says as a prior on n numbers of the joint and K deviations of its values.

    Attributes:
        renderer: The video and the painted part.
        hand: First answer.
        frames: Knots (K,), video frames.
        pivot: Point of the axis nearest the held point (3,), world frame, [m].
        lever: Change of the values (T, n) with the joint's numbers when the hand's path stays.
        spread: Change of the values (T, K) with the deviations.
        precision: Of the prior (n + K, n + K).
    """

    renderer: PartRenderer
    hand: KinematicPrior
    frames: NDArray[np.intp]
    pivot: Array
    lever: Array
    spread: Array
    precision: Array
    distortion_px: float

    @staticmethod
    def of(renderer: PartRenderer, hand: KinematicPrior, frames: NDArray[np.intp]) -> "PhotometricProblem":
        """Set up the prior."""
        joint = hand.joint
        pivot = joint.origin + joint.axis * ((hand.held_world - joint.origin) @ joint.axis)
        begin, end = hand.interval
        moments = np.clip(hand.times_s, begin, end)
        length = _ALIKE_SHARE * (end - begin)
        alike = np.exp(-0.5 * ((moments[:, None] - moments[frames]) / length) ** 2)
        own = np.linalg.inv(alike[frames] + _ROUGHNESS * np.eye(len(frames)))
        during = (hand.thetas > 0) | (hand.times_s >= begin)
        count = len(hand.covariance)
        precision = np.zeros((count + len(frames),) * 2)
        precision[:count, :count] = np.linalg.inv(hand.covariance)
        precision[count:, count:] = own
        return PhotometricProblem(
            renderer=renderer,
            hand=hand,
            frames=frames,
            pivot=pivot,
            lever=compute_value_lever(hand, pivot) * during[:, None],
            spread=np.asarray((hand.theta_sd * during)[:, None] * (alike @ own), np.float64),
            precision=precision,
            distortion_px=_DISTORTION_PX * np.sqrt(len(frames) / _INDEPENDENT_FRAMES),
        )

    @property
    def joint_count(self) -> int:
        """Numbers of the joint n."""
        return self.lever.shape[1]

    def joint(self, y: Array) -> Joint:
        """The joint of unknowns (n + K,)."""
        return shift_joint(self.hand.joint, self.pivot, y[: self.joint_count])

    def thetas(self, y: Array) -> Array:
        """Values (T,) of unknowns (n + K,)."""
        count = self.joint_count
        return self.hand.thetas + self.lever @ y[:count] + self.spread @ y[count:]

    def solve(self, bands: tuple[Band, ...], rounds: int) -> tuple[Array, Array]:
        """Unknowns (n + K,) and their covariance."""
        y = np.zeros(self.joint_count + len(self.frames))
        total, repetition = self.precision, _FIRST_REPETITION
        for band in bands:
            for _ in range(rounds):
                linears = {
                    int(k): linearize_frame(self.renderer, int(k), self._neighbours(y, int(k)), band)
                    for k in self.frames
                }
                known = {frame: linear for frame, linear in linears.items() if linear is not None}
                repetition = self._repetition(known, repetition)
                information, gradient = self._normal(known, repetition)
                total = information + self.precision
                y = y + np.linalg.solve(total, gradient - self.precision @ y)
        return y, np.asarray(np.linalg.inv(total), np.float64)

    def _by_unknown(self, frame: int) -> Array:
        """Change of a frame's joint numbers and value (n + 1, n + K) by the unknowns."""
        count = self.joint_count
        change = np.zeros((count + 1, count + len(self.frames)))
        change[:count, :count] = np.eye(count)
        change[count, :count] = self.lever[frame]
        change[count, count:] = self.spread[frame]
        return change

    def _normal(self, linears: dict[int, LinearizedFrame], repetition: float) -> tuple[Array, Array]:
        """Information (n + K, n + K) and gradient (n + K,) of frames by number."""
        size = self.joint_count + len(self.frames)
        information, gradient = np.zeros((size, size)), np.zeros(size)
        for frame, linear in linears.items():
            change = self._by_unknown(frame)
            J = linear.derivatives.astype(np.float64)
            same = repetition + self.distortion_px**2 * linear.shift_information
            weight = linear.weights / (linear.scale**2 * same)
            information += change.T @ (J.T * weight @ J) @ change
            gradient += (weight * linear.residuals) @ J @ change
        return information, gradient

    def _repetition(self, linears: dict[int, LinearizedFrame], otherwise: float) -> float:
        """How many pixels say the same: variance of the squares' gradients over that of independent pixels."""
        count = self.joint_count
        sums, diagonal = np.zeros((BLOCKS, count)), np.zeros(count)
        for frame, linear in linears.items():
            J = linear.derivatives.astype(np.float64) @ self._by_unknown(frame)[:, :count]
            weight = linear.weights / linear.scale**2
            diagonal += weight @ J**2
            for index, column in enumerate((J * (weight * linear.residuals)[:, None]).T):
                sums[:, index] += np.bincount(linear.blocks, column, BLOCKS)
        if not diagonal.min(initial=np.inf) > 0:
            return otherwise
        return max(1.0, float(np.max((sums**2).sum(0) / diagonal)))

    def _neighbours(self, y: Array, frame: int) -> list[tuple[Joint, float]]:
        count = self.joint_count
        sizes = choose_steps(self.renderer, self.hand.joint)
        theta = float(self.thetas(y)[frame])
        places = [(self.joint(y), theta)]
        for index in range(count):
            x = y[:count].copy()
            x[index] += sizes[index]
            places.append((shift_joint(self.hand.joint, self.pivot, x), theta))
        places.append((self.joint(y), theta + float(sizes[count])))
        return places


def compute_value_lever(hand: KinematicPrior, pivot: Array) -> Array:
    """Change of the values (T, n) when the joint moves and the held points stay."""
    joint, count = hand.joint, len(hand.covariance)
    if joint.type == "prismatic":
        return np.zeros((len(hand.thetas), count))
    points = np.asarray(apply(joint.motion(hand.thetas), hand.held_world))

    def angles(x: Array) -> Array:
        moved = shift_joint(joint, pivot, x)
        offsets, first = points - moved.origin, hand.held_world - moved.origin
        across = np.cross(first, offsets) @ moved.axis
        along = offsets @ first - (offsets @ moved.axis) * (first @ moved.axis)
        return np.asarray(np.unwrap(np.arctan2(across, along)), np.float64)

    small = 1e-5
    lever = np.empty((len(points), count))
    for index, unit in enumerate(small * np.eye(count)):
        lever[:, index] = (angles(unit) - angles(-unit)) / (2 * small)
    return lever
