"""Which scan images are held out from training, to judge it by."""

# Every so many images one is held out, as benchmarks of view synthesis do (Mip-NeRF 360).
HELD_OUT_EVERY = 8


# Index of the first one; the image that the walk begins with is trained on.
HELD_OUT_PHASE = 4


def held_out(names: list[str]) -> list[str]:
    """Every 8th of all scan images in name order, the 5th first."""
    return [name for i, name in enumerate(sorted(names)) if i % HELD_OUT_EVERY == HELD_OUT_PHASE]
