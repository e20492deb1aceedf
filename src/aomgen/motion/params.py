"""Parameters of AOMotion."""

from dataclasses import dataclass, field

from aomgen.motion.contact import ContactParams
from aomgen.motion.joint_estimation import JointParams
from aomgen.motion.keyframes import KeyframeParams
from aomgen.motion.photometric import PhotometricParams


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionParams:
    """Parameters of the submodules.

    Attributes:
        width: Image width for keyframes, [px].
        max_fps: Faster videos are thinned for keyframes, [1/s].
        agree_s: Largest difference between the interval seen and the one felt, [s].
    """

    keyframes: KeyframeParams = field(default_factory=KeyframeParams)
    contact: ContactParams = field(default_factory=ContactParams)
    joint: JointParams = field(default_factory=JointParams)
    photometric: PhotometricParams = field(default_factory=PhotometricParams)
    width: int = 320
    max_fps: float = 15.0
    agree_s: float = 0.8
