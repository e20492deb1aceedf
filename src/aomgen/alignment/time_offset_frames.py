"""Small frames of a video and the changes between them, for the search of its clock offset."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.robust import robust_sd
from aomgen.core.values import Array
from aomgen.errors import SyncError
from aomgen.io.images import resize
from aomgen.io.video import Video

# Distances between compared frames, in coarse steps: fast, usual and slow motion of an arm.
LAGS = (1, 3, 8)
# Share of the video that the log has to cover: the greater part must vote.
MIN_OVERLAP = 0.5
# Fine steps in one coarse step, 25 ms each: less than a frame, a parabola does the rest.
FINE_STEPS = 4
# Silhouette shifts tried along x and y in the fine search, [px]: the error of an unrefined camera pose.
SHIFTS_PX = (-4, -2, 0, 2, 4)
# Probability of a change where silhouettes differ; below 1, as robot and background may look alike.
CHANGE_LIKELIHOOD = 0.6
# Largest score of another offset, as share of the best one: with more, the offset is ambiguous.
MAX_RIVAL = 0.85
# Offsets farther than this from the best are rivals, [s]: beyond the width of its own peak.
RIVAL_DISTANCE_S = 0.5
# Largest clock drift among the hypotheses, in seconds a second: above a 25 fps video that is labelled as 24
# fps (0.04).
MAX_RATE = 0.06
# Least share of the image by which the silhouette has to change at once, above compression noise.
MIN_CHANGE = 0.003
# Least height of the best score over the others, in standard deviations of these.
MIN_GAIN_SD = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockParams:
    """How the offset is searched.

    Attributes:
        width: Image width for the comparison, [px].
        step_s: Coarse step; frames are taken this far apart, [s].
        fine_pairs: Frame pairs used for the fine search.
    """

    width: int = 160
    step_s: float = 0.1
    fine_pairs: int = 14


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockFrames:
    """Small frames at nearly equal steps, and the noise between two of them."""

    times_s: Array
    step_s: float
    images: NDArray[np.float32]
    noise: float

    @staticmethod
    def of(video: Video, params: ClockParams) -> "ClockFrames":
        stride = max(1, round(params.step_s * video.fps))
        height, width = video.frames_srgb.shape[1:3]
        size = (params.width, max(1, round(params.width * height / width)))
        images = np.stack([resize(frame, *size) for frame in video.frames_srgb[::stride]]).astype(np.float32)
        if not len(images) > max(LAGS):
            raise SyncError("video", f"has only {len(images)} frames to compare", "record the whole motion")
        times = video.times_s[::stride]
        noise = robust_sd(np.diff(images, axis=0))
        step = float((times[-1] - times[0]) / (len(times) - 1))
        return ClockFrames(times_s=times, step_s=step, images=images, noise=max(noise, 0.5))

    @property
    def size(self) -> tuple[int, int]:
        return self.images.shape[2], self.images.shape[1]

    @property
    def middle_s(self) -> float:
        return float(self.times_s[0] + self.times_s[-1]) / 2

    def change(self, first: int, second: int) -> NDArray[np.float32]:
        """How surely each pixel changed (P,), 0..1; a common brightness change does not count."""
        difference = self.images[second] - self.images[first]
        difference = difference - np.median(difference, axis=(0, 1))
        strength = np.abs(difference).max(-1).ravel()
        low = 4 * self.noise + 4
        return np.clip((strength - low) / (2 * low), 0, 1)


def change_gains(changes: NDArray[np.float32]) -> tuple[NDArray, NDArray]:
    """Log-likelihood gains (K, P) of "the silhouettes differ here" and of "no robot at either moment"."""
    usual = float(np.clip(changes.mean(), 1e-3, 0.5 * CHANGE_LIKELIHOOD))
    still = usual / 2

    def gain(probability: float) -> NDArray[np.float32]:
        return changes * np.log(probability / usual) + (1 - changes) * np.log((1 - probability) / (1 - usual))

    return gain(CHANGE_LIKELIHOOD), gain(still)
