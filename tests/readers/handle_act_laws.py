"""Laws of the policy with a finder, run by test_policy.py in .venv-policy: prints what failed, nothing else."""

import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot_policy_aomgen import detection
from lerobot_policy_aomgen.action_network import decode_poses, encode_poses
from lerobot_policy_aomgen.configuration_handle_act import HandleACTConfig
from lerobot_policy_aomgen.finder import Finder, FinderErrors, FinderSettings, save_finder
from lerobot_policy_aomgen.finder_noise import add_errors, tabulate_errors
from lerobot_policy_aomgen.geometry import describe_geometry, disturb_poses, pose_end_effector, pose_views
from lerobot_policy_aomgen.lifting import lift_points, project_points
from lerobot_policy_aomgen.modeling_handle_act import HandleACTPolicy
from lerobot_policy_aomgen.tracking import PointTracker

from aomgen.core.camera import Camera, look_at
from aomgen.core.transforms import quat_from_matrix
from aomgen.robots.loading import load_robot

SIZE = (96, 64)
CHUNK = 12


def check(holds: object, law: str) -> None:
    if not bool(holds):
        print(f"failed: {law}")


robot = load_robot("ur5e_2f85")
optics = {"fx": 80.0, "fy": 70.0, "cx": 48.0, "cy": 32.0, "width": SIZE[0], "height": SIZE[1]}
cameras = {
    "front": Camera(**optics, T_world_cam=look_at((1.6, 0.2, 0.8), (0.5, 0.1, 0.2))),
    "side": Camera(**optics, T_world_cam=look_at((0.6, 1.6, 0.9), (0.5, 0.1, 0.2))),
}
mounted = next(iter(robot.cameras))
geometry = describe_geometry({**cameras, mounted: robot.cameras[mounted][1].resize(*SIZE)}, robot)
names = ["front", "side", mounted]

# The arm and the camera that it carries are where the robot's model has them.
rng = np.random.default_rng(0)
torch.manual_seed(0)
configurations = rng.uniform(-2, 2, (5, 6))
joints = torch.from_numpy(configurations)
T_world_ee = pose_end_effector(geometry, joints)
check(np.allclose(T_world_ee, robot.ee_poses(configurations), atol=1e-6), "the arm's kinematics")
carried = robot.camera_paths(configurations, np.zeros(5))[mounted].Ts_world_cam
check(
    np.allclose(pose_views(geometry, names, T_world_ee).T_world_cam[:, 2], carried, atol=1e-6), "its camera"
)
moved = disturb_poses(T_world_ee.repeat(400, 1, 1), 0.01, 0.05)
offsets = (moved[:, :3, 3] - T_world_ee[:, :3, 3].repeat(400, 1)).norm(dim=-1)
check(0.015 < offsets.mean() < 0.017, "poses move by three normal numbers")
unit = torch.eye(3, dtype=moved.dtype)
R = moved[:, :3, :3]
check(torch.allclose(R @ R.transpose(1, 2), unit.expand(2000, 3, 3), atol=1e-9), "they stay poses")

# Poses are coded in the end effector's frame, without loss.
targets = robot.ee_poses(rng.uniform(-2, 2, (5 * CHUNK, 6)))
actions = np.column_stack([targets[:, :3, 3], quat_from_matrix(targets[:, :3, :3]), np.full(5 * CHUNK, 0.4)])
actions = torch.from_numpy(actions.reshape(5, CHUNK, 8))
again = decode_poses(T_world_ee, encode_poses(T_world_ee, actions))
signs = (again[..., 3:7] * actions[..., 3:7]).sum(-1, keepdim=True).sign()
again[..., 3:7] *= signs
check(torch.allclose(again, actions, atol=1e-9), "decoding is the inverse of encoding")
turned = pose_end_effector(geometry, joints.flip(0))
carry = turned @ torch.linalg.inv(T_world_ee)
carried_targets = carry[:, None].numpy() @ targets.reshape(5, CHUNK, 4, 4)
rotated = quat_from_matrix(carried_targets[..., :3, :3].reshape(-1, 3, 3)).reshape(5, CHUNK, 4)
elsewhere = torch.from_numpy(np.concatenate([carried_targets[..., :3, 3], rotated, actions[..., 7:]], -1))
same = torch.allclose(encode_poses(turned, elsewhere), encode_poses(T_world_ee, actions), atol=1e-6)
check(same, "a pose that is carried along has the same code")

