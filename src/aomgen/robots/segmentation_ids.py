"""Reading images in which MuJoCo drew every geom in a color that encodes its number."""

import mujoco
import numpy as np
from numpy.typing import NDArray


def values_of_geoms(
    colors: NDArray[np.uint8], scene: mujoco.MjvScene, geom_values: NDArray, *, nothing: int
) -> NDArray:
    """What each pixel shows.

    Args:
        colors: (H, W, 3), drawn with `mjRND_SEGMENT` and `mjRND_IDCOLOR`.
        scene: That was drawn.
        geom_values: (G,) a value for each geom of the model.
        nothing: Value of pixels that show no geom.

    Returns:
        (H, W) of the values' type.
    """
    ids = colors.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)
    value_of_id = np.full(scene.ngeom + 1, nothing, geom_values.dtype)
    for geom in scene.geoms[: scene.ngeom]:
        if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
            value_of_id[geom.segid + 1] = geom_values[geom.objid]
    return value_of_id[ids]
