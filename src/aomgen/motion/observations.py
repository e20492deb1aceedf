"""The demonstration in the size that keyframes are looked for in."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.exposure import match_frames
from aomgen.core.motion import MotionCurve
from aomgen.errors import NoMotionError
from aomgen.io.images import resize
from aomgen.motion.filters import dilate, smooth
from aomgen.motion.gripper_signals import (
    GripperSignals,
    TouchInterval,
    find_touch,
    measure_surface_gaps,
    read_gripper_signals,
    refine_touch,
)
from aomgen.motion.inputs import MotionInput
from aomgen.motion.keyframes import (
    ROBOT_MARGIN_PX,
    Departures,
    Interval,
    count_reference_frames,
    find_interval,
    find_part_region,
    measure_departures,
)
from aomgen.motion.motion_test import MotionEvidence, estimate_following
from aomgen.motion.onset import GripperPath
from aomgen.motion.params import MotionParams
from aomgen.motion.part_identification import PartIdentification, identify_part
from aomgen.robots.silhouette import MasksAt

# Step of the dense end-effector path, [s]: that of a 100 Hz joint log.
_WAY_STEP_S = 0.01
# Width of its smoother, [s]; short against any commanded motion.
_WAY_SMOOTH_S = 0.1
# Faster videos are thinned to about this, [1/s]: a motion lasts seconds.
MAX_FPS = 15.0
# Fewer frames have no two rest states and a motion between them.
_LEAST_FRAMES = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoObservations:
    """Small frames of one exposure without the bad ones, robot masks, and the hand at the same times.

    Attributes:
        camera: Of the small frames.
        frames_srgb: (T, H, W, 3).
        masks: The robot (T, H, W).
        region: The part's pixels at its scanned place (H, W).
        signals: The hand at the frames' times.
        touch: When it can move the part.
        way: The hand over dense times of the whole video.
        pixel_m: Size of a pixel at the part, [m].
    """

    camera: Camera
    frames_srgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    region: NDArray[np.bool_]
    signals: GripperSignals
    touch: TouchInterval
    way: GripperPath
    pixel_m: float

    @staticmethod
    def of(demo: MotionInput, masks_at: MasksAt, params: MotionParams) -> "VideoObservations":
        """Thin and shrink the video.

        Raises:
            NoMotionError: Hardly any frames.
        """
        stride = max(1, int(np.floor(demo.video.fps / MAX_FPS)))
        width = min(params.width, demo.camera.width)
        small = demo.camera.resized(width, round(width * demo.camera.height / demo.camera.width))
        times = demo.video.times_s[::stride]
        frames = [resize(frame, small.width, small.height) for frame in demo.video.frames_srgb[::stride]]
        masks = masks_at(times, small.width, small.height)
        region = find_part_region(demo.points_moving, small)
        matched = match_frames(np.stack(frames), masks, region)
        good = ~matched.bad
        if not good.sum() >= _LEAST_FRAMES:
            raise NoMotionError(
                "demonstration video",
                f"has {int(good.sum())} frames that can be compared, need {_LEAST_FRAMES}",
                "check that the camera stands still and that the video shows the whole motion",
            )
        signals = read_gripper_signals(demo.robot, demo.log, demo.points_moving, times[good])
        touch = find_touch(signals)
        if not touch.gripped and demo.robot.hand_bodies:
            gaps = measure_surface_gaps(demo.robot, demo.log, demo.points_moving, times[good])
            touch = refine_touch(touch, signals, gaps)
        return VideoObservations(
            camera=small,
            frames_srgb=matched.frames_srgb[good],
            masks=masks[good],
            region=region,
            signals=signals,
            touch=touch,
            way=_way(demo, float(times[0]), float(times[-1])),
            pixel_m=float(np.median(small.project(demo.points_moving)[1])) / small.fx,
        )

    def identify_part(self, demo: MotionInput) -> PartIdentification:
        """Whether the prompted part is the one that moved."""
        static, other = (
            read_gripper_signals(demo.robot, demo.log, points, self.signals.times_s)
            for points in (demo.points_static, demo.points_other)
        )
        return identify_part(
            demo.scene,
            demo.labels,
            (self.signals, static, other),
            self.frames_srgb,
            self.masks,
            self.camera,
        )

    def interval(self) -> tuple[Departures, Interval]:
        """The part's departures and the interval seen in them, whether they mean a motion or not."""
        count = count_reference_frames(self.signals.times_s)
        seen = measure_departures(self.frames_srgb, self.masks, self.region, self.touch, count)
        return seen, find_interval(self.signals.times_s, seen, self.way, self.touch, self.pixel_m)

    def signs(self, demo: MotionInput, interval: Interval) -> MotionEvidence:
        """What speaks for and against a motion."""
        times, touch = self.signals.times_s, self.touch
        last = int(np.searchsorted(times, interval.end_s, side="right"))
        during = slice(touch.first, min(max(last, touch.first + 3), touch.last) + 1)
        held = self.way.between(float(times[during][0]), float(times[during][-1]))
        return MotionEvidence(
            changed=float(interval.smoothed.max()),
            following=estimate_following(
                demo.scene,
                demo.labels,
                self.camera,
                self.frames_srgb[during],
                np.stack([dilate(mask, ROBOT_MARGIN_PX) for mask in self.masks[during]]),
                self.signals.Ts_world_ee[during],
            ),
            nearest_m=float(self.signals.distances_m.min()),
            travel_m=float(held.travel.max()),
        )

    def curve(self, seen: Departures, interval: Interval) -> MotionCurve:
        """The evidence for start and end."""
        return MotionCurve(
            times_s=self.signals.times_s,
            scores=seen.scores,
            smoothed=interval.smoothed,
            threshold=interval.threshold,
            distances_m=self.signals.distances_m,
            speeds_m_s=self.signals.speeds_m_s,
            gripper=self.signals.gripper,
        )


def _way(demo: MotionInput, first_s: float, last_s: float) -> GripperPath:
    times = np.arange(first_s, last_s + _WAY_STEP_S / 2, _WAY_STEP_S, dtype=np.float64)
    points = demo.ee_poses_at(times)[:, :3, 3]
    columns = [smooth(column, _WAY_STEP_S, _WAY_SMOOTH_S) for column in points.T]
    return GripperPath(times_s=times, points=np.stack(columns, 1))