# Errors of images are noise of pixels; what is outside is found in the middle, and hardly counts.
count = 40
known = FinderErrors(
    cameras=tuple(names[number % 3] for number in range(count)),
    offsets=torch.zeros(count, 5, 2),
    spreads=torch.full((count, 5), 0.02),
)
known.offsets[3, 2] = torch.nan
tables = tabulate_errors(known, names)
check(tables.isfinite().all() and tables.shape == (3, 256, 5, 3), "unknown errors come from other images")
points = torch.tensor([0.5, 0.1, 0.2]) + 0.05 * torch.randn(5, 5, 3)
views = pose_views(geometry, names, T_world_ee.float())
pixels, depths = project_points(views, points)
found, spreads = add_errors(tables, views, pixels, depths)
check(torch.allclose(found[:, :2], pixels[:, :2]), "without errors pixels are true")
check((lift_points(views, found, spreads)[0] - points).norm(dim=-1).median() < 0.005, "and points as well")
behind = add_errors(tables, views, pixels, -depths.abs())
check((behind[0] == torch.tensor(SIZE) / 2).all() and (behind[1] > 15).all(), "behind a camera is the middle")
try:
    tabulate_errors(known, ["nowhere"])
    print("failed: a camera without measured errors is refused")
except ValueError as error:
    check("front" in str(error), "known cameras are named")

tracker, resting = PointTracker(), torch.randn(3, 5, 3)
still = torch.eye(4).repeat(3, 1, 1)
for look in range(9):
    located = resting + (1.0 if look == 4 else 0.01 * torch.randn(3, 5, 3))
    estimate, spreads = tracker.update(located, torch.full((3, 5), 0.01), still, torch.zeros(3))
check((estimate - resting).abs().max() < 0.03, "one wrong location of nine does not change the estimate")
check(torch.allclose(spreads, torch.full((3, 5), 0.01)), "standard deviations are medians as well")
moved = still.clone()
moved[:, 0, 3] = 0.2
for pose, gripper in ((still, [0.8, 0.8, 0.0]), (moved, [0.8, 0.0, 0.0])):
    held, _ = tracker.update(resting + 9, torch.full((3, 5), 1e-3), pose, torch.tensor(gripper))
shift = torch.zeros(3, 5, 3)
shift[0, :3, 0] = 0.2
check(
    torch.allclose((held - estimate)[:2], shift[:2], atol=1e-6), "the handle moves with a closed gripper only"
)
check((held[2] - resting[2]).abs().min() > 8, "an object that was not grasped is located again")

