"""Coverage of the twin page's view by the images of the scan."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.parts.survey import MIN_SHARE, Survey

# Surveyed points this far behind the rendered surface are hidden, [m]; they are on a box around the object, not on it.
HIDDEN_M: Final = 0.04
# Values of a point's coverage: no view, too few views, enough views.
NO_VIEW, FEW_VIEWS, ENOUGH_VIEWS = 0, 1, 2
# Views at a larger angle to every scan camera show surfaces that no image showed, [deg]; neighboring cameras of a scan
# around the object are up to 12 deg apart.
NEAR_DEG: Final = 20.0
# A larger share of an image without any Gaussian is reported.
EMPTY_SHARE: Final = 0.1
# Alpha below which a pixel shows no surface.
SOLID_ALPHA: Final = 0.5


def project_coverage(
    found: Survey, camera: Camera, depth: NDArray[np.float32], *, with_robot: bool
) -> list[list[float]]:
    """Project the surveyed points that the rendered depth (H, W) [m] does not hide to rows of x, y [px] and coverage.

    The points of the robot have their positions during the scan; without `with_robot` they are omitted.
    """
    robots = [k for k, name in enumerate(found.names) if name.endswith("of the robot")]
    pixels, depths = camera.project(found.points_world)
    seen = np.where(
        found.coverage.enough, ENOUGH_VIEWS, np.where(found.coverage.views > 0, FEW_VIEWS, NO_VIEW)
    )
    inside = (
        (depths > 0)
        & (with_robot | ~np.isin(found.sides, robots))
        & (pixels >= 0).all(1)
        & (pixels < [camera.width, camera.height]).all(1)
    )
    pixels, depths, seen = pixels[inside], depths[inside], seen[inside]
    columns, rows = pixels.astype(int).T
    before = depth[rows, columns]
    shown = (before == 0) | (depths < before + HIDDEN_M)
    return np.column_stack([pixels.round(1), seen])[shown].tolist()


def describe_support(
    camera: Camera,
    alpha: NDArray[np.float32] | None,
    scan: Mapping[str, Camera],
    pivot: Array,
    found: Survey | None,
) -> list[str]:
    """List sentences about the content of a rendered image that no scan image showed.

    Args:
        camera: View of the image.
        alpha: Alpha of the image (H, W), 0..1; None if parts are hidden.
        scan: Scan cameras.
        pivot: Center of the scanned region (3,).
        found: Survey of the scan's coverage; None before it is measured.
    """
    sentences = []
    if alpha is not None and (empty := float(np.mean(alpha < SOLID_ALPHA))) > EMPTY_SHARE:
        sentences.append(f"{empty:.0%} of this image shows no scanned surface.")
    ours = camera.center - pivot
    rays = np.array([item.center for item in scan.values()]).reshape(-1, 3) - pivot
    cosines = rays @ ours / np.maximum(np.linalg.norm(rays, axis=1) * np.linalg.norm(ours), 1e-9)
    nearest_deg = float(np.degrees(np.arccos(np.clip(cosines.max(initial=-1.0), -1, 1))))
    if nearest_deg > NEAR_DEG:
        sentences.append(
            f"The nearest scan camera looks from {nearest_deg:.0f} deg beside this view: "
            "surfaces that are visible from this side only were not observed."
        )
    if found is not None:
        sentences += _list_guessed_sides(camera, found)
    return sentences


def _list_guessed_sides(camera: Camera, found: Survey) -> list[str]:
    """List the sentences of the survey about sides that face the camera."""
    middles = np.array([found.points_world[found.sides == k].mean(0) for k in range(len(found.names))])
    of_object = [k for k, name in enumerate(found.names) if name.endswith("of the object")]
    outward = middles - middles[of_object].mean(0)
    facing = ((camera.center - middles) * outward).sum(1) > 0
    shares = {name: item["share"] for name, item in found.figures().items()}
    names = [found.names[k] for k in of_object if facing[k] and shares[found.names[k]] < MIN_SHARE]
    return [
        sentence[0].upper() + sentence[1:] + "."
        for sentence in found.warnings()
        if any(sentence.startswith(name) for name in names)
    ]
