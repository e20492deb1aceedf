"""What the fit needs to know of the recorded motion: the held point's path and the object's front."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.signal import savgol_filter

from aomgen.core.demonstration import Demonstration, RecordedObject
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.replacement.correspondence import Frontal, frontal, normalised_share


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedContact:
    """The recorded motion as the fit needs it.

    Attributes:
        path_world: Held point while the part moves (K, 3), [m].
        shares: Time share 0..1 of each point (K,).
        thetas: Recovered joint value (K,), first 0, never falling, [rad] or [m].
        front: The recorded object's front.
        held_share: Held point in the normalised cube of the moving part (3,).
        size: Extent of the moving part along right, inward, up (3,), [m].
        support_z: Height of the support, [m].
    """

    path_world: Annotated[Array, "K 3"]
    shares: Annotated[Array, "K"]
    thetas: Annotated[Array, "K"]
    front: Frontal
    held_share: Vector3
    size: Vector3
    support_z: float

    __post_init__ = freeze_arrays


def recorded_contact(demo: Demonstration, recorded: RecordedObject) -> RecordedContact:
    """Cut the contact out of the demonstration and describe the recorded object's front.

    Raises:
        EstimationError: The part's front is ambiguous (see `frontal`).
    """
    frames = demo.contact_frames
    path = demo.grasp_path_world[frames]
    # Both parts together are a box more often than a door with its handle is.
    whole = np.concatenate([recorded.moving_points_world, recorded.static_points_world])
    front = frontal(demo.joint, path[0], whole)
    times = demo.times_s[frames]
    aligned = recorded.moving_points_world @ front.R_world_front
    return RecordedContact(
        path_world=path,
        shares=(times - times[0]) / max(times[-1] - times[0], 1e-9),
        thetas=smooth_rise(demo.thetas[frames]),
        front=front,
        held_share=normalised_share(recorded.moving_points_world, path[0], front.R_world_front),
        size=np.ptp(np.percentile(aligned, [1, 99], axis=0), axis=0),
        support_z=recorded.support.height,
    )


def smooth_rise(thetas: Array) -> Array:
    """The nearest never-falling curve to (K,) noisy joint values, smoothed, starting at 0."""
    window = min(7, len(thetas) - (len(thetas) + 1) % 2)
    smooth = savgol_filter(thetas, window, 2) if window >= 5 else np.asarray(thetas, np.float64)
    smooth = smooth.copy()
    smooth[0], smooth[-1] = thetas[0], max(thetas[-1], smooth[-1])
    rising = isotonic_regression(smooth).x
    return rising - rising[0]
