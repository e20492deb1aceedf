"""Surfaces of primitive shapes: closed, turned outwards, as large as the shape."""

import mujoco
import numpy as np
import pytest

from aomgen.core.mesh import face_normals_areas
from aomgen.io.geom_surface import geom_surface

VOLUMES = {
    'type="box" size="0.1 0.2 0.3"': 8 * 0.1 * 0.2 * 0.3,
    'type="sphere" size="0.2"': 4 / 3 * np.pi * 0.2**3,
    'type="ellipsoid" size="0.1 0.2 0.3"': 4 / 3 * np.pi * 0.1 * 0.2 * 0.3,
    'type="capsule" size="0.1 0.3"': np.pi * 0.1**2 * 0.6 + 4 / 3 * np.pi * 0.1**3,
    'type="cylinder" size="0.1 0.3"': np.pi * 0.1**2 * 0.6,
}


@pytest.mark.parametrize("shape", VOLUMES)
def test_volume_is_the_shape_s(shape):
    geom = f'<geom {shape} pos="0.3 -0.2 0.5" euler="20 30 40"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geom}</worldbody></mujoco>")
    vertices, faces = geom_surface(model, 0)
    corners = vertices[faces]
    volume = float(np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum()) / 6
    # Positive: faces turn outwards. A circle of 32 corners lacks 0.6 % of its area, a sphere twice that.
    assert volume == pytest.approx(VOLUMES[shape], rel=0.02)
    normals, areas = face_normals_areas(vertices, faces)
    assert (normals * areas[:, None]).sum(0) == pytest.approx(0.0, abs=1e-9)


def test_planes_have_no_surface():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>'
    )
    assert geom_surface(model, 0) is None
