"""The report's images of the recording: what was seen beside what was recovered."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.capture_check import read_demo_videos
from aomgen.core.camera import Camera
from aomgen.core.held_out import held_out
from aomgen.core.motion import MotionEstimate
from aomgen.core.recording import Capture
from aomgen.io.images import read_image, resize
from aomgen.io.video import Video, probe_video, read_frames
from aomgen.motion.stage import load_motion
from aomgen.parts.coverage import load_survey
from aomgen.pipeline.rendering import draw_twin, open_twin
from aomgen.pipeline.stage import Run
from aomgen.pipeline.twin_stages import demo_camera_world, scan_cameras_world
from aomgen.pipeline.working import aligned_capture_of
from aomgen.report.drawing import map_from_above, overlay_labels, overlay_outline, sheet
from aomgen.robots.robot import RobotModel
from aomgen.robots.silhouette import SilhouetteRenderer
from aomgen.twin.twin import Twin, TwinState

# sRGB; a color that scenes seldom have.
OUTLINE = (255, 60, 200)
# Colors of places that no view, few views and enough views saw.
SEEN = np.array([(205, 45, 45), (235, 180, 40), (60, 150, 90)], np.uint8)
Image8 = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovered:
    """Everything the images are made from."""

    run: Run
    capture: Capture
    video: Video
    camera: Camera
    motion: MotionEstimate
    twin: Twin
    robot: RobotModel

    def state(self, frame: int) -> TwinState:
        """The twin's state at a video frame, as estimated."""
        time = self.video.times_s[frame] + self.motion.clock_offset_s
        joints, gripper = self.capture.joint_log.at([time])
        return TwinState(
            joints=joints[0],
            gripper=float(gripper[0]),
            theta=float(self.motion.thetas[frame]),
            T_world_object=self.twin.T_world_object,
        )

    def spread_frames(self, count: int) -> list[int]:
        """Frame numbers evenly over the video."""
        return [int(frame) for frame in np.linspace(0, len(self.video.times_s) - 1, count)]


def open_recovered(run: Run) -> Recovered:
    """Load what a run recovered.

    Raises:
        MissingFileError: The run has not come that far.
    """
    capture = aligned_capture_of(run)
    twin, robot = open_twin(run.out)
    return Recovered(
        run=run,
        capture=capture,
        video=read_demo_videos(capture)[capture.cameras[0].name],
        camera=demo_camera_world(run),
        motion=load_motion(run.folders["motion"]),
        twin=twin,
        robot=robot,
    )


def heldout_sheet(data: Recovered, count: int = 4) -> Image8:
    """Held-out scan images above renders of the twin from the same places."""
    cameras = scan_cameras_world(data.run)
    paths = {path.name: path for path in data.capture.scan_images}
    names = [name for name in held_out(list(paths)) if name in cameras]
    picked = [names[i] for i in np.linspace(0, len(names) - 1, min(count, len(names))).astype(int)]
    real = [_small(read_image(paths[name])) for name in picked]
    drawn = [
        _small(draw_twin(data.twin, data.robot, cameras[name], data.twin.scan_state)[0]) for name in picked
    ]
    return sheet(real + drawn, len(picked))


def parts_sheet(data: Recovered, count: int = 4) -> Image8:
    """Part labels of the Gaussians over scan images."""
    cameras = scan_cameras_world(data.run)
    names = sorted(cameras)
    picked = [names[i] for i in np.linspace(0, len(names) - 1, count + 2).astype(int)[1:-1]]
    paths = {path.name: path for path in data.capture.scan_images}
    images = []
    for name in picked:
        labels = draw_twin(data.twin, data.robot, cameras[name], data.twin.scan_state)[1]
        images.append(_small(overlay_labels(read_image(paths[name]), labels)))
    return sheet(images, len(images))


def coverage_map(data: Recovered) -> Image8:
    """Sides of object, robot and table from above: red never seen, yellow too little, green enough."""
    found = load_survey(data.run.folders["parts"])
    seen = np.where(found.coverage.enough, 2, np.where(found.coverage.views > 0, 1, 0))
    cameras = scan_cameras_world(data.run)
    withheld = held_out([path.name for path in data.capture.scan_images])
    training = [camera for name, camera in cameras.items() if name not in withheld]
    return map_from_above(found.points_world, SEEN[seen], training)


def robot_sheet(data: Recovered, count: int = 4) -> Image8:
    """The robot model's outline over the video, at the estimated clock offset and camera."""
    images = []
    height, width = data.video.frames_srgb.shape[1:3]
    with SilhouetteRenderer(data.robot, max_width=width, max_height=height) as renderer:
        for frame in data.spread_frames(count):
            state = data.state(frame)
            bodies, _ = renderer.draw(data.camera, state.joints, state.gripper)
            images.append(_small(overlay_outline(data.video.frames_srgb[frame], bodies >= 0, OUTLINE)))
    return sheet(images, count)


def replay_sheet(data: Recovered, count: int = 4) -> Image8:
    """Video frames above the twin's replay of them."""
    frames = data.spread_frames(count)
    real = [_small(data.video.frames_srgb[frame]) for frame in frames]
    drawn = [_small(draw_twin(data.twin, data.robot, data.camera, data.state(frame))[0]) for frame in frames]
    return sheet(real + drawn, count)


def demo_strip(data: Recovered, count: int = 6) -> list[Image8]:
    """Frames of the recorded demonstration."""
    return [_small(data.video.frames_srgb[frame]) for frame in data.spread_frames(count)]


def episode_strip(folder: Path, camera: str, count: int) -> list[Image8]:
    """Frames of one committed episode from one camera."""
    path = folder / f"{camera}.mp4"
    return read_frames(path, [int(i) for i in np.linspace(0, probe_video(path).frames - 1, count)])


def _small(image: Image8, width: int = 320) -> Image8:
    return resize(image, width, round(image.shape[0] * width / image.shape[1]))
