"""How the time of a video is told on the joint log's clock."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.values import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Log time = video time + `offset_s` + `rate` * (video time - `middle_s`).

    Attributes:
        offset_s: At the middle of the video, [s].
        sd_s: Standard deviation of the offset, [s]; 0 when it was given.
        rate: Drift; 0.01 is a log that counts 1.01 s while the video counts 1 s.
        rate_sd: Its standard deviation.
        middle_s: Video time about which the drift is told, [s].
    """

    offset_s: float
    sd_s: float = 0.0
    rate: float = 0.0
    rate_sd: float = 0.0
    middle_s: float = 0.0

    def log_times(self, video_times_s: ArrayLike) -> Array:
        """Log times (N,) of video times (N,), [s]."""
        times = np.asarray(video_times_s, np.float64)
        return times + self.offset_s + self.rate * (times - self.middle_s)
