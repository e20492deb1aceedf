"""How a synthetic capture is recorded: camera, noise and what the recording states about it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """Cameras and their flaws.

    Attributes:
        size: Width and height of stills and video, [px].
        scan_views: Number of stills.
        fps: Of the video.
        focal_share: Focal length over image width; a phone's main camera has about 0.94.
        noise: Sensor noise, 1 = a phone in a bright room.
        gain_spread: Largest relative change of exposure between stills.
        intrinsics_known: Whether capture.toml states them.
    """

    size: tuple[int, int] = (320, 240)
    scan_views: int = 40
    fps: int = 10
    focal_share: float = 0.9375
    noise: float = 1.0
    gain_spread: float = 0.03
    intrinsics_known: bool = True


def draw_conditions(rng: np.random.Generator) -> Conditions:
    """Conditions as recordings differ in them: lens, picture size, light, length of the walk."""
    return Conditions(
        size=((320, 240), (400, 300), (384, 256))[rng.integers(3)],
        scan_views=int(rng.integers(40, 57)),
        fps=int(rng.choice([10, 12, 15])),
        focal_share=rng.uniform(0.8, 1.0),
        noise=rng.uniform(0.6, 2.0),
        gain_spread=rng.uniform(0.01, 0.06),
    )
