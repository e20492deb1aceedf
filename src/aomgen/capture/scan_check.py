"""Whether every image of a scan can be decoded, and is sharp."""

from collections.abc import Sequence
from pathlib import Path

from aomgen.capture.sharpness import BLURRED, HOPELESS, blur, read_grey, shrink
from aomgen.core.recording import Capture, frame_name
from aomgen.errors import IncompleteCaptureError
from aomgen.io.video import decode_frames, probe_video

# With a larger share of hopeless images than this, too few others are left anywhere.
MAX_HOPELESS_SHARE = 0.8
# A scan video is hand-held: its frames are looked at so many times, and only sharp ones are used later.
VIDEO_LOOKS = 60
# Names in one sentence; the rest is counted.
SHOWN_NAMES = 5


def check_scan(capture: Capture) -> tuple[int, list[str]]:
    """Decode the whole scan.

    Returns:
        Number of stills or frames, and warnings.

    Raises:
        MalformedFileError: An image or the video is damaged or truncated.
        IncompleteCaptureError: Nearly all images are hopelessly blurred.
    """
    if capture.scan_video is not None:
        count, blurs = _video_blurs(capture.scan_video)
        _refuse_hopeless(capture.scan_video, blurs)
        return count, []
    blurs = {path.name: blur(read_grey(path)) for path in capture.scan_images}
    _refuse_hopeless(capture.scan_images[0].parent, blurs)
    blurred = _beyond(BLURRED, blurs)
    if not blurred:
        return len(blurs), []
    sentence = f"{len(blurred)} of {len(blurs)} scan images are blurred ({_some(blurred)}): take them out, or scan again"
    return len(blurs), [sentence]


def _video_blurs(path: Path) -> tuple[int, dict[str, float]]:
    stride = max(1, probe_video(path).frames // VIDEO_LOOKS)
    count, blurs = 0, {}
    for _, frame in decode_frames(path):
        if count % stride == 0:
            blurs[frame_name(count)] = blur(shrink(frame.to_image()))
        count += 1
    return count, blurs


def _refuse_hopeless(where: Path, blurs: dict[str, float]) -> None:
    blurred = _beyond(HOPELESS, blurs)
    if not len(blurred) <= MAX_HOPELESS_SHARE * len(blurs):
        raise IncompleteCaptureError(
            where,
            f"{len(blurred)} of {len(blurs)} images looked at are blurred ({_some(blurred)})",
            "scan again with focus and more light, and hold still for each image",
        )


def _beyond(limit: float, blurs: dict[str, float]) -> list[str]:
    return [name for name, value in blurs.items() if value > limit]


def _some(names: Sequence[str]) -> str:
    more = f", {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
    return ", ".join(names[:SHOWN_NAMES]) + more
