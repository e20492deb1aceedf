"""Train Gaussians on a folder that COLMAP has registered: python examples/train_colmap.py FOLDER --out scene.ply

The folder holds undistorted images and a binary model: images/ and sparse/0/. Every eighth image is held out; the mean
PSNR over those is printed. Training starts from the model's points; `aomgen run` starts from denser ones.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from PIL import Image

from aomgen.splatting import (
    Camera,
    TrainingParams,
    gaussians_from_points,
    psnr,
    read_colmap,
    render,
    train,
    write_gaussians,
)


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
    views = [load(view.path, view.camera_recon, options.max_side) for view in model.views.values()]
    test, learned = views[::8], [view for index, view in enumerate(views) if index % 8]
    print(f"{len(learned)} images to learn from, {len(test)} held out, {len(model.points_recon)} points")

    params = TrainingParams(
        iterations=options.iterations, sh_degree=options.sh_degree, max_gaussians=options.max_gaussians
    )
    cameras, images = [camera for camera, _ in learned], [image for _, image in learned]
    initial = gaussians_from_points(model.points_recon, model.colors_srgb)
    start = time.perf_counter()
    trained = train(initial, cameras, images, params, show, np.random.default_rng(0))
    scores = [psnr(np.clip(render(trained, camera).rgb, 0, 1), image / 255) for camera, image in test]
    print(f"\n{len(trained)} Gaussians after {time.perf_counter() - start:.0f} s")
    print(f"held-out PSNR {np.mean(scores):.2f} dB")
    write_gaussians(options.out, trained)


def load(path: Path, camera: Camera, max_side: int) -> tuple[Camera, np.ndarray]:
    """Camera and image (H, W, 3) uint8, reduced where the image is larger than requested."""
    image = Image.open(path).convert("RGB")
    factor = max(image.size) / max_side
    if factor > 1:
        image = image.resize(
            (round(image.width / factor), round(image.height / factor)), Image.Resampling.BOX
        )
        camera = camera.resize(*image.size)
    return camera, np.asarray(image)


def show(share: float, text: str) -> None:
    print(f"\r{share:4.0%}  {text}    ", end="", flush=True)


if __name__ == "__main__":
    main()
