"""Find a camera by gradients: python examples/fit_pose.py scene.ply

Draws a 3DGS file from a camera, forgets it, starts from a pose a few degrees and percent away, and
descends the image's error through the rasterizer back to the pose. With a photograph in place of
the first image the same loop localizes a real camera in a scene.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from aomgen.splatting import CpuRasterizer, GaussianTensors, RasterOptions, framing_camera, read_gaussians

RATES = ((60, 1e-2), (60, 3e-3), (60, 1e-3))  # (steps, learning rate)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--off-deg", type=float, default=4.0, help="how wrong the start is")
    options = parser.parse_args()

    gaussians = read_gaussians(options.file)
    camera = framing_camera(gaussians, tuple(options.size))
    distance = float(np.linalg.norm(camera.center - np.median(gaussians.means, axis=0)))
    scene = GaussianTensors(
        means=torch.tensor(gaussians.means),
        quats=torch.tensor(gaussians.quats),
        log_scales=torch.tensor(gaussians.scales).clamp_min(1e-12).log(),
        logit_opacities=torch.tensor(gaussians.opacities).clamp(1e-6, 1 - 1e-6).logit(),
        sh=torch.tensor(gaussians.sh),
    )
    torch.set_num_threads(1)  # the rasterizer has its own threads
    draw, how = CpuRasterizer(), RasterOptions(sh_degree=gaussians.sh_degree)
    target = draw(scene, camera, how).rgb
    shift = np.eye(4)
    shift[:3, :3] = Rotation.from_rotvec(
        options.off_deg * np.array([0.6, -0.64, 0.48]), degrees=True
    ).as_matrix()
    shift[:3, 3] = 0.03 * distance * np.array([1, -1, 1])
    start = shift @ camera.T_cam_world
    T_start = torch.tensor(start, dtype=torch.float32)
    twist = torch.zeros(6, requires_grad=True)  # [rad], and shares of the distance
    optimizer = torch.optim.Adam([twist])
    for steps, rate in RATES:
        optimizer.param_groups[0]["lr"] = rate
        for _ in range(steps):
            optimizer.zero_grad()
            drawn = draw(scene, camera, how, T_cam_world=motion(twist, distance) @ T_start)
            loss = (drawn.rgb - target).abs().mean()
            loss.backward()
            optimizer.step()
        found = motion(twist.detach(), distance).double().numpy() @ start
        off = found @ camera.T_world_cam
        off_deg = np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude())
        moved = np.linalg.norm(np.linalg.inv(found)[:3, 3] - camera.center) / distance
        print(
            f"picture error {loss.item():.5f}, rotation {off_deg:.3f} deg, position {moved:.3%} of the distance"
        )


def motion(twist: Tensor, distance: float) -> Tensor:
    """Rigid transform (4, 4) of a twist: three rotations [rad], three translations over `distance`."""
    x, y, z = twist[:3]
    zero = torch.zeros(())
    rows = [(zero, -z, y), (z, zero, -x), (-y, x, zero), (zero, zero, zero)]
    generator = torch.stack([torch.stack(row) for row in rows])
    translation = torch.cat([distance * twist[3:], torch.zeros(1)])
    return torch.linalg.matrix_exp(torch.cat([generator, translation[:, None]], dim=1))


if __name__ == "__main__":
    main()
