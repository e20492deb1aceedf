"""Draw a 3DGS file: python examples/render_ply.py scene.ply --out images [--orbit 24]

Reads any 3DGS .ply or .splat, chooses a camera from the content, and writes rgb.png and
depth.png (near is bright). Most 3DGS files have y down; --up=z is for files with z up.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from PIL import Image

from aomgen.splatting import framing_camera, read_gaussians, render

AXES = {
    f"{sign}{name}": (1 - 2 * (sign == "-")) * np.eye(3)[i]
    for sign in ("", "-")
    for i, name in enumerate("xyz")
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--out", type=Path, default=Path("pictures"))
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--up", choices=list(AXES), default="-y")
    parser.add_argument("--angles", type=float, nargs=2, default=(30, 15), metavar=("AZIMUTH", "ELEVATION"))
    parser.add_argument("--zoom", type=float, default=1.0)
    parser.add_argument("--orbit", type=int, default=0, help="also write so many pictures around the content")
    options = parser.parse_args()

    gaussians = read_gaussians(options.file)
    azimuth, elevation = options.angles

    def camera_at(turn_deg: float):
        angles = (azimuth + turn_deg, elevation)
        return framing_camera(
            gaussians, tuple(options.size), up=AXES[options.up], angles_deg=angles, zoom=options.zoom
        )

    options.out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    drawn = render(gaussians, camera_at(0), background=(1, 1, 1))
    elapsed_ms = 1e3 * (time.perf_counter() - start)
    print(f"{len(gaussians)} Gaussians of SH degree {gaussians.sh_degree}, drawn in {elapsed_ms:.1f} ms")
    save(options.out / "rgb.png", drawn.rgb)
    save(options.out / "depth.png", brightness(drawn.depth))
    for index in range(options.orbit):
        drawn = render(gaussians, camera_at(360 * index / options.orbit), background=(1, 1, 1))
        save(options.out / f"orbit_{index:03d}.png", drawn.rgb)


def brightness(depth: np.ndarray) -> np.ndarray:
    """Depth as gray values 0..1: near is bright, nothing there (depth 0) is black."""
    seen = depth[depth > 0]
    if not len(seen):
        return depth
    near, far = np.percentile(seen, [1, 99])
    return np.where(depth > 0, 1 - 0.9 * np.clip((depth - near) / max(far - near, 1e-9), 0, 1), 0)


def save(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) or (H, W) of values 0..1."""
    Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(path)


if __name__ == "__main__":
    main()
