import json

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.core.camera import Camera, look_at
from aomgen.errors import BackendError, ConfigError
from aomgen.robots.loading import load_robot
from benchmarks import path_tracer
from benchmarks.path_tracer import PathTracedRenderer, RoomLight
from benchmarks.replace_rooms import CONDITIONS
from benchmarks.replace_scores import _grown_box, _visible, run_rooms
from synthetic.layout import build_world, draw_layout

LIGHT = RoomLight(environment="studio.exr", lamp_w=10.0)


@pytest.fixture(scope="module")
def world():
    robot = load_robot("ur5e_2f85")
    return build_world(robot, draw_layout(make_asset("microwave", 3), np.random.default_rng(0)), visual=True)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A folder in which the textures of the world are encoded once."""
    return tmp_path_factory.mktemp("scenes")


@pytest.mark.slow
def test_a_scene_is_described_with_materials_and_textures(world, scenes):
    with PathTracedRenderer(world, CONDITIONS.size, scenes, LIGHT) as painter:
        painter._described.write(painter.folder)
        scene = json.loads((painter.folder / "scene.json").read_text())
        meshes = np.load(painter.folder / "meshes.npz")
        again = PathTracedRenderer(world, CONDITIONS.size, scenes, LIGHT)
        other = PathTracedRenderer(world, CONDITIONS.size, scenes, RoomLight(environment="city.exr"))
        assert again.folder == painter.folder != other.folder
        again.close()
        other.close()
    count = len(scene["mesh_materials"])
    assert count > 50
    for number in range(count):
        faces, uvs = meshes[f"faces_{number}"], meshes[f"uvs_{number}"]
        assert faces.max() < len(meshes[f"vertices_{number}"])
        textured = scene["materials"][scene["mesh_materials"][number]]["texture"]
        assert len(uvs) == 3 * len(faces) or not textured
        assert not textured or (painter.folder / textured).is_file()
    assert all(0 <= row["roughness"] <= 1 and 0 <= row["metallic"] <= 1 for row in scene["materials"])


def test_without_blender_nothing_is_traced(world, tmp_path, monkeypatch):
    monkeypatch.setenv("AOMGEN_BLENDER_PYTHON", str(tmp_path / "nowhere"))
    camera = Camera(
        fx=100, fy=100, cx=16, cy=12, width=32, height=24, T_world_cam=look_at((1, 0, 1), (0, 0, 0))
    )
    painter = PathTracedRenderer(world, (32, 24), tmp_path, LIGHT)
    with painter, pytest.raises(BackendError, match="make blender-env"):
        painter.draw(camera, world.model.qpos0)
    assert not list(tmp_path.rglob("*.png"))


def test_a_blender_that_dies_is_reported(world, scenes, tmp_path, monkeypatch):
    """Half an image that it has written is not used the next time."""
    dying = tmp_path / "python"
    half = 'read job; file=$(echo "$job" | sed "s/.*\\"file\\": \\"//; s/\\".*//")'
    dying.write_text(f'#!/bin/sh\n{half}\nmkdir -p "$(dirname "$file")"\necho cut > "$file"\nexit 3\n')
    dying.chmod(0o755)
    monkeypatch.setenv("AOMGEN_BLENDER_PYTHON", str(dying))
    camera = Camera(
        fx=100, fy=100, cx=16, cy=12, width=32, height=24, T_world_cam=look_at((1, 0, 1), (0, 0, 0))
    )
    painter = PathTracedRenderer(world, (32, 24), scenes, LIGHT)
    with painter:
        for _ in range(2):
            with pytest.raises(BackendError, match="exit code 3"):
                painter.draw(camera, world.model.qpos0)
    assert [file.read_text() for file in scenes.rglob("pictures/*")] == ["cut\n"]


def test_an_unknown_room_is_refused_before_any_work(tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'window'"):
        run_rooms(tmp_path, ["lamp", "windows"], lambda *_, **__: None, print)
    assert not list(tmp_path.iterdir())


def test_the_worker_lies_beside_its_caller():
    assert path_tracer.WORKER.is_file()


def test_a_box_grows_by_a_share_and_stays_in_the_picture():
    mask = np.zeros((100, 200), bool)
    mask[40:60, 0:100] = True
    rows, columns = _grown_box(mask)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (38, 62, 0, 110)


def test_points_behind_something_are_not_visible():
    camera = Camera(fx=10, fy=10, cx=5, cy=5, width=10, height=10, T_world_cam=np.eye(4))
    points = np.array([[[0.0, 0.0, 2.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [9.0, 0.0, 1.0]]])
    found = _visible(points, camera, np.zeros((10, 10), np.uint8), np.full((10, 10), 1.0))
    assert found.tolist() == [[False, True, False, False]]
