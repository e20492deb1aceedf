"""Recordings of an end effector that moves the handle of a made asset."""

from dataclasses import replace

import numpy as np

from aomgen.assets.choice import make_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.demonstration import Demonstration, RecordedObject, SupportPlane
from aomgen.core.mesh import sample_surface
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity, transform

YAW = np.deg2rad(-70.0)
SCALE = 1.15
PLACE = np.array([0.8, 0.1, 0.05])


def recording(
    asset: ArticulatedAsset, scale: float = SCALE, noise_m: float = 0.0
) -> tuple[Demonstration, RecordedObject]:
    """Move a scaled asset's handle with an end effector, at varying speed."""
    rng = np.random.default_rng(0)
    T = transform(matrix_from_rotvec(np.array([0.0, 0.0, YAW])), PLACE)
    sized = asset.transform(similarity(scale, np.eye(3), np.zeros(3)))
    joint = sized.joint.move(T)
    times = np.arange(60) / 10
    travel = 1.0 if joint.type == "revolute" else 0.16
    thetas = travel * np.clip((times - 2) / 3, 0, 1) ** 1.5
    path = apply(joint.motion(thetas), apply(T, sized.handle_point)[None])
    poses = transform(np.eye(3), path + rng.normal(0, noise_m, path.shape))
    demo = Demonstration(
        times_s=times,
        joints=np.zeros((60, 6)),
        gripper=np.zeros(60),
        Ts_world_ee=poses,
        thetas=thetas,
        start_s=2.0,
        end_s=5.0,
        joint=joint,
        grasp_ee=np.zeros(3),
        ee_turn_ratio=1.0,
    )
    points = []
    for link in (sized.moving, sized.static):
        vertices = [sample_surface(m.vertices, m.faces, 600, rng)[0] for m in link.meshes]
        points.append(apply(T, np.concatenate(vertices)))
    support = SupportPlane(height=PLACE[2], low_xy=[-np.inf] * 2, high_xy=[np.inf] * 2)
    return demo, RecordedObject(moving_points_world=points[0], static_points_world=points[1], support=support)


def gripped_recording(category: str) -> tuple[Demonstration, RecordedObject]:
    """Record a made asset whose handle is along the x axis of the end effector, as in real recordings."""
    asset = make_asset(category, 1)
    demo, recorded = recording(asset)
    Ts = demo.Ts_world_ee.copy()
    along = matrix_from_rotvec(np.array([0.0, 0.0, YAW])) @ asset.handle_axis
    across = np.cross([np.sin(YAW), -np.cos(YAW), 0.0], along)
    Ts[:, :3, :3] = np.stack([along, across, np.cross(along, across)], 1)
    return replace(demo, Ts_world_ee=Ts), recorded
