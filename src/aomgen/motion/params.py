"""Parameters of AOMotion."""

from dataclasses import dataclass, field

from aomgen.motion.joint_estimation import JointParams
from aomgen.motion.photometric import PhotometricParams


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionParams:
    """Parameters of the submodules.

    Attributes:
        joint: Of the joint's estimate.
        photometric: Of its refinement on the video.
        contact_steps: Moments at the start of the motion at which patches of contact are looked for.
        width: Image width for keyframes, [px].
    """

    joint: JointParams = field(default_factory=JointParams)
    photometric: PhotometricParams = field(default_factory=PhotometricParams)
    contact_steps: int = 7
    width: int = 320
