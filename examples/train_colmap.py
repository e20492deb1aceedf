"""Train Gaussians on a COLMAP folder: python examples/train_colmap.py folder --out scene.ply

The folder holds undistorted images and a binary model: images/ and sparse/0/. Gaussians start on
dense points that plane sweeps between the images find, or on the model's points with --sparse.
Every eighth image is held out; the mean PSNR over those is printed.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.structure import Structure, held_out
from aomgen.gaussians.dense_points import DensifyParams, densify
from aomgen.gaussians.train import evaluate_view, initial_gaussians
from aomgen.io.colmap import ColmapView, read_colmap
from aomgen.io.images import read_image, resize
from aomgen.io.ply import write_gaussians
from aomgen.splatting.initialization import gaussians_from_points
from aomgen.splatting.training import TrainingParams, train


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("scene.ply"))
    parser.add_argument("--images", default="images", help="folder of images, for example images_4")
    parser.add_argument("--max-side", type=int, default=640, help="larger images are reduced to this [px]")
    parser.add_argument(
        "--sparse", action="store_true", help="start from the model's points: blurrier, sooner"
    )
    parser.add_argument("--iterations", type=int, default=1800)
    parser.add_argument("--max-gaussians", type=int, default=100_000)
    parser.add_argument("--sh-degree", type=int, choices=range(4), default=2)
    options = parser.parse_args()

    model = read_colmap(options.folder, images=options.images)
    views = {name: loaded(view, options.max_side) for name, view in model.views.items()}
    structure = Structure(
        cameras_recon={name: camera for name, (camera, _) in views.items()},
        demo_cameras_recon={},
        dropped={},
        points_recon=model.points_recon,
        colors_srgb=model.colors_srgb,
        observations=model.observations,
        reprojection_error_px=float("nan"),
    )
    images = {name: image for name, (_, image) in views.items()}
    start = time.perf_counter()
    test = held_out(list(images))
    learned = {name: image for name, image in images.items() if name not in test}
    if options.sparse:
        initial = gaussians_from_points(model.points_recon, model.colors_srgb)
    else:
        params = DensifyParams(target_points=int(0.7 * options.max_gaussians))
        initial = initial_gaussians(densify(structure, learned, params, show))
    print(f"\n{len(learned)} images to learn from, {len(test)} held out, {len(initial)} points")

    params = TrainingParams(
        iterations=options.iterations, sh_degree=options.sh_degree, max_gaussians=options.max_gaussians
    )
    cameras = [structure.cameras_recon[name] for name in learned]
    trained = train(initial, cameras, list(learned.values()), params, show, np.random.default_rng(0))
    scores = [evaluate_view(trained, structure.cameras_recon[name], images[name]).psnr_db for name in test]
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
