"""Choose sharp scan images for prompting, distributed over the camera path."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.scan_images import blur, read_grey, shrink
from aomgen.core.recording import frame_name
from aomgen.io.images import read_image
from aomgen.io.video import decode_frames, probe_video

# Number of frames of a scan video that can be chosen, for example one per second of a video of 40 s.
VIDEO_FRAMES: Final = 40
# Number of images proposed first; one image per sixth of the camera path shows every accessible side.
PROPOSED: Final = 6


class ScanImages:
    """Images of a scan by number, in the order of the camera path.

    Attributes:
        names: Names of the images in `[[prompts]]`.
        blurs: Blur of each image (N,), 0 (sharp) .. 1; see `scan_images.blur`.
    """

    def __init__(self, images: tuple[Path, ...], video: Path | None) -> None:
        """Decode the selectable frames of a video, or the images at a small size.

        Raises:
            InputError: An image or the video is damaged.
        """
        self._frames: dict[str, NDArray[np.uint8]] = {}
        if video is None:
            self._paths = {path.name: path for path in images}
            self.names = [path.name for path in images]
            self.blurs = np.array([blur(read_grey(path)) for path in images])
            return
        count = probe_video(video).frames
        offered = set(np.linspace(0, count - 1, min(count, VIDEO_FRAMES)).round().astype(int).tolist())
        blurs = []
        for index, (_, frame) in enumerate(decode_frames(video)):
            if index in offered:
                self._frames[frame_name(index)] = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
                blurs.append(blur(shrink(frame.to_image())))
        self.names, self.blurs = list(self._frames), np.array(blurs)

    def read(self, index: int) -> NDArray[np.uint8]:
        """Return an image (H, W, 3), sRGB, upright."""
        name = self.names[index]
        return self._frames[name] if name in self._frames else read_image(self._paths[name])


def propose_images(blurs: NDArray[np.floating], count: int = PROPOSED) -> list[int]:
    """Choose the sharpest image of each of several equal sections of the camera path, in order.

    Args:
        blurs: Blur of each image (N,).
        count: Number of sections.

    Example:
        >>> propose_images(np.array([0.5, 0.4, 0.6, 0.3, 0.3, 0.9]), 3)
        [1, 3, 4]
    """
    stretches = np.array_split(np.arange(len(blurs)), min(count, len(blurs)))
    return [int(stretch[np.argmin(blurs[stretch])]) for stretch in stretches]
