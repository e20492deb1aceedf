"""Lit Gaussians of an asset, fitted to images of its meshes.

Discs that are only distributed over a surface extend beyond its edges and blur its texture. The fit, by the engine that renders
them later, ends them at the edges and adds discs where the image has more detail.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from aomgen.conventions import linear_from_srgb
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate
from aomgen.core.light import open_transfer
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.lighting.link_occlusion import estimate_link_transfer
from aomgen.replacement.asset_cover import cover_links
from aomgen.replacement.asset_renderer import AssetRenderer
from aomgen.splatting.compute import NativeCompute
from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, PartTensors, RasterOptions
from aomgen.splatting.optimizer import (
    RATES,
    Parameters,
    error_shares,
    gaussians_of,
    parameter_rates,
    parameters_of,
    relocate_and_grow,
)
from aomgen.splatting.rasterizer import contribution_weights
from aomgen.splatting.surfels import OPACITY, Surfels, bend_normals
from aomgen.splatting.training import one_torch_thread
from aomgen.twin.twin import move_bodies

# Number of discs before the fit, half on each link, and largest number after it.
DISCS, MAX_GAUSSIANS = 30_000, 58_000
# Number of images, and their size, [px]; each is used at full and at half size in turns.
IMAGES, IMAGE_PX = 40, 512
# Passes over all images: twice as many gain 0.7 dB.
ROUNDS: Final = 8
# Gaussians are added after these passes, where the error of this number of images is largest.
GROW_AFTER, ERROR_IMAGES = (0, 1, 2), 12
# A Gaussian that covers this area in every other image, at half size, [px], takes the mean normal of these pixels, if the mean
# of the unit normals is at least this long.
SEEN_PX, ONE_SIDE = 0.5, 0.7
# Opacity at the start: hides the surfaces behind, and its gradient does not vanish.
START_OPACITY: Final = 0.7
# Weight of the mean opacity of opaque surfaces: colors that shine through a surface would be lit as part of it.
OPAQUE: Final = 0.003
# Weight of the error of normals, and its interval in steps: a Gaussian that lies over an edge would be lit as the wrong face.
NORMAL, NORMAL_EVERY = 0.05, 4
# Gaussians with a smaller opacity are relocated.
MIN_OPACITY: Final = 0.02
# Distance that Gaussians move in a step at the start, [px].
STEP_PX: Final = 0.12
# Learning rates at the end, as a share of those at the start.
DECAY: Final = 0.1
# Range of the cameras' elevation, [rad], and of the share of an image's height that the asset's bounding sphere covers.
ELEVATIONS, FILLED = (-0.2, 1.2), (0.8, 1.1)
# Focal length over the width of an image: that of a typical camera.
FOCAL: Final = 1.2


@dataclass(frozen=True, slots=True, kw_only=True)
class _Image:
    """Image of the meshes; colors and coverage (4, H, W), and normals (3, H, W), zero where a pixel shows several faces."""

    camera: Camera
    theta: float
    rgba: Tensor
    normals: Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class _Surface:
    """Origin of Gaussians (N): their links, unit normals, and whether the surface is opaque."""

    links: NDArray[np.int64]
    normals: NDArray[np.float32]
    opaque: NDArray[np.bool_]

    def select(self, which: NDArray[np.int64]) -> "_Surface":
        return _Surface(links=self.links[which], normals=self.normals[which], opaque=self.opaque[which])


def effort() -> tuple[int, ...]:
    """Return the parameters that determine the time and the quality of a fit."""
    return DISCS, MAX_GAUSSIANS, IMAGES, IMAGE_PX, ROUNDS


def fit_surfels(asset: ArticulatedAsset, rng: np.random.Generator) -> tuple[Surfels, Surfels]:
    """Fit Gaussians whose images equal those of the meshes of an asset's static and moving link from all directions.

    Raises:
        AssetError: A link has no surface.
        BackendError: No OpenGL driver works, or the splatting engine is missing.
    """
    covers, solids = cover_links(asset, DISCS // 2, rng)
    links = np.repeat([0, 1], [len(cover.gaussians) for cover in covers])
    discs = concatenate([cover.gaussians for cover in covers])
    opaque = discs.opacities >= OPACITY
    discs = replace(discs, opacities=np.minimum(discs.opacities, START_OPACITY))
    with one_torch_thread():
        normals = np.concatenate([cover.normals for cover in covers])
        surface = _Surface(links=links, normals=normals, opaque=opaque)
        images = _images(asset, rng)
        parameters, sources = _fit(asset, parameters_of(discs, 0), surface, images, rng)
    gaussians, count = gaussians_of(parameters), len(covers[0].gaussians)
    seen = _seen_normals(asset, gaussians, surface.select(sources), images)
    albedo = linear_from_srgb(np.clip(0.5 + SH_C0 * gaussians.sh[:, 0], 0, 1)).astype(np.float32)
    transfers = estimate_link_transfer(asset, covers, solids, gaussians.means, seen, links[sources])
    fitted = []
    for link, cover in enumerate(covers):
        mine = np.flatnonzero(links[sources] == link)
        of_cover = sources[mine] - count * link
        normals = seen[mine]
        # Normal maps are stored relative to the surface that they were made for.
        same = (normals * cover.normals[of_cover]).sum(-1, keepdims=True) > ONE_SIDE
        bends = cover.bends[of_cover] * same
        fitted.append(
            Surfels(
                gaussians=gaussians.select(mine),
                normals=normals,
                bends=bends,
                albedo_linear=albedo[mine],
                transfer=_bend_transfer(transfers[mine], normals, bends),
                roughness=cover.roughness[of_cover],
                metallic=cover.metallic[of_cover],
            )
        )
    return fitted[0], fitted[1]


def _bend_transfer(
    transfer: NDArray[np.float32], normals: NDArray[np.float32], bends: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Change the transfer (N, 9) for bent normals: as that of an unoccluded surface, times the unoccluded share."""
    open_ = np.clip(transfer[:, :1] / SH_C0, 0, 1)
    change = open_transfer(bend_normals(normals, bends)) - open_transfer(normals)
    return (transfer + open_ * change).astype(np.float32)


