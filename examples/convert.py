"""Convert Gaussians: python examples/convert.py scene.splat scene.ply [--up=-y]

Reads 3DGS .ply and .splat; writes .ply (exact), .splat (8 bits, one color) and OpenUSD .usdc or
.usda (exact). With --up the scene is turned so that this axis becomes z; USD files then say z up.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from aomgen.splatting import Gaussians, read_gaussians, write_gaussians

# Rotations (axis times angle, in quarter turns) that bring an axis to z.
QUARTER_TURNS = {
    "z": (0, 0, 0),
    "-z": (2, 0, 0),
    "y": (1, 0, 0),
    "-y": (-1, 0, 0),
    "x": (0, -1, 0),
    "-x": (0, 1, 0),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument(
        "--up", choices=list(QUARTER_TURNS), default="z", help="axis of the source that points up"
    )
    parser.add_argument("--meters-per-unit", type=float, default=1.0, help="written into USD files")
    options = parser.parse_args()

    gaussians = upright(read_gaussians(options.source), options.up)
    write_gaussians(options.target, gaussians, meters_per_unit=options.meters_per_unit)
    size_mb = options.target.stat().st_size / 1e6
    print(f"{options.target}: {len(gaussians)} Gaussians, SH degree {gaussians.sh_degree}, {size_mb:.1f} MB")


def upright(gaussians: Gaussians, up: str) -> Gaussians:
    """Turned so that `up` becomes z; harmonics turn along."""
    if up == "z":
        return gaussians
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.pi / 2 * np.array(QUARTER_TURNS[up])).as_matrix()
    return gaussians.transform(T)


if __name__ == "__main__":
    main()
