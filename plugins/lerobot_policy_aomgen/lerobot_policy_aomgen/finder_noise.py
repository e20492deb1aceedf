"""Errors of a finder as noise of true pixels, from which an action network learns."""

import torch
from torch import Tensor

from aomgen.core.keypoints import KEYPOINTS
from lerobot_policy_aomgen.finder import UNSEEN, FinderErrors
from lerobot_policy_aomgen.lifting import Views

# Number of images whose errors a policy keeps of each camera.
IMAGES = 256
# Shape of a table of one camera: x and y of the offset and the spread of each point, divided by the focal length.
TABLE_SHAPE = (IMAGES, len(KEYPOINTS), 3)
# Points nearer to the camera's plane than this are not in the image, [m].
NEAR_M = 0.02


def tabulate_errors(errors: FinderErrors, cameras: list[str]) -> Tensor:
    """Errors of images of each camera (C, *TABLE_SHAPE), sampled with a fixed seed.

    The errors of an image's points stay together; a point outside the image gets its error from another image.

    Raises:
        ValueError: The finder was not measured on images of a camera that contain all points.
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
    """Pixels (B, C, P, 2) and spreads (B, C, P) as the finder would find them, [px].

    Args:
        tables: Of `tabulate_errors`.
        views: The cameras.
        pixels, depths: True pixels (B, C, P, 2) and depths (B, C, P). A point outside an image is found in its middle, with
            the spread of a point that is not seen.
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
