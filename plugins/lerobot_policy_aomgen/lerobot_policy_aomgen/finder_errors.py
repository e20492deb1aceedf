"""Lateral errors of a finder on labeled images: `python -m lerobot_policy_aomgen.finder_errors FINDER IMAGES`.

The lateral error is the distance between the true point and the point at the same depth on the ray of the estimated pixel.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aomgen.core.values import Array
from aomgen.errors import AomgenError
from aomgen.evaluation.finder_errors import format_errors, summarize_errors, summarize_points
from aomgen.io.atomic import write_json
from lerobot_policy_aomgen.finder import Finder, FinderErrors, load_finder
from lerobot_policy_aomgen.finder_images import LabelledImages, read_images

# Number of images in one batch of the network.
BATCH = 32


def measure_errors(finder: Finder, images: LabelledImages) -> FinderErrors:
    """Measure the errors of a finder on all images; those of points outside their image are NaN."""
    offsets, spreads = [], []
    for first in range(0, len(images), BATCH):
        rows = np.arange(first, min(first + BATCH, len(images)))
        levels = torch.from_numpy(images.decode(rows)).permute(0, 3, 1, 2)
        points, spread = finder.find(levels.float() / 255)
        focal = images.focal_px[rows]
        truth = np.where(images.inside[rows][..., None], images.points_px[rows], np.nan)
        offsets.append((points.numpy() - truth) / focal[:, None])
        spreads.append(spread.numpy() / np.sqrt(focal.prod(1))[:, None])
    return FinderErrors(
        cameras=images.cameras,
        offsets=torch.from_numpy(np.concatenate(offsets)).float(),
        spreads=torch.from_numpy(np.concatenate(spreads)).float(),
    )


def lateral_mm(errors: FinderErrors, images: LabelledImages) -> Array:
    """Compute the lateral errors (N, P) at the depths of the points, [mm]; NaN for points outside their image."""
    return 1000 * images.depths * np.linalg.norm(errors.offsets.numpy(), axis=-1)


def make_table(errors: FinderErrors, images: LabelledImages) -> dict[str, dict[str, Any]]:
    """Summarize lateral errors by row of a table.

    There is a row for each keypoint inside its image, for the grasp point in each camera, and for the visible grasp points.
    """
    found_mm = lateral_mm(errors, images)
    grasp, names = found_mm[:, 0], np.array(images.cameras)
    return {
        **summarize_points(found_mm),
        **{
            f"grasp, camera {name}": summarize_errors(grasp[names == name])
            for name in sorted(set(images.cameras))
        },
        "grasp, visible": summarize_errors(grasp[images.visible[:, 0]]),
    }


def main(arguments: list[str] | None = None) -> int:
    """Print the errors of a finder and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m lerobot_policy_aomgen.finder_errors",
        description="Print lateral errors of a finder on labelled images.",
    )
    parser.add_argument("finder", type=Path, help="finder.safetensors")
    parser.add_argument("images", type=Path, help="folder of `aomgen export --format images`")
    parser.add_argument("--limit", type=int, help="number of images, by default all")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parser.parse_args(arguments)
    try:
        finder, _ = load_finder(given.finder)
        images = read_images(given.images, given.limit)
        table = make_table(measure_errors(finder, images), images)
        sys.stdout.write(format_errors(table, "lateral error") + "\n")
        if given.json:
            write_json(given.json, table)
    except AomgenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
