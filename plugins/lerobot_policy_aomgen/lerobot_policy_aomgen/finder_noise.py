"""Measured errors of a finder as noise on true pixels, for the training of an action network."""

import torch
from torch import Tensor

from aomgen.core.keypoints import KEYPOINTS
from lerobot_policy_aomgen.finder import UNSEEN, FinderErrors
from lerobot_policy_aomgen.lifting import Views

# Number of images per camera whose errors a policy stores.
IMAGES = 256
# Shape of the table of one camera: x and y of the offset, and the spread of each point, divided by the focal length.
TABLE_SHAPE = (IMAGES, len(KEYPOINTS), 3)
# Points of at most this depth are not in the image, [m].
NEAR_M = 0.02


def tabulate_errors(errors: FinderErrors, cameras: list[str]) -> Tensor:
    """Sample errors of images of each camera (C, *TABLE_SHAPE) with a fixed seed.

    The errors of the points of an image remain together; a point outside the image gets an error from another image.

    Args:
        errors: Measured errors of the finder.
        cameras: Names of C cameras.

    Raises:
        ValueError: For a camera, a point is in none of the images on which the errors were measured.
    """
    rng = torch.Generator().manual_seed(0)
    tables = []
    for camera in cameras:
        chosen = torch.tensor([name == camera for name in errors.cameras], dtype=torch.bool)
        known = errors.offsets[chosen].isfinite().all(-1)
        if not known.any(0).all():
            names = ", ".join(sorted(set(errors.cameras)))
            raise ValueError(f"the finder was not measured on images of camera {camera} (known: {names})")
        values = torch.cat([errors.offsets[chosen], errors.spreads[chosen][..., None]], -1)
        rows = known.any(1).nonzero()[:, 0]
        rows = rows[torch.randint(len(rows), (IMAGES,), generator=rng)]
        table = values[rows]
        for point in range(table.shape[1]):
            others = known[:, point].nonzero()[:, 0]
            others = others[torch.randint(len(others), (IMAGES,), generator=rng)]
            table[:, point] = torch.where(known[rows, point, None], table[:, point], values[others, point])
        tables.append(table)
    return torch.stack(tables)


def add_errors(tables: Tensor, views: Views, pixels: Tensor, depths: Tensor) -> tuple[Tensor, Tensor]:
    """Simulate the output of the finder by adding random measured errors to true pixels.

    The simulated pixel of a point outside an image is the center of the image, with the spread of an unobserved point.

    Args:
        tables: Errors from `tabulate_errors`.
        views: Cameras.
        pixels: True pixels (B, C, P, 2).
        depths: True depths (B, C, P), [m].

    Returns:
        Pixels (B, C, P, 2) and their spreads (B, C, P), [px].
    """
    count = torch.arange(pixels.shape[1], device=pixels.device)
    rows = torch.randint(IMAGES, pixels.shape[:2], device=pixels.device)
    errors = tables[count, rows]
    focal = torch.stack([views.K[:, 0, 0], views.K[:, 1, 1]], -1)[:, None]
    limits = torch.tensor(views.size, dtype=pixels.dtype, device=pixels.device)
    inside = ((pixels >= 0) & (pixels < limits)).all(-1) & (depths > NEAR_M)
    found = torch.where(inside[..., None], pixels + errors[..., :2] * focal, limits / 2)
    spreads = errors[..., 2] * focal.prod(-1).sqrt()
    return found, torch.where(inside, spreads, UNSEEN * sum(views.size) / 2)
