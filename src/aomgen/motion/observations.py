"""Demonstration at the resolution at which keyframes are searched."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.exposure import match_frames
from aomgen.core.motion import MotionCurve
from aomgen.errors import NoMotionError
from aomgen.io.images import resize
from aomgen.motion.ee_path import GripperPath, smooth
from aomgen.motion.inputs import (
    GripperSignals,
    MotionInput,
    find_touch,
    measure_pad_distances,
    measure_surface_gaps,
    read_gripper_signals,
    refine_touch,
)
from aomgen.motion.keyframes import (
    ChangeFractions,
    find_interval,
    find_part_region,
    measure_change_fractions,
    widen,
)
from aomgen.motion.motion_detection import (
    MotionEvidence,
    PartIdentification,
    estimate_following,
    find_visible_regions,
    identify_part,
)
from aomgen.robots.silhouette import MasksAt

# Width of the smoother of the dense end-effector path, [s]; short compared with any commanded motion.
_WAY_SMOOTH_S = 0.1
# Faster videos are thinned to this rate or somewhat more, [1/s]: a motion lasts seconds.
LEAST_FPS = 15.0
# Fewer frames cannot show two rest states and a motion between them.
_LEAST_FRAMES = 5
# Step of dense times, [s]: that of a 100 Hz joint log.
DENSE_STEP_S = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoObservations:
    """Small frames of one exposure without the bad ones, robot masks, and the gripper at the same times.

    Attributes:
        camera: Camera of the small frames.
        frames_srgb: (T, H, W, 3).
        masks: Masks of the robot (T, H, W).
        signals: The gripper at the frames' times.
        way: Path of the gripper over dense times of the whole video.
        seen: The part's change fractions in the frames, with the touch.
        interval: Start and end of the motion seen in these, [s], whether or not they are evidence of one.
    """

    camera: Camera
    frames_srgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    signals: GripperSignals
    way: GripperPath
    seen: ChangeFractions
    interval: tuple[float, float]

    @staticmethod
    def of(demo: MotionInput, masks_at: MasksAt, width: int) -> "VideoObservations":
        """Reduce the frame rate of the video and resize it to a width, [px].

        Raises:
            NoMotionError: The video has too few frames.
        """
        stride = choose_frame_step(demo.video.fps)
        width = min(width, demo.camera.width)
        small = demo.camera.resize(width, round(width * demo.camera.height / demo.camera.width))
        times = demo.video.times_s[::stride]
        frames = [resize(frame, small.width, small.height) for frame in demo.video.frames_srgb[::stride]]
        masks = masks_at(times, small.width, small.height)
        region = find_part_region(demo.points_moving, small)
        matched, bad = match_frames(np.stack(frames), masks, region)
        good = ~bad
        if not good.sum() >= _LEAST_FRAMES:
            raise NoMotionError(
                "demonstration video",
                f"has {int(good.sum())} frames that can be compared, need {_LEAST_FRAMES}",
                "check that the camera does not move and that the video shows the whole motion",
            )
        way = _way(demo, float(times[0]), float(times[-1]))
        times, images, masks = times[good], matched[good], masks[good]
        signals = read_gripper_signals(demo, times)
        touch = find_touch(signals)
        if not touch.gripped and demo.robot.hand_bodies:
            touch = refine_touch(touch, times, measure_surface_gaps(demo, times))
        seen = measure_change_fractions(times, images, masks, region, touch)
        pixel_m = float(np.median(small.project(demo.points_moving)[1])) / small.fx
        return VideoObservations(
            camera=small,
            frames_srgb=images,
            masks=masks,
            signals=signals,
            way=way,
            seen=seen,
            interval=find_interval(seen, way, pixel_m),
        )

    def identify_part(self, demo: MotionInput) -> PartIdentification:
        """Compare the prompted part with its rivals as the one that moved."""
        static, other = (
            measure_pad_distances(demo, points, self.signals.times_s)
            for points in (demo.points_static, demo.points_other)
        )
        regions = find_visible_regions(demo.scene, demo.labels, self.camera)
        return identify_part(regions, self.signals, (static, other), self.frames_srgb, self.masks)

    def weigh_motion(self, demo: MotionInput) -> MotionEvidence:
        """Weigh the evidence for and against a motion."""
        times, touch = self.signals.times_s, self.seen.touch
        last = int(np.searchsorted(times, self.interval[1], side="right"))
        during = slice(touch.first, min(max(last, touch.first + 3), touch.last) + 1)
        held = self.way.between(float(times[during][0]), float(times[during][-1]))
        followed, followed_sd = estimate_following(
            demo.scene,
            demo.labels,
            self.camera,
            self.frames_srgb[during],
            widen(self.masks[during]),
            self.signals.Ts_world_ee[during],
        )
        return MotionEvidence(
            changed=float(self.seen.smoothed.max()),
            followed=followed,
            followed_sd=followed_sd,
            nearest_m=float(self.signals.distances_m.min()),
            travel_m=float(held.travel.max(initial=0.0)),
        )

    @property
    def curve(self) -> MotionCurve:
        """The evidence for start and end."""
        return MotionCurve(
            times_s=self.signals.times_s,
            scores=self.seen.scores,
            smoothed=self.seen.smoothed,
            threshold=self.seen.threshold,
            distances_m=self.signals.distances_m,
            speeds_m_s=self.signals.speeds_m_s,
            gripper=self.signals.gripper,
        )


def choose_frame_step(fps: float) -> int:
    """Return the largest step between used frames that keeps a rate of `LEAST_FPS`; 29.97 fps count as 30, as in NTSC."""
    return max(1, int(fps / LEAST_FPS + 0.01))


def _way(demo: MotionInput, first_s: float, last_s: float) -> GripperPath:
    times = np.arange(first_s, last_s + DENSE_STEP_S / 2, DENSE_STEP_S, dtype=np.float64)
    columns = [smooth(column, DENSE_STEP_S, _WAY_SMOOTH_S) for column in demo.ee_poses_at(times)[:, :3, 3].T]
    return GripperPath(times_s=times, points=np.stack(columns, 1))
