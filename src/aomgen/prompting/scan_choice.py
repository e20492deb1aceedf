"""The images of a scan that a person is shown for prompting: sharp ones, spread over the walk."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.scan_images import blur, read_grey, shrink
from aomgen.core.recording import frame_name
from aomgen.io.images import read_image
from aomgen.io.video import decode_frames, probe_video

# Frames of a scan video that are offered: about every second of a walk of half a minute.
VIDEO_FRAMES: Final = 40
# Images proposed first: one of each sixth of the walk shows every side that a person can reach.
PROPOSED: Final = 6


class ScanImages:
    """Images of a scan by number, in the order of the walk.

    Attributes:
        names: Names of the images in `[[prompts]]`.
        blurs: (N,) blur of each, 0 sharp .. 1; see `scan_images.blur`.
    """

    def __init__(self, images: tuple[Path, ...], video: Path | None) -> None:
        """Decode a video's offered frames, or the images at a small size.

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
        """Image (H, W, 3), sRGB, upright."""
        name = self.names[index]
        return self._frames[name] if name in self._frames else read_image(self._paths[name])


def propose_images(blurs: NDArray[np.floating], count: int = PROPOSED) -> list[int]:
    """The sharpest image of each of several equal stretches of the walk, in its order.

    Args:
        blurs: (N,) blur of each image.
        count: Number of stretches.

    Example:
        >>> propose_images(np.array([0.5, 0.4, 0.6, 0.3, 0.3, 0.9]), 3)
        [1, 3, 4]
    """
    stretches = np.array_split(np.arange(len(blurs)), min(count, len(blurs)))
    return [int(stretch[np.argmin(blurs[stretch])]) for stretch in stretches]