def _images(asset: ArticulatedAsset, rng: np.random.Generator) -> list[_Image]:
    """Render images from random directions, at random values of the joint over its whole range."""
    static, moving = (
        np.concatenate([m.vertices for m in link.meshes]) for link in (asset.static, asset.moving)
    )
    found = []
    with AssetRenderer(asset, IMAGE_PX) as renderer:
        for _ in range(IMAGES):
            theta = float(rng.uniform(0.0, asset.joint.upper))
            points = np.concatenate([static, apply(asset.joint.motion(theta), moving)])
            middle = (points.min(0) + points.max(0)) / 2
            azimuth, up = rng.uniform(-np.pi, np.pi), rng.uniform(*ELEVATIONS)
            way = np.array([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)])
            radius = float(np.linalg.norm(points - middle, axis=1).max())
            eye = middle + way * radius * 2 * FOCAL / rng.uniform(*FILLED)
            f, c = FOCAL * IMAGE_PX, IMAGE_PX / 2
            camera = Camera(
                fx=f, fy=f, cx=c, cy=c, width=IMAGE_PX, height=IMAGE_PX, T_world_cam=look_at(eye, middle)
            )
            drawn = (renderer.draw(camera, theta), renderer.draw_normals(camera, theta))
            rgba, normals = (torch.tensor(np.ascontiguousarray(d.transpose(2, 0, 1))) for d in drawn)
            found.append(_Image(camera=camera, theta=theta, rgba=rgba, normals=normals))
    return found


def _fit(
    asset: ArticulatedAsset,
    parameters: Parameters,
    surface: _Surface,
    images: list[_Image],
    rng: np.random.Generator,
) -> tuple[Parameters, NDArray[np.int64]]:
    """Fit Gaussians of links 0 and 1, asset frame at joint value 0; also return the index of the disc that each comes from."""
    compute, sources = NativeCompute(), np.arange(len(surface.links))
    small = [_halve(image) for image in images]
    distance = float(np.median([np.linalg.norm(item.camera.center) for item in images]))
    step_m = STEP_PX * distance / (FOCAL * IMAGE_PX)
    steps, added = ROUNDS * len(images), MAX_GAUSSIANS - len(parameters)
    for turn in range(ROUNDS):
        for place, index in enumerate(rng.permutation(len(images))):
            step = turn * len(images) + place
            image = images[index] if step % 2 else small[index]
            with_normals = step % NORMAL_EVERY == 1
            gradients = _gradients(asset, parameters, surface.select(sources), image, with_normals)
            decay = DECAY ** (step / steps)
            parameters.step(gradients, parameter_rates(RATES, step_m * decay, decay, 0), compute)
            parameters.values["sh"].clamp_(-0.5 / SH_C0, 0.5 / SH_C0)
        if turn in GROW_AFTER:
            # Gaussians that no image shows have had no gradient.
            unseen = (parameters.squares["sh"].amax((1, 2)) == 0).numpy()
            shares = _shares(asset, parameters, surface.links[sources], small, rng)
            count = MAX_GAUSSIANS - added * (GROW_AFTER[-1] - turn) // len(GROW_AFTER)
            parameters, rows = relocate_and_grow(parameters, shares, count, MIN_OPACITY, rng, unseen)
            sources = sources[rows]
    return parameters, sources


