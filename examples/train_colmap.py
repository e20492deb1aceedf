"""Train Gaussians on a COLMAP folder: python examples/train_colmap.py folder --out scene.ply

The folder holds undistorted images and a binary model: images/ and sparse/0/. Every eighth image
is held out; the mean PSNR over those is printed, and the Gaussians are written as 3DGS PLY.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from aomgen.core.camera import Camera
from aomgen.io.colmap import ColmapView, read_colmap
from aomgen.io.images import read_image, resize
from aomgen.io.ply import write_gaussians
from aomgen.splatting.initialization import gaussians_from_points
from aomgen.splatting.metrics import psnr
from aomgen.splatting.rasterizer import render
from aomgen.splatting.training import TrainingParams, train

HELD_OUT_EVERY = 8


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("scene.ply"))
    parser.add_argument("--images", default="images", help="folder of images, for example images_4")
    parser.add_argument("--max-side", type=int, default=640, help="larger images are reduced to this [px]")
    parser.add_argument("--iterations", type=int, default=1800)
    parser.add_argument("--max-gaussians", type=int, default=100_000)
    parser.add_argument("--sh-degree", type=int, choices=range(4), default=2)
    options = parser.parse_args()

    model = read_colmap(options.folder, images=options.images)
    views = [loaded(view, options.max_side) for view in model.views.values()]
    learned = [view for i, view in enumerate(views) if i % HELD_OUT_EVERY]
    judged = views[::HELD_OUT_EVERY]
    print(f"{len(learned)} images to learn from, {len(judged)} held out, {len(model.points_recon)} points")

    params = TrainingParams(
        iterations=options.iterations, sh_degree=options.sh_degree, max_gaussians=options.max_gaussians
    )
    start = time.perf_counter()
    trained = train(
        gaussians_from_points(model.points_recon, model.colors_srgb),
        [camera for camera, _ in learned],
        [image for _, image in learned],
        params,
        show,
        np.random.default_rng(0),
    )
    scores = [psnr(np.clip(render(trained, camera).rgb, 0, 1), image / 255.0) for camera, image in judged]
    print(f"\n{len(trained)} Gaussians after {time.perf_counter() - start:.0f} s")
    print(f"held-out PSNR {np.mean(scores):.2f} dB")
    write_gaussians(options.out, trained)


def loaded(view: ColmapView, max_side: int) -> tuple[Camera, np.ndarray]:
    """Camera and image (H, W, 3) uint8, reduced where the image is larger than wanted."""
    image, camera = read_image(view.path), view.camera_recon
    factor = max(image.shape) / max_side
    if factor <= 1:
        return camera, image
    size = round(image.shape[1] / factor), round(image.shape[0] / factor)
    return camera.resized(*size), resize(image, *size)


def show(share: float, text: str) -> None:
    print(f"\r{share:4.0%}  {text}    ", end="", flush=True)


if __name__ == "__main__":
    main()
