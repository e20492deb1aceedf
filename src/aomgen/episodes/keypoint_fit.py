"""Estimate shape and pose of an unknown object from its keypoints in images.

Known objects of the same category are stretched along their axes and placed on the support, such that their keypoints project to
the detected ones. They supply what keypoints do not determine: the collision geometry, and the position of an occluded handle.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from aomgen.core.asset import AssetLink
from aomgen.core.camera import Camera
from aomgen.core.joint import LIMIT_SHARE
from aomgen.core.keypoints import find_keypoints
from aomgen.core.least_squares import Kernel, ResidualTerm, add, solve
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array

# Standard deviations of the logarithms of the factors between the sides of an object and those of a similar known one: of their
# mean, which is the size, and of their differences from it, which are the shape.
SIZE_SD, SHAPE_SD = 0.3, 0.09
# Standard deviation that is added to that of a detection, as a share of the image's width: 2 px of 240 px, because heat maps
# that are wrong are often as narrow as those that are right.
ADDED_SD: Final = 1 / 120
# Largest standard deviation of a detection that is used, as a share of the image's width: a uniform heat map has 0.29.
LARGEST_SD: Final = 1 / 6
# The Cauchy kernel reduces the influence of detections on another, similar structure of the object.
CAUCHY: Final = Kernel(scale=1.0, power=1.0)
# Number of unknowns: logarithms of three factors, rotation about the vertical, horizontal position.
UNKNOWNS: Final = 6
MAX_ITERATIONS, TOLERANCE = 30, 1e-4


def fit_known_objects(
    known: Sequence[FittedAsset],
    cameras: Sequence[Camera],
    pixels: Array,
    sds_px: Array,
    points_world: Array,
) -> list[tuple[FittedAsset, Variation]]:
    """Stretch and place known objects such that their keypoints agree with detected ones.

    Args:
        known: Objects of the same category. The unknown object is closed, stands on the same support, and is rotated about the
            vertical by less than 90 degrees relative to them.
        cameras: Cameras of C images.
        pixels: Detected keypoints (C, 5, 2), [px], in the order of `core.keypoints.KEYPOINTS`.
        sds_px: Standard deviations of the detections (C, 5), [px].
        points_world: Approximate keypoints (5, 3), world frame, [m].

    Returns:
        Stretched objects and their variations, the most probable one first; empty if no known object can face in the direction
        of the points.
    """
    fits = list[tuple[float, FittedAsset, Variation]]()
    for fitted in known:
        keypoints = find_keypoints(fitted.asset)
        start = _place_roughly(fitted, keypoints, points_world)
        if abs(start[3]) > np.pi / 2:
            continue
        terms = _list_terms(fitted, keypoints, cameras, pixels, sds_px)
        state = solve(
            terms,
            start,
            retract=add,
            dimension=UNKNOWNS,
            max_iterations=MAX_ITERATIONS,
            tolerance=TOLERANCE,
        ).state
        stretched = stretch(fitted, np.exp(state[:3]))
        cost = sum(term.cost(term.residual(state)) for term in terms)
        fits.append((cost, stretched, _find_variation(stretched, state)))
    return [(fitted, variation) for _, fitted, variation in sorted(fits, key=lambda fit: fit[0])]


def stretch(fitted: FittedAsset, factors: Array) -> FittedAsset:
    """Scale the colliders of an object by factors (3,) along the axes of the asset frame; meshes are omitted.

    The planned joint values are kept, unless the range of a stretched slide is too short for them. A box that is not aligned with
    the axes becomes a box of the same orientation.
    """
    asset = fitted.asset
    axis = asset.joint.axis * factors
    handle_axis = asset.handle_axis * factors
    unit = float(np.linalg.norm(axis)) if asset.joint.type == "prismatic" else 1.0
    joint = replace(
        asset.joint,
        origin=asset.joint.origin * factors,
        axis=axis / np.linalg.norm(axis),
        lower=unit * asset.joint.lower,
        upper=unit * asset.joint.upper,
    )
    return replace(
        fitted,
        thetas=fitted.thetas * min(1.0, LIMIT_SHARE * joint.upper / fitted.travel),
        asset=replace(
            asset,
            static=_stretch_link(asset.static, factors),
            moving=_stretch_link(asset.moving, factors),
            joint=joint,
            handle_point=asset.handle_point * factors,
            handle_axis=handle_axis / np.linalg.norm(handle_axis),
        ),
        contact_asset=fitted.contact_asset * factors,
    )


def _stretch_link(link: AssetLink, factors: Array) -> AssetLink:
    boxes = []
    for box in link.colliders:
        R, center = box.T_asset_box[:3, :3], box.T_asset_box[:3, 3]
        sides = np.linalg.norm(factors[:, None] * R, axis=0)
        boxes.append(
            replace(box, T_asset_box=transform(R, center * factors), half_extents=box.half_extents * sides)
        )
    return replace(link, meshes=(), colliders=tuple(boxes), mass=link.mass * float(factors.prod()))


def _place_roughly(fitted: FittedAsset, keypoints: Array, points_world: Array) -> Array:
    """Compute an initial state (6,) without stretching: the planar rigid motion that fits the keypoints best."""
    shown = keypoints @ fitted.T_world_asset[:3, :3].T
    known, located = ((points - points.mean(0))[:, :2] for points in (shown, points_world))
    products = known.T @ located
    yaw = np.arctan2(products[0, 1] - products[1, 0], products.trace())
    R = matrix_from_rotvec(np.array([0.0, 0.0, yaw]))
    return np.concatenate([np.zeros(3), [yaw], (points_world - shown @ R.T).mean(0)[:2]])


def _pose(fitted: FittedAsset, state: Array) -> Array:
    """Compute the pose T_world_asset (4, 4) of a state (6,)."""
    T = fitted.T_world_asset
    return transform(matrix_from_rotvec(np.array([0.0, 0.0, state[3]])) @ T[:3, :3], [*state[4:], T[2, 3]])


def _list_terms(
    fitted: FittedAsset, keypoints: Array, cameras: Sequence[Camera], pixels: Array, sds_px: Array
) -> list[ResidualTerm[Array]]:
    """List the evidence about a state: the detections, in units of their standard deviations, and usual sizes."""

    def compare(state: Array) -> Array:
        placed = apply(_pose(fitted, state), keypoints * np.exp(state[:3]))
        return _compare_detections(cameras, placed, pixels, sds_px)

    def compare_sides(state: Array) -> Array:
        size = state[:3].mean()
        return np.append((state[:3] - size) / SHAPE_SD, size / SIZE_SD)

    return [
        ResidualTerm(name="detections", residual=compare, kernel=CAUCHY),
        ResidualTerm(name="sides", residual=compare_sides),
    ]


def _compare_detections(cameras: Sequence[Camera], points: Array, pixels: Array, sds_px: Array) -> Array:
    """Compute the residuals (2D,) of D detections in units of their standard deviations."""
    residuals = []
    for camera, detected, sds in zip(cameras, pixels, sds_px, strict=True):
        used = sds < LARGEST_SD * camera.width
        scales = np.hypot(sds, ADDED_SD * camera.width)
        residuals.append(((camera.project(points)[0] - detected) / scales[:, None])[used].ravel())
    return np.concatenate(residuals)


def _find_variation(fitted: FittedAsset, state: Array) -> Variation:
    """Find the variation that places a stretched object at the pose of a state (6,)."""
    turned = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=float(state[3]))
    x, y = (state[4:] - turned.place_at(fitted)[:2, 3]).tolist()
    return replace(turned, x=x, y=y)
