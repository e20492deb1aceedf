"""Fit of an asset to the pose of the recorded object, by the path of the held point.

Mode "object" scales the asset until its handle follows the recorded path (the paper's two-stage fit, with corrections).
Mode "trajectory" keeps the true size of the asset and recomputes the path. Mode "auto" is "object" if that fits, else
"trajectory".
Source: AOMGen, sec. 4.3, "Physical Interaction Adaptation".
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.joint import LIMIT_SHARE, Joint
from aomgen.core.plan import Adaptation, FittedAsset, Rejection
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity, transform
from aomgen.core.values import Array
from aomgen.replacement.correspondence import (
    RecordedContact,
    bar_reach,
    face_sides,
    held_point_of,
    mirror_asset,
    opens_left,
    slide_along_handle,
    smooth_rise,
)

# Permitted scale relative to the ratio of the moving parts' boxes: range of household sizes of one category.
SCALE_RANGE = (0.6, 1.6)
# Standard deviation of the scale about that ratio, as a share of it; it makes the fit prefer the true size.
SCALE_PRIOR_SD = 0.2
# Standard deviation of sliding along the face, stage two, [m]: a finger's width.
SLIDE_SD_M = 0.010
# Mode "object" refuses a larger RMS distance of the paths, [m]: the gripper would miss most handles.
MAX_RESIDUAL_M = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class FitParams:
    """Tolerances of the fit of an asset: standard deviations of the recorded path, [m], and of the recovered
    joint values, [rad] or [m], and whether mode "object" may mirror the asset when the hinge is on the other side.
    """

    noise_m: float = 0.003
    theta_sd: float = 0.05
    allow_mirror: bool = True


def fit_asset(
    asset: ArticulatedAsset,
    contact: RecordedContact,
    recorded_type: str,
    mode: Adaptation | Literal["auto"],
    params: FitParams,
) -> FittedAsset | Rejection:
    """Fit an asset to the pose and the motion of the recorded object.

    The asset has to be closed at joint value 0, with its front along -y and its support at z = 0.

    Returns:
        The fitted asset, with the motion in the recorded direction; or a Rejection "joint_type" (another joint
        type), "hinge_side" (mode "object" without mirroring), "size" or "path" (mode "object": no permitted scale
        follows the recorded path).

    Not checked: reach, collisions and forces; planning and verification check these.
    """
    if mode == "auto":
        scaled = fit_asset(asset, contact, recorded_type, "object", params)
        return (
            scaled
            if isinstance(scaled, FittedAsset)
            else fit_asset(asset, contact, recorded_type, "trajectory", params)
        )
    if asset.joint.type != recorded_type:
        return Rejection(reason="joint_type", detail=f"asset is {asset.joint.type}, recorded {recorded_type}")
    if mode == "trajectory":
        fitted = _keep_size(asset, contact, params)
    else:
        turned = opens_left(asset.joint, asset.handle_point, np.array([1.0, 0.0, 0.0])) != contact.opens_left
        if turned and not params.allow_mirror:
            return Rejection(
                reason="hinge_side", detail="it opens to the other side, and mirroring is not allowed"
            )
        fitted = _fit_scale(mirror_asset(asset) if turned else asset, contact, turned, params)
    if isinstance(fitted, Rejection) or contact.direction == "opening":
        return fitted
    return fitted.backwards()


def _keep_size(asset: ArticulatedAsset, contact: RecordedContact, params: FitParams) -> FittedAsset:
    """Fit an asset of true size, upright on the support, with its held point at the recorded horizontal position.

    This is mode "trajectory". The hinge may be on the other side, because the path is recomputed for the asset's joint.
    """
    held = held_point_of(asset, contact.held_share)
    R = matrix_from_rotvec(np.array([0.0, 0.0, contact.yaw]))
    offset = contact.path_world[0] - R @ held
    T = transform(R, np.array([offset[0], offset[1], contact.support_z]))
    target = min(float(contact.thetas[-1]), LIMIT_SHARE * asset.joint.upper)
    thetas = contact.thetas * (target / max(float(contact.thetas[-1]), 1e-9))
    path = apply(T @ asset.joint.motion(thetas), held[None])
    return FittedAsset(
        asset=asset,
        T_world_asset=T,
        contact_asset=held,
        shares=contact.shares,
        thetas=thetas,
        scale=1.0,
        mirrored=False,
        mode="trajectory",
        residual_mm=_rms_mm(path - contact.path_world),
    )


def _fit_scale(
    asset: ArticulatedAsset, contact: RecordedContact, turned: bool, params: FitParams
) -> FittedAsset | Rejection:
    """Fit g = [s, r, offset_x, offset_y] (scale, travel, horizontal offset) in two stages; this is mode "object".

    Stage one assumes constant speed with the total travel r. Stage two computes the joint value of every frame from
    geometry, so neither a varying speed nor sliding along the face biases the fit. The ratio of the boxes is a prior of
    s, which is weakly determined by the path for a low handle or a short arc.
    """
    held = held_point_of(asset, contact.held_share)
    low, high = asset.moving.bounds
    sides = face_sides(asset.joint, held)
    ratio = float(np.exp(np.mean(np.log(contact.size[sides] / (high - low)[sides]))))
    R = matrix_from_rotvec(np.array([0.0, 0.0, contact.yaw]))
    first = contact.path_world[0] - R @ held * ratio
    # A gripper may hold a bar at any point along it.
    bar, bar_m = R @ asset.handle_axis, ratio * bar_reach(asset)

    def noise_along(direction: ArrayLike, noise_m: float) -> float:
        return float(np.hypot(noise_m, bar_m * (np.asarray(direction, np.float64) @ bar)))

    world_noise = np.array([noise_along(axis, params.noise_m) for axis in np.eye(3)])

    def pose(g: Array) -> Array:
        return similarity(g[0], R, np.array([g[-2], g[-1], contact.support_z]))

    def prior(g: Array) -> Array:
        return np.array([(g[0] / ratio - 1) / SCALE_PRIOR_SD])

    def stage_one(g: Array) -> Array:
        moved = apply(asset.joint.motion(g[1] * contact.shares), held[None])
        distance = apply(pose(g), moved) - contact.path_world
        return np.append((distance / world_noise).ravel(), prior(g))

    def stage_two(g: Array) -> Array:
        S = pose(g)
        joint, point = asset.joint.move(S), apply(S, held)
        thetas = face_thetas(joint, point, contact.path_world)
        moved = apply(joint.motion(thetas), point[None])
        away = _weigh_slide(joint, point, moved, contact.path_world, noise_along, params)
        turn = (thetas - contact.thetas) / params.theta_sd
        return np.concatenate([away.ravel(), turn, prior(g)])

    bounds = (ratio * SCALE_RANGE[0], ratio * SCALE_RANGE[1])
    unit = 1.0 if asset.joint.type == "revolute" else 1.0 / ratio
    start = np.array([ratio, contact.thetas[-1] * unit, first[0], first[1]])
    low_g = [bounds[0], 0.0, first[0] - 0.5, first[1] - 0.5]
    high_g = [bounds[1], np.inf, first[0] + 0.5, first[1] + 0.5]
    rough = least_squares(stage_one, start, bounds=(low_g, high_g), loss="soft_l1").x
    keep = [0, 2, 3]
    fine = least_squares(
        stage_two, rough[keep], bounds=(np.array(low_g)[keep], np.array(high_g)[keep]), loss="soft_l1"
    ).x
    return _scale(asset, contact, held, pose(fine), turned, params)


def _scale(
    asset: ArticulatedAsset,
    contact: RecordedContact,
    held: Array,
    S_world_asset: Array,
    turned: bool,
    params: FitParams,
) -> FittedAsset | Rejection:
    """Apply the scale to the asset and compute its joint values from the recorded path."""
    scale = float(np.linalg.norm(S_world_asset[:3, 0]))
    sized = asset.transform(similarity(scale, np.eye(3), np.zeros(3)))
    T = transform(S_world_asset[:3, :3] / scale, S_world_asset[:3, 3])
    joint, point = sized.joint.move(T), apply(T, scale * held)
    thetas = smooth_rise(face_thetas(joint, point, contact.path_world))
    held = _shift_along_bar(sized, T, scale * held, joint.motion(thetas), contact.path_world)
    residual = apply(joint.motion(thetas), apply(T, held)[None]) - contact.path_world
    limit = LIMIT_SHARE * sized.joint.upper
    figures = {"scale": scale, "residual_mm": _rms_mm(residual), "travel": float(thetas[-1])}
    allowed_mm = 1000 * MAX_RESIDUAL_M
    if not thetas[-1] <= limit:
        detail = f"needs a travel of {thetas[-1]:.3f}, limit {limit:.3f}"
        return Rejection(reason="size", detail=detail, metrics=figures)
    if not figures["residual_mm"] <= allowed_mm:
        detail = f"paths differ by {figures['residual_mm']:.1f} mm, limit {allowed_mm:.0f} mm"
        return Rejection(reason="path", detail=detail, metrics=figures)
    return FittedAsset(
        asset=replace(sized, name=asset.name),
        T_world_asset=T,
        contact_asset=held,
        shares=contact.shares,
        thetas=thetas,
        scale=scale,
        mirrored=turned,
        mode="object",
        residual_mm=figures["residual_mm"],
    )


def _shift_along_bar(
    asset: ArticulatedAsset, T_world_asset: Array, held: Array, motions: Array, path: Array
) -> Array:
    """Move the held point (3,) along the bar of the handle to the recorded path."""
    moved = apply(motions, apply(T_world_asset, held)[None])
    bars = motions[:, :3, :3] @ (T_world_asset[:3, :3] @ asset.handle_axis)
    now = float((held - asset.handle_point) @ asset.handle_axis)
    shift = float(np.median(np.einsum("ki,ki->k", path - moved, bars)))
    return slide_along_handle(asset, now + shift)


def face_thetas(joint: Joint, held_point: Array, path: Array) -> Array:
    """Compute the joint values (K,) at which the face of the part contains the points of a path (K, 3).

    For a prismatic joint this is the distance along the axis. For a revolute joint it is the angle at which the half
    plane through the axis and the point held at joint value 0 contains the path point; sliding along the half plane
    does not change this angle.
    """
    if joint.type == "prismatic":
        return (path - held_point) @ joint.axis
    outward = np.cross(joint.axis, held_point - joint.origin)
    outward /= np.linalg.norm(outward)
    along = np.cross(outward, joint.axis)
    relative = path - joint.origin
    # The face contains the held point and the direction of the axis; `outward` is its normal and h is 0.
    return np.unwrap(np.arctan2(relative @ outward, relative @ along)).astype(np.float64)


def _weigh_slide(
    joint: Joint,
    point: Array,
    moved: Array,
    path: Array,
    noise_along: Callable[[ArrayLike, float], float],
    params: FitParams,
) -> Array:
    """Return distances (K, 2) divided by their noise: across the motion, and along the face, where a gripper may slide.

    `noise_along` returns the standard deviation of the path along a unit direction (3,), [m].
    """
    outward = joint.axis if joint.type == "prismatic" else np.cross(joint.axis, point - joint.origin)
    outward = outward / np.linalg.norm(outward)
    if joint.type == "prismatic":
        first = np.cross(outward, np.array([0.0, 0.0, 1.0]))
        first = first / max(float(np.linalg.norm(first)), 1e-9)
        second = np.cross(outward, first)
        sds = [noise_along(d, params.noise_m) for d in (first, second)]
        difference = moved - path
        return np.stack([difference @ first / sds[0], difference @ second / sds[1]], 1)
    along = np.cross(outward, joint.axis)
    lift = (moved - path) @ joint.axis
    radius = [np.linalg.norm(np.cross(p - joint.origin, joint.axis), axis=1) for p in (moved, path)]
    lift_sd = noise_along(joint.axis, params.noise_m)
    slide_sd = noise_along(along, SLIDE_SD_M)
    return np.stack([lift / lift_sd, (radius[0] - radius[1]) / slide_sd], 1)


def _rms_mm(differences: Array) -> float:
    return float(1000 * np.sqrt((differences**2).sum(-1).mean()))
