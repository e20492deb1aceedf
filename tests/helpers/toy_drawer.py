"""A drawer in front of the robot and a demonstration that opens it, without a recording."""

import numpy as np

from aomgen.assets.choice import make_asset
from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply, interpolate, matrix_from_rotvec, transform
from aomgen.episodes.ik import IkSolver, solve_path
from aomgen.episodes.joint_limits import IkLimits

SUPPORT = SupportPlane(height=0.05, low_xy=np.full(2, -np.inf), high_xy=np.full(2, np.inf))
NEAR = np.array([2.11, -1.51, 2.26, -0.75, 0.53, 1.57])


def fitted_drawer() -> FittedAsset:
    """Place a drawer in front of the robot, its handle at a distance of about 0.68 m."""
    asset = make_asset("drawer", 1)
    shares = np.linspace(0, 1, 20, dtype=np.float64)
    T = transform(matrix_from_rotvec(np.array([0, 0, -np.pi / 2])), np.array([0.92, -0.2, 0.05]))
    return FittedAsset(
        asset=asset,
        T_world_asset=T,
        contact_asset=asset.handle_point,
        shares=shares,
        thetas=np.asarray(0.15 * shares**2 * (3 - 2 * shares), np.float64),
        scale=1.0,
        mirrored=False,
        mode="trajectory",
        residual_mm=0.0,
    )


def opening(
    solver: IkSolver, fitted: FittedAsset, before: tuple[float, float, float] = (0.15, 0.0, 0.0)
) -> Demonstration:
    """Open the drawer with an end effector: approach from `before` the handle [m], close, pull, open, leave."""
    held = apply(fitted.T_world_asset, fitted.contact_asset)
    # Out of the palm along +x of the world, fingers close up and down.
    R = np.stack([np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])], 1)
    hold = transform(R, held)
    back = transform(R, held - before)
    pulled = transform(R, held - [0.15, 0, 0])
    gone = transform(R, held - [0.27, 0, 0])
    still = np.zeros(8)
    ease = np.linspace(0, 1, 26) ** 2 * (3 - 2 * np.linspace(0, 1, 26))
    pieces = [(back, hold, ease), (hold, hold, still), (hold, pulled, ease), (pulled, pulled, still)]
    poses = np.concatenate([interpolate(a, b, s) for a, b, s in [*pieces, (pulled, gone, ease)]])
    first = solve_path(solver, back[None], NEAR, IkLimits(iterations=60))
    assert isinstance(first, np.ndarray)
    path = solve_path(solver, poses, first[-1], IkLimits())
    assert isinstance(path, np.ndarray)
    times = np.arange(len(poses)) / 10
    close, pull, release, leave = 2.6, 3.4, 6.0, 6.8
    gripper = np.interp(times, [close, pull - 0.2, release, leave - 0.2], [0, 0.72, 0.72, 0])
    thetas = np.concatenate([np.zeros(34), 0.15 * ease, np.full(34, 0.15)])
    return Demonstration(
        times_s=times,
        joints=path,
        gripper=gripper,
        Ts_world_ee=poses,
        thetas=thetas,
        start_s=pull,
        end_s=release - 0.1,
        joint=fitted.asset.joint.move(fitted.T_world_asset),
        grasp_ee=np.zeros(3),
        ee_turn_ratio=0.0,
    )
