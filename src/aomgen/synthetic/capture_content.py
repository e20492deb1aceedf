"""Everything that a synthetic capture holds before it is written."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.synthetic.conditions import Conditions
from aomgen.synthetic.demo_video import RecordedVideo
from aomgen.synthetic.demonstration_search import Performance


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """Everything a synthetic capture holds.

    Attributes:
        name, category: Of the capture.
        performance: Layout and demonstration.
        scan_cameras, scan_images, scan_labels: One entry a still; images (H, W, 3), labels (H, W).
        video: Of the fixed camera, with the joint log.
        conditions: How everything was recorded.
    """

    name: str
    category: str
    performance: Performance
    scan_cameras: list[Camera]
    scan_images: list[NDArray[np.uint8]]
    scan_labels: list[NDArray[np.uint8]]
    video: RecordedVideo
    conditions: Conditions
