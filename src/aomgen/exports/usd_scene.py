"""Export of a twin and a motion as one OpenUSD scene: Gaussians by body, articulations of robot and object, cameras.

Every body is an Xform with its Gaussians and colliders, so that physics and animation move both. The variant set
"motion" of the default prim has two variants: "demonstration" plays the motion as time samples of kinematic bodies, and
in "physics" a simulator moves the bodies from the first frame on.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.assets.usd_write import make_identifier, set_attribute
from aomgen.core.camera import Camera
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array
from aomgen.exports.scene_motion import SceneMotion
from aomgen.exports.simulated_scene import simulate_motion_scene
from aomgen.exports.usd_physics import (
    DEGREES,
    OBJECT,
    ROBOT,
    add_physics,
    drive_axis,
    find_actuated_joints,
    find_coupled_joints,
)
from aomgen.io.ply import check_readable
from aomgen.io.usd import define_gaussians, export_stage, new_stage
from aomgen.results import Results
from aomgen.simulation.scene import Scene
from aomgen.twin.twin import WORLD as WORLD_BODY

WORLD, BACKGROUND, CAMERAS = "/World", "/World/Background", "/World/Cameras"
VARIANTS, DEMONSTRATION, PHYSICS = "motion", "demonstration", "physics"
# Horizontal aperture of all cameras, 36 mm, in tenths of the scene unit; only its ratio to the focal length matters.
APERTURE: Final = 0.36
# Near and far clipping distance, [m]; a wrist camera is a few centimeters from the fingers.
CLIPPING_M: Final = (0.01, 100.0)
# USD cameras have -z forward and y up, OpenCV cameras z forward and y down.
FLIP: Final = np.diag([1.0, -1.0, -1.0, 1.0])


def write_usd_scene(results: Results, motion: SceneMotion, path: Path) -> None:
    """Write the scene of a motion as one .usda, .usdc or .usdz: meters, Z up, one time code per frame.

    Colors are those of the first frame; shadows of moving bodies are not exported.

    Raises:
        StorageError: Writing to the disk failed.
    """
    from pxr import UsdGeom, UsdPhysics

    scene = simulate_motion_scene(results, motion)
    stage = new_stage(path)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(motion.fps)
    stage.SetFramesPerSecond(motion.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(motion.trajectory) - 1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, WORLD).GetPrim())
    prims = _add_bodies(stage, path, motion)
    joints = add_physics(stage, scene, _rigid_bodies(scene, prims))
    scan = {f"scan_{name}": camera for name, camera in results.scan_cameras.items()}
    moving = _add_cameras(stage, {**scan, **motion.cameras}, motion)
    variants = stage.GetDefaultPrim().GetVariantSets().AddVariantSet(VARIANTS)
    for name in (PHYSICS, DEMONSTRATION):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            frames = range(len(motion.trajectory)) if name == DEMONSTRATION else None
            _animate(stage, motion, prims, frames)
            for camera, Ts in moving.items():
                _place(stage.GetPrimAtPath(camera), Ts, frames)
            if frames:
                _make_kinematic(stage)
    _command(stage, motion, scene, joints)
    export_stage(stage, path)


def _add_bodies(stage: Any, path: Path, motion: SceneMotion) -> dict[str, str]:
    """Define an Xform with Gaussians for every body of the twin; returns their paths by name."""
    from pxr import UsdGeom

    gaussians, twin = motion.body_gaussians(), motion.twin
    for group in (ROBOT, OBJECT):
        UsdGeom.Xform.Define(stage, group)
        UsdGeom.Scope.Define(stage, f"{group}/joints")
    prims = {}
    for number, name in enumerate(twin.body_names):
        group = ROBOT if 0 < number <= len(motion.robot.body_names) else OBJECT
        prims[name] = BACKGROUND if name == WORLD_BODY else f"{group}/{make_identifier(name)}"
        body = UsdGeom.Xform.Define(stage, prims[name])
        if name != WORLD_BODY:
            body.AddTranslateOp()
            body.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
        if name in gaussians:
            check_readable(path, gaussians[name])
            define_gaussians(stage, f"{prims[name]}/Gaussians", gaussians[name])
    return prims


def _rigid_bodies(scene: Scene, prims: Mapping[str, str]) -> dict[int, str]:
    """Return the prims of the simulated bodies by their id in the model."""
    names = {name: name for name in scene.robot.body_names}
    names |= {scene.names.static_body: "object", scene.names.moving_body: "part"}
    return {scene.model.body(body).id: prims[name] for body, name in names.items()}


def _animate(stage: Any, motion: SceneMotion, prims: Mapping[str, str], frames: range | None) -> None:
    """Set the poses of all bodies at every frame, or only those of the first frame."""
    for number, name in enumerate(motion.twin.body_names):
        if name != WORLD_BODY:
            _place(stage.GetPrimAtPath(prims[name]), motion.Ts_world_body[:, number], frames)


def _place(prim: Any, Ts_world: Array, frames: range | None) -> None:
    """Set the poses (T, 4, 4) of a prim as translations and orientations; the first pose is the default."""
    from pxr import Gf, Usd, UsdGeom

    translate, orient = UsdGeom.Xformable(prim).GetOrderedXformOps()
    quats = quat_from_matrix(Ts_world[:, :3, :3])
    # With continuous signs, neighboring quaternions are interpolated along the shorter arc.
    flips = np.cumprod(np.append(1.0, np.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0)))
    for time in (Usd.TimeCode.Default(), *map(Usd.TimeCode, frames or ())):
        frame = 0 if time.IsDefault() else int(time.GetValue())
        translate.Set(Gf.Vec3d(*Ts_world[frame, :3, 3].tolist()), time)
        orient.Set(Gf.Quatd(*(flips[frame] * quats[frame]).tolist()), time)


def _make_kinematic(stage: Any) -> None:
    """Deactivate articulations and joints and make the bodies kinematic, so that time samples move them."""
    from pxr import Usd, UsdPhysics

    for group in (ROBOT, OBJECT):
        root = stage.GetPrimAtPath(group)
        set_attribute(root, "physxArticulation:articulationEnabled", False)
        for prim in Usd.PrimRange(root):
            if prim.HasAPI(UsdPhysics.RigidBodyAPI):
                UsdPhysics.RigidBodyAPI(prim).CreateKinematicEnabledAttr(True)
            if prim.IsA(UsdPhysics.Joint):
                UsdPhysics.Joint(prim).CreateJointEnabledAttr(False)


def _command(stage: Any, motion: SceneMotion, scene: Scene, joints: Mapping[int, str]) -> None:
    """Write the commanded joint values and velocities as time samples of the drives' targets."""
    from pxr import UsdPhysics

    for joint, values in _commanded_joints(motion, scene):
        prim = stage.GetPrimAtPath(joints[joint])
        axis = drive_axis(prim)
        unit = 1.0 if axis == "linear" else DEGREES
        drive = UsdPhysics.DriveAPI.Get(prim, axis)
        position, velocity = drive.GetTargetPositionAttr(), drive.CreateTargetVelocityAttr()
        position.Set(float(values[0] * unit))
        velocity.Set(0.0)
        rates = np.diff(values, append=values[-1:]) * motion.fps
        for frame, (value, rate) in enumerate(zip(values, rates, strict=True)):
            position.Set(float(value * unit), frame)
            velocity.Set(float(rate * unit), frame)


