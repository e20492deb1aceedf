"""Images of all styles of generated assets, one category per row, in one JPEG."""

from pathlib import Path
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from aomgen.assets.choice import MAKERS, OTHER_MAKERS, list_styles, make_asset
from aomgen.assets.mjcf import VISUAL_GROUP, add_asset
from aomgen.core.asset import ArticulatedAsset

# Size of one image, [px]; opening of the parts, as a share of their range.
SIZE: Final = (248, 196)
OPENED: Final = 0.12
# Viewing direction, field of view [deg], and distance in diagonals of the asset.
AZIMUTH_DEG, ELEVATION_DEG, FOV_DEG, AWAY = 62.0, -24.0, 20.0, 2.5


def draw_styles(path: Path) -> None:
    """Write one image: a row for each category, a column for each of its styles, which follow from the first seeds."""
    rows = []
    for category in MAKERS | OTHER_MAKERS:
        seeds = range(1, 1 + len(list_styles(category)))
        rows.append(np.concatenate([draw_asset(make_asset(category, seed)) for seed in seeds], axis=1))
    Image.fromarray(np.concatenate(rows)).save(path, quality=85, optimize=True)


def draw_asset(asset: ArticulatedAsset) -> NDArray[np.uint8]:
    """Render an image (H, W, 3) of an asset on a white floor."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    names = add_asset(spec, asset, np.eye(4), damping=0.0, frictionloss=0.0, visual=True)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[20, 20, 0.1], rgba=[0.93, 0.93, 0.92, 1], group=VISUAL_GROUP
    )
    spec.worldbody.add_light(
        pos=[-0.8, -1.2, 2.0],
        dir=[0.35, 0.5, -0.8],
        diffuse=[0.6] * 3,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
    )
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.25] * 3
    spec.visual.global_.fovy = FOV_DEG
    model = spec.compile()
    data = mujoco.MjData(model)
    data.joint(names.joint).qpos[0] = OPENED * asset.joint.upper
    mujoco.mj_forward(model, data)
    points = np.concatenate([mesh.vertices for link in (asset.static, asset.moving) for mesh in link.meshes])
    camera, options = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.lookat[:] = (points.min(0) + points.max(0)) / 2
    camera.distance = AWAY * float(np.linalg.norm(np.ptp(points, axis=0)))
    camera.azimuth, camera.elevation = AZIMUTH_DEG, ELEVATION_DEG
    options.geomgroup[:] = 0
    options.geomgroup[VISUAL_GROUP] = 1
    with mujoco.Renderer(model, *SIZE[::-1]) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = False
        renderer.update_scene(data, camera, options)
        return renderer.render()
