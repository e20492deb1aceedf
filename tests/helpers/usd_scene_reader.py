"""A reader of exported USD scenes that is independent of the writer: Gaussians at a time, joints, cameras."""

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdVol

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians, concatenate, gaussians_of
from aomgen.core.joint import Joint


def choose(stage: Usd.Stage, motion: str) -> None:
    """Choose the version of the scene."""
    stage.GetDefaultPrim().GetVariantSets().GetVariantSet("motion").SetVariantSelection(motion)


def gaussians_at(stage: Usd.Stage, time: float | None = None) -> Gaussians:
    """Read all Gaussians of a stage in its world frame; at the default time for None."""
    cache = UsdGeom.XformCache(Usd.TimeCode.Default() if time is None else time)
    found = []
    for prim in stage.Traverse():
        if prim.IsA(UsdVol.ParticleField3DGaussianSplat):
            field = UsdVol.ParticleField3DGaussianSplat(prim)
            means = np.array(field.GetPositionsAttr().Get())
            quats = [[q.GetReal(), *q.GetImaginary()] for q in field.GetOrientationsAttr().Get()]
            sh = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
            local = gaussians_of(
                means=means,
                quats=np.array(quats),
                scales=np.array(field.GetScalesAttr().Get()),
                opacities=np.array(field.GetOpacitiesAttr().Get()),
                sh=sh.reshape(len(means), -1, 3),
            )
            found.append(local.transform(np.array(cache.GetLocalToWorldTransform(prim)).T))
    return concatenate(found)


def poses_at(stage: Usd.Stage, time: float | None = None) -> dict[str, np.ndarray]:
    """Read the poses (4, 4) of all rigid bodies by the name of their prim."""
    cache = UsdGeom.XformCache(Usd.TimeCode.Default() if time is None else time)
    return {
        prim.GetName(): np.array(cache.GetLocalToWorldTransform(prim)).T
        for prim in stage.Traverse()
        if prim.HasAPI(UsdPhysics.RigidBodyAPI)
    }


def joints_of(stage: Usd.Stage) -> dict[str, tuple[Joint, np.ndarray]]:
    """Read revolute and prismatic joints by name, world frame, at the default time, and their anchors on the child (3,)."""
    cache, found = UsdGeom.XformCache(Usd.TimeCode.Default()), {}
    for prim in stage.Traverse():
        for kind, schema in (
            ("revolute", UsdPhysics.RevoluteJoint),
            ("prismatic", UsdPhysics.PrismaticJoint),
        ):
            if prim.IsA(schema):
                item, unit = schema(prim), np.pi / 180 if kind == "revolute" else 1.0
                frames = []
                for body, position, rotation in (
                    (item.GetBody0Rel(), item.GetLocalPos0Attr(), item.GetLocalRot0Attr()),
                    (item.GetBody1Rel(), item.GetLocalPos1Attr(), item.GetLocalRot1Attr()),
                ):
                    local = Gf.Matrix4d(Gf.Rotation(rotation.Get()), Gf.Vec3d(position.Get()))
                    prims = [stage.GetPrimAtPath(path) for path in body.GetTargets()]
                    world = cache.GetLocalToWorldTransform(prims[0]) if prims else Gf.Matrix4d(1)
                    frames.append(np.array(local * world).T)
                parent, child = frames
                found[prim.GetName()] = (
                    Joint(
                        type=kind,
                        axis=parent[:3, 0],
                        origin=parent[:3, 3],
                        lower=item.GetLowerLimitAttr().Get() * unit,
                        upper=item.GetUpperLimitAttr().Get() * unit,
                    ),
                    child[:3, 3],
                )
    return found


def camera_of(stage: Usd.Stage, path: str, time: float | None = None) -> Camera:
    """Read the pinhole camera of a prim by USD's frustum."""
    prim, code = stage.GetPrimAtPath(path), Usd.TimeCode.Default() if time is None else time
    width, height = (int(x) for x in prim.GetAttribute("aomgen:image_size").Get())
    gf = UsdGeom.Camera(prim).GetCamera(code)
    frustum = gf.frustum
    low, high = frustum.window.GetMin(), frustum.window.GetMax()
    T = np.array(gf.transform).T @ np.diag([1.0, -1.0, -1.0, 1.0])
    fx, fy = width / (high[0] - low[0]), height / (high[1] - low[1])
    return Camera(
        fx=fx, fy=fy, cx=-low[0] * fx, cy=high[1] * fy, width=width, height=height, T_world_cam=T
    )  # fmt: skip