with tempfile.TemporaryDirectory() as scratch:
    folder = Path(scratch)
    torch.manual_seed(0)
    save_finder(
        folder / "finder.safetensors", Finder(FinderSettings(pretrained=False, crops_px=(32,))), known
    )
    detection.read_geometry = lambda path, cameras: json.loads(json.dumps(geometry))
    features = {
        "observation.state": PolicyFeature(FeatureType.STATE, (7,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (15,)),
    }
    options = {"finder": str(folder / "finder.safetensors"), "suite": "suite.json", "chunk_size": CHUNK}

    def make_config(**changed: object) -> HandleACTConfig:
        given = {
            "device": "cpu",
            "input_features": dict(features),
            "output_features": {"action": PolicyFeature(FeatureType.ACTION, (8,))},
        }
        return HandleACTConfig(**{**given, **options, **changed})

    policy = HandleACTPolicy(make_config())
    check(set(policy.config.image_features) == {f"observation.images.{name}" for name in names}, "images")
    check(policy.config.env_state_feature is None, "keypoints are no input of a trained policy")

    def demonstrate(count: int) -> dict[str, torch.Tensor]:
        """Poses that approach the grasp point in a straight line."""
        state = torch.zeros(count, 2, 7)
        state[..., :6] = torch.tensor([0.3, -1.6, 1.9, -1.9, -1.5, 0.1]) + 0.1 * torch.randn(count, 2, 6)
        truth = torch.tensor([0.5, 0.1, 0.2]) + 0.1 * torch.randn(count, 1, 5, 3).expand(-1, 2, -1, -1)
        T = pose_end_effector(geometry, state[:, 1, :6])
        share = torch.linspace(0.1, 1, CHUNK)[:, None]
        path = (1 - share) * T[:, None, :3, 3] + share * truth[:, 1, :1]
        quats = torch.from_numpy(quat_from_matrix(T[:, :3, :3].double().numpy())).float()
        action = torch.cat([path, quats[:, None].expand(-1, CHUNK, -1), torch.ones(count, CHUNK, 1)], -1)
        padding = torch.zeros(count, CHUNK, dtype=torch.bool)
        told = {"observation.environment_state": truth.flatten(2), "action_is_pad": padding}
        return {"observation.state": state, "action": action, **told}

    policy.train()
    check(not any(part.training for part in policy.finder.modules()), "the finder is not trained")
    batch = demonstrate(8)
    cut = {**batch, "action_is_pad": (torch.arange(CHUNK) >= 5).expand(8, -1)}
    beyond = {**cut, "action": cut["action"] + 100 * cut["action_is_pad"][..., None]}
    losses = []
    for part, coarse in ((cut, False), (beyond, False), (cut, True)):
        torch.manual_seed(1)
        with torch.autocast("cpu", torch.bfloat16, enabled=coarse):
            losses.append(policy(part)[0])
    check(torch.isclose(losses[0], losses[1]), "what lies beyond an episode's end does not count")
    check(torch.equal(losses[0], losses[2]), "mixed precision changes nothing")
    optimizer = torch.optim.AdamW(policy.get_optim_params(), 2e-3)
    first = policy(demonstrate(256))[0].item()
    for _ in range(150):
        loss = policy(demonstrate(64))[0]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    last = policy(demonstrate(256))[0].item()
    check(last < 0.25 * first, f"it learns to approach the grasp point ({first:.3f} to {last:.3f})")

    seen = {f"observation.images.{name}": torch.rand(1, 3, SIZE[1], SIZE[0]) for name in names}
    seen["observation.state"] = demonstrate(1)["observation.state"][:, 1]
    policy.reset()
    chunk = policy.predict_action_chunk(seen)
    check(chunk.shape == (1, CHUNK, 8) and policy.points_world.shape == (5, 3), "poses and found points")
    check(torch.allclose(chunk[..., 3:7].norm(dim=-1), torch.ones(1, CHUNK), atol=1e-5), "unit quaternions")
    policy.reset()
    check(torch.allclose(policy.select_action(seen), chunk[:, 0]), "the first action is the chunk's")
    policy.save_pretrained(folder / "policy")
    (folder / "finder.safetensors").unlink()
    # LeRobot prints a line about the weights.
    with contextlib.redirect_stdout(io.StringIO()):
        loaded = HandleACTPolicy.from_pretrained(folder / "policy")
    check(torch.allclose(loaded.predict_action_chunk(seen), chunk, atol=1e-6), "a checkpoint is complete")
    check(torch.equal(loaded.errors, policy.errors), "it contains the errors, so that training can go on")

    shifted = {
        name: camera.move(camera.T_world_cam + 0.1 * np.eye(4, k=3)) for name, camera in cameras.items()
    }
    loaded.reset()
    before, _ = loaded.find_points(seen)
    loaded.place_cameras({**shifted, mounted: robot.cameras[mounted][1].resize(*SIZE)})
    after, _ = loaded.find_points(seen)
    check((after - before).norm(dim=-1).min() > 0.005, "points move with the cameras")

    for changed, words in (
        ({"output_features": {"action": PolicyFeature(FeatureType.ACTION, (7,))}}, "ee_absolute"),
        ({"input_features": {"observation.state": features["observation.state"]}}, "--media keypoints"),
        ({"suite": ""}, "--policy.suite"),
    ):
        try:
            HandleACTPolicy(make_config(**changed))
            print(f"failed: {words} is wanted")
        except ValueError as error:
            check(words in str(error), f"{words} is named")
trained = sum(parameter.numel() for parameter in policy.get_optim_params())
check(trained <= 600_000, "at most 0.6 million parameters are trained on demonstrations")
