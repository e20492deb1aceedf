"""Laws of the policy with a planner, run by test_policy.py in .venv-policy: prints what failed, nothing else."""

import contextlib
import io
import json
import logging
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot_policy_aomgen import detection, modeling_handle_plan
from lerobot_policy_aomgen.configuration_handle_plan import HandlePlanConfig
from lerobot_policy_aomgen.finder import Finder, FinderErrors, FinderSettings, save_finder
from lerobot_policy_aomgen.geometry import describe_geometry, pose_end_effector, pose_views
from lerobot_policy_aomgen.lifting import project_points
from lerobot_policy_aomgen.modeling_handle_plan import HandlePlanPolicy
from lerobot_policy_aomgen.planned_motion import GAIN, TOLERATED, PlannedMotion

from aomgen.core.camera import Camera, look_at
from aomgen.core.keypoints import find_keypoints
from aomgen.core.plan import Variation
from aomgen.core.transforms import apply

sys.path.append(str(Path(__file__).parents[1] / "helpers"))
from toy_run import toy_run

SIZE = (96, 64)


def check(holds: object, law: str) -> None:
    if not bool(holds):
        print(f"failed: {law}")


optics = {"fx": 80.0, "fy": 80.0, "cx": 48.0, "cy": 32.0, "width": SIZE[0], "height": SIZE[1]}
cameras = {
    "front": Camera(**optics, T_world_cam=look_at((0.2, 0.9, 0.9), (0.8, -0.2, 0.2))),
    "side": Camera(**optics, T_world_cam=look_at((0.2, -1.1, 0.8), (0.8, -0.2, 0.2))),
}

