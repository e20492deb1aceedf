"""A training that a test kills; writes its result when it comes to the end."""

import sys
from pathlib import Path

import numpy as np

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.io.artifact import npz_bytes
from aomgen.io.atomic import write_bytes
from aomgen.splatting.checkpoint import Checkpoint
from aomgen.splatting.training import TrainingParams, train

COUNT, VIEWS = 4000, 6


def main(folder: Path) -> None:
    """Train with a checkpoint every few iterations, saying one word for each ten."""
    rng = np.random.default_rng(0)
    scene = Gaussians(
        means=rng.uniform(-0.5, 0.5, (COUNT, 3)),
        quats=rng.normal(size=(COUNT, 4)),
        scales=np.full((COUNT, 3), 0.03),
        opacities=np.full(COUNT, 0.8),
        sh=np.zeros((COUNT, 1, 3)),
    )
    angles = 2 * np.pi * np.arange(VIEWS) / VIEWS
    eyes = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(VIEWS, 0.6)], 1)
    cameras = [
        Camera(fx=120, fy=120, cx=48, cy=36, width=96, height=72, T_world_cam=look_at(eye, [0, 0, 0]))
        for eye in eyes
    ]
    images = [rng.integers(0, 255, (72, 96, 3), np.uint8) for _ in cameras]

    def progress(share: float, text: str) -> None:
        sys.stdout.write(f"{share:.2f}\n")
        sys.stdout.flush()

    params = TrainingParams(iterations=200, max_gaussians=5000, grow_every=20, sh_degree=1)
    checkpoint = Checkpoint(path=folder / "training.checkpoint", every=15)
    trained = train(scene, cameras, images, params, progress, rng, checkpoint=checkpoint)
    write_bytes(folder / "result.npz", npz_bytes({"means": trained.means, "sh": trained.sh}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
