"""The whole twin fitted to the images of the scan and of the demonstration, each in its joint configuration.

The scan shows one joint configuration. The video shows what was hidden then: the inside of what was opened,
the other side of a door, a table without the shadow that the arm threw on it while it was scanned.
Shapes stay opaque surfaces on their bodies; brief shadows of what moves count little, because
the loss is an absolute difference and every image has them elsewhere.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from aomgen.appearance.surfel_observations import PosedImages, pixel_size
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.splatting.refining import RefinementView, refine_gaussians
from aomgen.twin.directional_shadow import compute_shadow_factors, draw_lit
from aomgen.twin.relighting import LitSurface, Relit, surfaces_of
from aomgen.twin.twin import Twin, body_poses, posed_by, shadow_roles

# Gaussians move this much in a step, [px] of the usual image at the robot.
STEP_PX: Final = 0.1
# Shadows are drawn a pixel or two beside where they are: nothing is learned where the share of light
# that is taken changes by this much, on pixels that are mostly the surface.
EDGE_PX: Final = 5
# Change in the share of light, 0..1, that makes an edge of a shadow.
EDGE_STEP: Final = 0.1
# Share of a pixel, 0..1, from which it is mostly the surface.
MOSTLY: Final = 0.5


def refine_twin(
    twin: Twin, robot: RobotModel, views: Sequence[PosedImages], rng: np.random.Generator
) -> Twin:
    """Fit the Gaussians of the twin to images.

    Shape, specular term and the colors of what is not relit are shared by all joint configurations. Colors of
    relit surfaces are learned for the orientations of the scan, beyond what they were given, and
    come back as much as memories of them do.

    Args:
        twin: If something in it is lit anew, those are its last Gaussians.
        robot: Its robot.
        views: What to fit to; with none the twin stays as it is.
        rng: Order of the images.
    """
    if not views:
        return twin
    surfaces = surfaces_of(twin.relit, twin.bodies)
    nearest = _scan_orientations(twin, robot)
    roles = shadow_roles(twin, robot)
    training_views = [
        _with_shadows(
            _training_view(twin, body_poses(twin, robot, state), surfaces, nearest, (view, index)),
            twin,
            roles,
        )
        for view in views
        for index, state in enumerate(view.states)
    ]
    rate_means = STEP_PX * pixel_size(robot, twin, views)
    gaussians, difference = refine_gaussians(twin.gaussians, twin.bodies, training_views, rate_means, rng)
    relit = None if twin.relit is None else _add_corrections(twin.relit, nearest, difference)
    return replace(twin, gaussians=gaussians, relit=relit)


def _training_view(
    twin: Twin,
    Ts_world_body: Array,
    surfaces: tuple[LitSurface, ...],
    nearest: dict[int, int],
    place: tuple[PosedImages, int],
) -> RefinementView:
    """One image, the n-th of a video, with the colors of relit surfaces in its joint configuration."""
    view, index = place
    count = 0 if twin.relit is None else len(twin.relit.indices)
    colors, recall = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
    for surface in surfaces:
        R = Ts_world_body[surface.body, :3, :3]
        colors[surface.rows] = surface.colors_srgb(R)
        if surface.residual is not None:
            recall[surface.rows] = surface.residual.weights(R)[nearest[surface.body]]
    return RefinementView(
        camera=view.camera,
        image_srgb=view.images_srgb[index],
        Ts_world_part=Ts_world_body,
        colors_srgb=colors,
        recall=recall,
    )


def _with_shadows(training_view: RefinementView, twin: Twin, roles: NDArray[np.uint8]) -> RefinementView:
    """A training view whose drawn image is compute_shadow_factors by the shadows of its joint configuration."""
    if twin.directional_light is None:
        return training_view
    world = posed_by(twin, training_view.Ts_world_part)
    _, surface, taken = draw_lit(twin.directional_light, world, roles, training_view.camera)
    edge = maximum_filter(taken, EDGE_PX) - minimum_filter(taken, EDGE_PX) > EDGE_STEP
    return replace(
        training_view,
        shade=compute_shadow_factors(twin.directional_light, surface * taken),
        unsure=edge & (surface > MOSTLY),
    )


def _scan_orientations(twin: Twin, robot: RobotModel) -> dict[int, int]:
    """Which remembered orientation of every body is nearest to the scan's."""
    Ts = body_poses(twin, robot, twin.scan_state)
    return {
        item.body: int(np.argmax(np.einsum("kij,ij->k", item.Rs_world_body, Ts[item.body, :3, :3])))
        for item in (twin.relit.residuals if twin.relit is not None else ())
    }


def _add_corrections(relit: Relit, nearest: dict[int, int], difference: Array) -> Relit:
    """Memories of the scan's orientations with differences in color (M, 3) added."""
    remembered = []
    for item in relit.residuals:
        colors = np.array(item.difference_srgb)
        colors[nearest[item.body]] += difference[item.rows]
        remembered.append(replace(item, difference_srgb=colors))
    return replace(relit, residuals=tuple(remembered))