with tempfile.TemporaryDirectory() as scratch:
    folder = Path(scratch)
    results = toy_run(folder / "run")
    vars(results)["motion"] = SimpleNamespace(direction="opening")
    vars(results)["recorded"] = SimpleNamespace(instruction="open the drawer", category="drawer")
    geometry = describe_geometry(cameras, results.robot)
    known = FinderErrors(cameras=("front", "side"), offsets=torch.zeros(2, 5, 2), spreads=torch.ones(2, 5))
    save_finder(folder / "finder.safetensors", Finder(FinderSettings(pretrained=False, crops_px=())), known)
    detection.read_geometry = lambda path, cameras: json.loads(json.dumps(geometry))
    modeling_handle_plan.open_results = lambda path: results

    def make_config(**changed: object) -> HandlePlanConfig:
        given = {
            "device": "cpu",
            "finders": [str(folder / "finder.safetensors")],
            "suite": "suite.json",
            "libraries": [str(folder / "run")],
            "known": 0,
            "output_features": {"action": PolicyFeature(FeatureType.ACTION, (7,))},
        }
        return HandlePlanConfig(**{**given, **changed})

    policy = HandlePlanPolicy(make_config())
    fitted, start = results.fitted_assets[0], results.demonstration.joints[0]
    T = Variation(seed=0, index=0, x=0.02, y=0.03, yaw=0.1).place_at(fitted)
    truth = torch.from_numpy(apply(T, find_keypoints(fitted.asset))).float()

    used = list[Finder]()

    def detect(finder: Finder, geometry: object, batch: dict[str, torch.Tensor]) -> tuple[object, ...]:
        """Return the projections of the true points, and remember the finder."""
        used.append(finder)
        joints = batch["observation.state"][:, :-1]
        views = pose_views(policy._geometry, ["front", "side"], pose_end_effector(policy._geometry, joints))
        pixels, _ = project_points(views, shown.expand(len(joints), -1, -1))
        return views, pixels, torch.full(pixels.shape[:3], 0.3)

    seen = {f"observation.images.{name}": torch.rand(1, 3, SIZE[1], SIZE[0]) for name in cameras}
    seen["observation.state"] = torch.tensor([[*start, 0.0]], dtype=torch.float32)
    check(set(policy.config.image_features) == {f"observation.images.{name}" for name in cameras}, "images")
    found = detection.detect_points(policy.finders[0], geometry, seen)
    check(found[1].shape == (1, 2, 5, 2) and found[2].shape == (1, 2, 5), "pixels and standard deviations")

    modeling_handle_plan.detect_points, shown = detect, truth[None]
    chunk = policy.predict_action_chunk(seen)
    check((policy.points_world - truth).norm(dim=-1).max() < 0.01, "the object is where the points are")
    state = seen["observation.state"]
    check((chunk[:, 0, :-1] - state[:, :-1]).abs().max() < 0.05, "the motion begins where the arm is")
    path = pose_end_effector(geometry, chunk[0, :, :-1])[:, :3, 3]
    check((path - truth[0]).norm(dim=-1).min() < 0.03, "it leads to the handle")
    check(chunk[0, :, -1].max() == 1 and chunk[0, -1, -1] < 0.5, "the gripper closes and opens")
    policy.reset()
    actions, with_images = list[torch.Tensor](), 0
    for _ in range(chunk.shape[1] + 2):
        with_images += policy.uses_images
        # The arm follows its commands exactly.
        actions.append(policy.select_action({**seen, "observation.state": actions[-1] if actions else state}))
    check(torch.allclose(torch.stack(actions[:-2], 1), chunk), "the plan of the first images is executed")
    check(with_images == 1, "only the first images are used")
    check(torch.equal(actions[-1], actions[-2]), "its last action is repeated")

    plan = policy._motions[0].plan
    moving = int(np.argmax(np.diff(plan.thetas) != 0)) + 2
    direction = np.gradient(plan.joints, axis=0)[moving]
    across = np.cross(direction[:3], [1.0, 0.0, 0.0])
    across = np.append(across / np.linalg.norm(across), np.zeros(len(direction) - 3))
    large, small = 3 * TOLERATED * across, 0.9 * TOLERATED * across
    for frame, deviation, shift in (
        (moving, large, GAIN * 2 * TOLERATED * across),
        (moving, large + direction, GAIN * 2 * TOLERATED * across),
        (moving, small, 0),
        (moving, direction, 0),
        (0, large, 0),
    ):
        shifted = PlannedMotion(plan)
        for _ in range(frame):
            shifted.next_action()
        shifted.correct(plan.joints[frame] + deviation)
        found = shifted.next_action()[:-1] - plan.joints[frame + 1]
        check(
            np.allclose(found, shift, atol=1e-9),
            "the arm yields to large deviations across the motion during the contact",
        )

    logging.disable(logging.WARNING)
    policy.reset()
    shown = truth[None] + torch.tensor([0.8, 0.0, 0.0])
    rest = policy.select_action(seen)
    check(torch.equal(rest, state), "without a plan, the arm rests")

    shown = truth[None]
    runs = {"run": results, "other": toy_run(folder / "other")}
    vars(runs["other"])["recorded"] = SimpleNamespace(instruction="open the lid", category="drawer")
    vars(runs["other"])["motion"] = results.motion
    modeling_handle_plan.open_results = lambda path: runs[path.name]
    libraries, finders = [str(folder / name) for name in runs], 2 * [str(folder / "finder.safetensors")]
    both = HandlePlanPolicy(make_config(libraries=libraries, finders=finders))
    for task, number in ((results.recorded.instruction, 0), ("open the lid", 1)):
        told = both.predict_action_chunk({**seen, "task": [task]})
        check(torch.allclose(told, chunk, atol=1e-6), "each run can be selected")
        check(used.pop() is both.finders[number], "the instruction selects the finder")
    untold = both.predict_action_chunk(seen)
    check(torch.equal(untold[:, 0], state) and untold.shape[1] == 1, "without one, the arm rests")

    policy.reset()
    policy.save_pretrained(folder / "policy")
    (folder / "finder.safetensors").unlink()
    # LeRobot prints a line about the weights.
    with contextlib.redirect_stdout(io.StringIO()):
        loaded = HandlePlanPolicy.from_pretrained(folder / "policy")
    check(torch.allclose(loaded.predict_action_chunk(seen), chunk, atol=1e-6), "a checkpoint is complete")
    moved = {name: camera.move(camera.T_world_cam + 0.1 * np.eye(4, k=3)) for name, camera in cameras.items()}
    loaded.place_cameras(moved)
    check(
        loaded._geometry["T_frame_cam"]["front"] != geometry["T_frame_cam"]["front"],
        "cameras can be replaced",
    )
    for call in (lambda: loaded.forward(seen), make_config().get_optimizer_preset):
        try:
            call()
            print("failed: a training is refused")
        except (NotImplementedError, ValueError) as error:
            check("not trained" in str(error), "the reason is named")
    for changed, named in (({"output_features": {}}, "feature action"), ({"finders": []}, "as many finders")):
        try:
            HandlePlanPolicy(make_config(**changed))
            print(f"failed: {changed} is refused")
        except ValueError as error:
            check(named in str(error), "what is missing is named")
