import io

import numpy as np
import pytest
from PIL import Image

from aomgen.conventions import PART_LABELS
from aomgen.io.images import encode_jpeg
from aomgen.io.video import read_video
from aomgen.pipeline.rendering import render_twin
from aomgen.twin.twin import TwinState
from aomgen.viewing.opened import OpenedRun, ViewedFolder
from aomgen.viewing.scenes import PosableScene
from aomgen.web.page_server import JPEG_QUALITY

PARTS = tuple(PART_LABELS)


@pytest.fixture(scope="module")
def opened(viewed: ViewedFolder) -> OpenedRun:
    return viewed.open()


def posable(opened: OpenedRun, name: str) -> PosableScene:
    scene = opened.scene(name)
    assert isinstance(scene, PosableScene)
    return scene


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def test_a_view_equals_the_rendering_of_the_command(opened, toy_scene):
    scene = posable(opened, "recording")
    state = opened.motion("recording")[0].trajectory
    state = opened.results.states_at([4.2], state.T_world_object)[0]
    seen = scene.draw(state, toy_scene.camera, PARTS).image_srgb
    sent = np.asarray(Image.open(io.BytesIO(encode_jpeg(seen, JPEG_QUALITY, halve_colors=False))))
    assert psnr(sent, render_twin(toy_scene.twin, toy_scene.robot, toy_scene.camera, state)[0]) >= 38


def test_a_hidden_part_changes_its_pixels_alone(opened, toy_scene):
    scene = posable(opened, "recording")
    labels = render_twin(toy_scene.twin, toy_scene.robot, toy_scene.camera, scene.rest)[2]
    whole = scene.draw(scene.rest, toy_scene.camera, PARTS)
    without = scene.draw(scene.rest, toy_scene.camera, ("background", "robot", "static"))
    change = np.abs(whole.image_srgb.astype(int) - without.image_srgb).max(2)
    part = labels == PART_LABELS["moving"]
    assert np.median(change[part]) > 10
    rows, columns = np.nonzero(part)
    far = np.ones(part.shape, bool)
    far[rows.min() - 8 : rows.max() + 8, columns.min() - 8 : columns.max() + 8] = False
    assert change[far].max() == 0


def test_an_episode_is_shown_as_its_video(opened):
    motion = opened.motion("7")[0]
    frames = read_video(opened.episode("7").videos["front"]).frames_srgb
    scene = posable(opened, "7")
    for frame in (0, len(frames) - 1):
        state = TwinState(
            joints=motion.trajectory.joints[frame],
            gripper=0.0,
            theta=motion.trajectory.thetas[frame],
            T_world_object=motion.trajectory.T_world_object,
        )
        view = scene.draw(state, motion.cameras["front"].camera, PARTS)
        # Video compression leaves about 35 dB.
        assert psnr(view.image_srgb, frames[frame]) > 30