def _commanded_joints(motion: SceneMotion, scene: Scene) -> Iterator[tuple[int, Array]]:
    """Yield the commanded values (T + 1,) of every actuated joint (id), relative to the pose of the description."""
    model, gripper = scene.model, scene.gripper
    for row, name in enumerate(scene.robot.joint_names):
        joint = model.joint(name)
        yield joint.id, motion.commands[:, row] - model.qpos0[joint.qposadr[0]]
    opened, closed = gripper.driver_range
    values = opened + motion.commands[:, -1] * (closed - opened)
    actuated = find_actuated_joints(model, model.actuator(gripper.actuator).id)
    targets = {joint: values - model.qpos0[model.jnt_qposadr[joint]] for joint in actuated}
    for joint, (leader, offset, ratio) in find_coupled_joints(model, actuated).items():
        targets[joint] = offset + ratio * targets[leader]
    yield from targets.items()


def _add_cameras(stage: Any, cameras: Mapping[str, Camera], motion: SceneMotion) -> dict[str, Array]:
    """Define all cameras; returns the poses (T, 4, 4) of the prims of those that move."""
    from pxr import UsdGeom

    UsdGeom.Scope.Define(stage, CAMERAS)
    moving = {}
    for name, camera in {**cameras, **{name: path.at(0) for name, path in motion.paths.items()}}.items():
        prim = _add_camera(stage, f"{CAMERAS}/{make_identifier(name)}", camera)
        if name in motion.paths:
            moving[str(prim.GetPath())] = motion.paths[name].Ts_world_cam @ FLIP
        else:
            _place(prim, camera.T_world_cam[None] @ FLIP, None)
    return moving


def _add_camera(stage: Any, path: str, camera: Camera) -> Any:
    """Define a pinhole camera, whose translation and orientation are set later."""
    from pxr import Gf, UsdGeom

    item = UsdGeom.Camera.Define(stage, path)
    unit = APERTURE / camera.width
    focal = camera.fx * unit
    # USD has one focal length; the vertical aperture represents different values along x and y.
    item.CreateFocalLengthAttr(focal)
    item.CreateHorizontalApertureAttr(APERTURE)
    item.CreateVerticalApertureAttr(camera.height / camera.fy * focal)
    item.CreateHorizontalApertureOffsetAttr((camera.width / 2 - camera.cx) * unit)
    item.CreateVerticalApertureOffsetAttr((camera.cy - camera.height / 2) / camera.fy * focal)
    item.CreateClippingRangeAttr(Gf.Vec2f(*CLIPPING_M))
    item.AddTranslateOp()
    item.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    prim = item.GetPrim()
    set_attribute(prim, "aomgen:image_size", [float(camera.width), float(camera.height)])
    return prim