def _halve(image: _Image) -> _Image:
    half = IMAGE_PX // 2
    camera = image.camera.resize(half, half)
    return replace(image, camera=camera, rgba=avg_pool2d(image.rgba, 2), normals=avg_pool2d(image.normals, 2))


def _gradients(
    asset: ArticulatedAsset,
    parameters: Parameters,
    surface: _Surface,
    image: _Image,
    with_normals: bool,
) -> dict[str, Tensor]:
    """Compute by name the gradients of the squared error of an image's colors and coverage, optionally also of its normals."""
    leaves, poses = parameters.leaves(), _link_poses(asset, image.theta)
    parts = PartTensors(
        indices=torch.tensor(surface.links, dtype=torch.int32),
        Ts_world_part=torch.tensor(poses, dtype=torch.float32),
    )
    features = None
    if with_normals:
        means = leaves["means"].detach().numpy()
        to_eye = _to_eye(means, poses[surface.links], surface.normals, image.camera)
        features = torch.tensor(to_eye, dtype=torch.float32)
    drawn = CpuRasterizer()(
        GaussianTensors(**leaves, features=features), image.camera, RasterOptions(sh_degree=0), parts=parts
    )
    error = (drawn.rgb - image.rgba[:3]).square().mean() + (drawn.alpha - image.rgba[3]).square().mean()
    error = error - OPAQUE * (leaves["logit_opacities"].sigmoid() * torch.tensor(surface.opaque)).mean()
    if drawn.features is not None:
        one_face = image.normals.square().sum(0) > 0
        away = (drawn.features.permute(2, 0, 1) - image.normals) * one_face
        error = error + NORMAL * away.square().mean()
    error.backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def _to_eye(means: Array, Ts_world_link: Array, normals: NDArray[np.float32], camera: Camera) -> Array:
    """Orient the normals (N, 3) of Gaussians of posed links towards a camera, because thin sheets are seen from both sides."""
    R = Ts_world_link[:, :3, :3]
    turned = np.einsum("nij,nj->ni", R, normals)
    places = np.einsum("nij,nj->ni", R, means) + Ts_world_link[:, :3, 3]
    return turned * np.where(((camera.center - places) * turned).sum(1) < 0, -1, 1)[:, None]


def _shares(
    asset: ArticulatedAsset,
    parameters: Parameters,
    links: NDArray[np.int64],
    images: list[_Image],
    rng: np.random.Generator,
) -> Array:
    """Sum the contribution of each Gaussian to the errors of some images."""
    gaussians, shares = gaussians_of(parameters), np.zeros(len(links))
    for index in rng.choice(len(images), ERROR_IMAGES, replace=False):
        image = images[index]
        posed = move_bodies(gaussians, links.astype(np.int32), _link_poses(asset, image.theta))
        shares += error_shares(posed, [image.camera], [image.rgba[:3].numpy()])
    return shares


def _seen_normals(
    asset: ArticulatedAsset, gaussians: Gaussians, surface: _Surface, images: list[_Image]
) -> NDArray[np.float32]:
    """Average for each Gaussian the unit normals (N, 3), link frames, of the pixels that show it, because some Gaussians have
    moved over an edge or through a wall. Gaussians that are not visible, or visible from both sides, keep their normal.
    """
    sums, weights = np.zeros((len(gaussians), 3)), np.zeros(len(gaussians))
    for image in map(_halve, images[::2]):
        poses = _link_poses(asset, image.theta)
        posed = move_bodies(gaussians, surface.links.astype(np.int32), poses)
        normals = image.normals.numpy()
        masks = np.concatenate([normals, np.linalg.norm(normals, axis=0, keepdims=True)])
        painted = contribution_weights(posed, image.camera, masks)
        sums += np.einsum("nji,nj->ni", poses[surface.links][:, :3, :3], painted[:, :3])
        weights += painted[:, 3]
    length = np.linalg.norm(sums, axis=1)
    known = (weights > SEEN_PX) & (length > ONE_SIDE * weights)
    found = sums / np.maximum(length, 1e-9)[:, None]
    return np.where(known[:, None], found, surface.normals).astype(np.float32)


def _link_poses(asset: ArticulatedAsset, theta: float) -> Array:
    return np.stack([np.eye(4), asset.joint.motion(theta)])
