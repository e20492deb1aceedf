"""Parameters of the generation of episodes."""

from dataclasses import dataclass, field

from aomgen.episodes.planning import PlanParams
from aomgen.episodes.render import ImageParams
from aomgen.episodes.variations import Ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationParams:
    """Parameters of the stage "episodes".

    Attributes:
        ranges: Ranges of the variations.
        plan: Parameters of the planning; its rate is the recording's.
        bolted: The object is fixed to its support; False lets it stand by friction.
        attempts_per_episode: Largest number of samples that are planned for each requested episode.
        cameras: Names of the scene's cameras that are used; empty for all.
        free_cameras: Number of added cameras, placed by `ranges.free`.
        images: Kinds of images that are stored, and whether the robot's cameras are rendered.
        timeout_s: A unit that takes longer is given up, [s].
    """

    ranges: Ranges = field(default_factory=Ranges)
    plan: PlanParams = field(default_factory=PlanParams)
    bolted: bool = True
    attempts_per_episode: int = 5
    cameras: tuple[str, ...] = ()
    free_cameras: int = 0
    images: ImageParams = field(default_factory=ImageParams)
    timeout_s: float = 600.0
