"""The report's images of the recording: what was seen beside what was recovered."""

from pathlib import Path

import numpy as np

from aomgen.core.structure import held_out
from aomgen.io.artifact import load_artifact
from aomgen.io.images import read_image, resize
from aomgen.io.video import probe_video, read_frames
from aomgen.parts.stage import COVERAGE
from aomgen.parts.survey import Survey
from aomgen.pipeline.rendering import render_twin
from aomgen.report.drawing import OUTLINE, Image8, map_from_above, overlay_labels, overlay_outline, sheet
from aomgen.results import Results
from aomgen.robots.silhouette import SilhouetteRenderer
from aomgen.twin.twin import TwinState

# Colors of places that no view, few views and enough views saw.
SEEN = np.array([(205, 45, 45), (235, 180, 40), (60, 150, 90)], np.uint8)


def choose_recorded_frames(results: Results, count: int) -> list[int]:
    """Frame numbers evenly over the recorded video."""
    frames = len(results.videos[results.demo_camera].times_s)
    return [int(frame) for frame in np.linspace(0, frames - 1, count)]


def estimate_recorded_states(results: Results, frames: list[int]) -> tuple[TwinState, ...]:
    """The twin's states at frames of the recorded video, as estimated."""
    times_s = results.videos[results.demo_camera].times_s[frames]
    return results.states_at(times_s, results.twin.T_world_object)


def heldout_sheet(results: Results, count: int = 4) -> Image8:
    """Held-out scan images above renders of the twin from the same places."""
    cameras = results.scan_cameras
    names = [name for name in held_out(list(results.scan_images)) if name in cameras]
    picked = [names[i] for i in np.linspace(0, len(names) - 1, min(count, len(names))).astype(int)]
    real = [_small(read_image(results.scan_images[name])) for name in picked]
    drawn = [
        _small(render_twin(results.twin, results.robot, cameras[name], results.twin.scan_state)[0])
        for name in picked
    ]
    return sheet(real + drawn, len(picked))


def parts_sheet(results: Results, count: int = 4) -> Image8:
    """Part labels of the Gaussians over scan images."""
    cameras = results.scan_cameras
    names = sorted(cameras)
    picked = [names[i] for i in np.linspace(0, len(names) - 1, count + 2).astype(int)[1:-1]]
    images = []
    for name in picked:
        labels = render_twin(results.twin, results.robot, cameras[name], results.twin.scan_state)[2]
        images.append(_small(overlay_labels(read_image(results.scan_images[name]), labels)))
    return sheet(images, len(images))


def coverage_map(results: Results) -> Image8:
    """Sides of object, robot and table from above: red never seen, yellow too little, green enough."""
    found = load_artifact(results.folders["parts"], COVERAGE, Survey)
    seen = np.where(found.coverage.enough, 2, np.where(found.coverage.views > 0, 1, 0))
    cameras = results.scan_cameras
    withheld = held_out(list(results.scan_images))
    training = [camera for name, camera in cameras.items() if name not in withheld]
    return map_from_above(found.points_world, SEEN[seen], training)


def robot_sheet(results: Results, count: int = 4) -> Image8:
    """The robot model's outline over the video, at the estimated clock offset and camera."""
    images = []
    video, frames = results.videos[results.demo_camera], choose_recorded_frames(results, count)
    height, width = video.frames_srgb.shape[1:3]
    with SilhouetteRenderer(results.robot, max_width=width, max_height=height) as renderer:
        for frame, state in zip(frames, estimate_recorded_states(results, frames), strict=True):
            bodies, _ = renderer.draw(results.fixed_camera.camera, state.joints, state.gripper)
            images.append(_small(overlay_outline(video.frames_srgb[frame], bodies >= 0, OUTLINE)))
    return sheet(images, count)


def replay_sheet(results: Results, count: int = 4) -> Image8:
    """Video frames above the twin's replay of them."""
    states = estimate_recorded_states(results, choose_recorded_frames(results, count))
    camera = results.fixed_camera.camera
    drawn = [_small(render_twin(results.twin, results.robot, camera, state)[0]) for state in states]
    return sheet(demo_strip(results, count) + drawn, count)


def demo_strip(results: Results, count: int = 6) -> list[Image8]:
    """Frames of the recorded demonstration."""
    video = results.videos[results.demo_camera]
    return [_small(video.frames_srgb[frame]) for frame in choose_recorded_frames(results, count)]


def episode_strip(folder: Path, camera: str, count: int) -> list[Image8]:
    """Frames of one committed episode from one camera."""
    path = folder / f"{camera}.mp4"
    return read_frames(path, [int(i) for i in np.linspace(0, probe_video(path).frames - 1, count)])


def _small(image: Image8, width: int = 320) -> Image8:
    return resize(image, width, round(image.shape[0] * width / image.shape[1]))
