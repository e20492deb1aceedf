"""Where an imported asset's front and handle are."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets.asset_check import outward_normal
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import Joint
from aomgen.core.mesh import sample_surface
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.errors import AssetError

HANDLE_WORDS = ("handle", "knob", "grip", "pull")
# The handle's outermost layer, [m], in which its middle and direction are sought.
LAYER = 0.008
# A revolute part's handle lies in the outer share of its reach.
OUTER_SHARE = 0.5
# Surface points that the handle is searched in: many on each handle of usual size.
SAMPLES = 20_000


@dataclass(frozen=True, slots=True, kw_only=True)
class HandleGuess:
    """Middle of the handle's bar (3,), [m], and its unit direction (3,)."""

    point: Array
    axis: Array


def opening_direction(link: AssetLink, joint: Joint) -> Array:
    """Unit direction (3,) in which the middle of the moving link starts to move.

    Raises:
        AssetError: A revolute part whose middle lies on its axis.
    """
    if joint.type == "prismatic":
        return joint.axis
    points = np.concatenate([mesh.vertices for mesh in link.meshes])
    middle = (points.min(0) + points.max(0)) / 2
    direction = np.cross(joint.axis, middle - joint.origin)
    length = float(np.linalg.norm(direction))
    if not length > 1e-4:
        raise AssetError(link.name, "lies symmetrically around its joint axis", "name its handle in the file")
    return direction / length


def guess_handle(link: AssetLink, joint: Joint) -> HandleGuess:
    """Guess the handle of a moving link.

    Meshes named like a handle are taken where there are some; otherwise the part of the link
    that protrudes most in the opening direction, for a revolute part within the outer half of
    its reach (a handle is opposite the hinge). The direction is the longer one of that region.
    """
    named = [m for m in link.meshes if any(word in m.name.lower() for word in HANDLE_WORDS)]
    rng = np.random.default_rng(0)
    meshes = named or link.meshes
    share = max(1, SAMPLES // len(meshes))
    points = np.concatenate([sample_surface(mesh.vertices, mesh.faces, share, rng)[0] for mesh in meshes])
    outward = opening_direction(link, joint)
    if joint.type == "revolute" and not named:
        arms = points - joint.origin
        reach = np.linalg.norm(arms - np.outer(arms @ joint.axis, joint.axis), axis=1)
        points = points[reach >= OUTER_SHARE * reach.max()]
    heights = points @ outward
    bar = points[heights >= heights.max() - LAYER]
    across = np.linalg.svd(outward[None])[2][1:]
    flat = (bar - bar.mean(0)) @ across.T
    direction = np.linalg.svd(flat, full_matrices=False)[2][0] @ across
    side = np.cross(outward, direction)
    point = sum(
        (0.5 * ((bar @ axis).min() + (bar @ axis).max()) * axis for axis in (direction, side)), np.zeros(3)
    )
    return HandleGuess(point=point + (heights.max() - LAYER / 2) * outward, axis=direction)


def canonical_transform(asset: ArticulatedAsset) -> Array:
    """Rigid transform (4, 4) to the asset frame: front towards -y, on z = 0, centred in x and y.

    The front is turned by whole quarter turns, as files are drawn along their axes; a part that
    opens upwards (a lid) keeps its heading. Where the file names its handle, the face that
    carries it is the front. An asset that stands so already gives the identity.
    """
    named = asset.handle_bar is not None
    outward = outward_normal(asset) if named else opening_direction(asset.moving, asset.joint)
    turns = 0
    if np.hypot(outward[0], outward[1]) > 0.5:
        angle = np.arctan2(-1.0, 0.0) - np.arctan2(outward[1], outward[0])
        turns = int(np.round(angle / (np.pi / 2))) % 4
    R = np.round(matrix_from_rotvec([0.0, 0.0, turns * np.pi / 2]))
    points = np.concatenate([mesh.vertices for mesh in asset.static.meshes]) @ R.T
    middle = (points.min(0) + points.max(0)) / 2
    everything = np.concatenate([m.vertices for link in (asset.static, asset.moving) for m in link.meshes])
    offset = np.array([-middle[0], 0.0, -everything[:, 2].min()])
    if turns or abs(middle[1]) > 0.25:
        offset[1] = -middle[1]
    offset[np.abs(offset) < 2e-3] = 0.0
    return transform(R, offset)
