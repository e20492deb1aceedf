"""Laws of every made asset, as assertions."""

from collections.abc import Sequence

import mujoco
import numpy as np

from aomgen.assets.asset_check import check_asset, outward_normal
from aomgen.assets.mjcf import add_asset, holding_friction
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply
from aomgen.replacement.correspondence import describe_contact
from aomgen.replacement.fitting import FitParams, fit_asset
from recordings import PLACE, SCALE, YAW, recording

# Directions in the asset frame, whose front faces -y.
LEFT, RIGHT, OUT, UP = [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 0, 1]


def has_no_problems(asset: ArticulatedAsset) -> None:
    assert check_asset(asset) == []
    assert outward_normal(asset) @ [0, -1, 0] > 0.99


def opens_as(assets: Sequence[ArticulatedAsset], ways: list[tuple[str, list[int], list[int]]]) -> None:
    """Assert that each asset opens in one of the given ways, and that all ways occur.

    A way is a joint type, its axis (either sign if vertical) and the first motion of the handle within 30 degrees.
    """
    seen = set()
    for asset in assets:
        joint, handle = asset.joint, asset.handle_point
        first = apply(joint.motion(0.02), handle) - handle
        first /= np.linalg.norm(first)
        found = [
            number
            for number, (kind, axis, direction) in enumerate(ways)
            if joint.type == kind
            and (joint.axis @ axis if axis != UP else abs(joint.axis @ axis)) > 0.999
            and first @ direction > np.cos(np.deg2rad(30))
        ]
        assert found, f"{joint.type} about {joint.axis}, handle moves along {first}"
        seen.update(found)
    assert seen == set(range(len(ways)))


def faces_outwards(asset: ArticulatedAsset, solid: str) -> None:
    """Assert that textures do not repeat, and that the mesh named `solid` of the moving part encloses a positive volume."""
    for link in (asset.static, asset.moving):
        for mesh in link.meshes:
            if len(mesh.uvs):
                assert mesh.uvs.min() >= -1e-9
                assert mesh.uvs.max() <= 1 + 1e-9
    handle = next(mesh for mesh in asset.moving.meshes if mesh.name == solid)
    a, b, c = (handle.vertices[handle.faces[:, i]] for i in range(3))
    volume = np.einsum("ni,ni->", a, np.cross(b, c)) / 6
    assert volume > 1e-6


def moves_without_contact(asset: ArticulatedAsset) -> None:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    names = add_asset(spec, asset, np.eye(4), damping=0.1, frictionloss=0.1)
    # Without the exclude, MuJoCo reports every touch of door and body.
    for exclude in list(spec.excludes):
        spec.delete(exclude)
    model = spec.compile()
    data = mujoco.MjData(model)
    for theta in np.linspace(0, asset.joint.upper, 40):
        data.joint(names.joint).qpos[0] = theta
        mujoco.mj_forward(model, data)
        assert data.ncon == 0, theta


def stays_where_left(asset: ArticulatedAsset, theta: float) -> None:
    """Assert that friction holds a lid at `theta` [rad] and that a push moves it."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    names = add_asset(spec, asset, np.eye(4), damping=0.05, frictionloss=0.02)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.joint(names.joint).qpos[0] = theta
    mujoco.mj_step(model, data, 1000)
    assert abs(data.joint(names.joint).qpos[0] - theta) < np.deg2rad(0.2)
    data.joint(names.joint).qfrc_applied[0] = 2.5 * holding_friction(asset)
    mujoco.mj_step(model, data, 300)
    assert data.joint(names.joint).qpos[0] > theta + 0.1


def is_found_again(asset: ArticulatedAsset) -> None:
    """Assert that the scale and the location of a recorded asset are estimated from the recording of its motion."""
    demo, recorded = recording(asset, noise_m=0.001)
    contact = describe_contact(demo, recorded, "opening")
    assert np.rad2deg(abs(contact.yaw - YAW)) < 2.0
    result = fit_asset(asset, contact, demo.joint.type, "object", FitParams())
    assert isinstance(result, FittedAsset)
    assert not result.mirrored
    assert abs(result.scale - SCALE) < 0.03
    assert np.linalg.norm(result.T_world_asset[:3, 3] - PLACE) < 0.02
    assert result.residual_mm < 6.0
