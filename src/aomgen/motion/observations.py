"""The demonstration in the size that keyframes are looked for in."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.motion import MotionCurve
from aomgen.errors import NoMotionError
from aomgen.io.images import resize
from aomgen.motion.exposure import matched_frames
from aomgen.motion.filters import grown, smooth
from aomgen.motion.gripper_signals import (
    HandSignals,
    Touch,
    hand_signals,
    reached,
    surface_gaps,
    touch_interval,
)
from aomgen.motion.inputs import Demonstration
from aomgen.motion.keyframes import (
    Departures,
    Interval,
    KeyframeParams,
    departures,
    find_interval,
    part_region,
    reference_count,
)
from aomgen.motion.motion_test import MotionSigns
from aomgen.motion.onset import Way
from aomgen.motion.params import MotionParams
from aomgen.motion.part_identification import MovedPart, moved_part
from aomgen.motion.rendered_motion_test import following
from aomgen.robots.robot_masks import MasksAt

_WAY_STEP_S = 0.01
_WAY_SMOOTH_S = 0.1
_LEAST_FRAMES = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeView:
    """Small frames of one exposure without the bad ones, robot masks, and the hand at the same times.

    Attributes:
        camera: Of the small frames.
        frames_srgb: (T, H, W, 3).
        masks: The robot (T, H, W).
        region: The part's pixels at its scanned place (H, W).
        signals: The hand at the frames' times.
        touch: When it can move the part.
        way: The hand over dense times of the whole film.
        pixel_m: Size of a pixel at the part, [m].
    """

    camera: Camera
    frames_srgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    region: NDArray[np.bool_]
    signals: HandSignals
    touch: Touch
    way: Way
    pixel_m: float

    @staticmethod
    def of(demo: Demonstration, masks_at: MasksAt, params: MotionParams) -> "KeyframeView":
        """Thin and shrink the film.

        Raises:
            NoMotionError: Hardly any frames.
        """
        stride = max(1, int(np.floor(demo.video.fps / params.max_fps)))
        width = min(params.width, demo.camera.width)
        small = demo.camera.resized(width, round(width * demo.camera.height / demo.camera.width))
        times, offset_s = demo.video.times_s[::stride], demo.clock_offset_s
        frames = [resize(frame, small.width, small.height) for frame in demo.video.frames_srgb[::stride]]
        masks = masks_at(times + offset_s, small.width, small.height)
        region = part_region(demo.points_moving, small)
        film = matched_frames(np.stack(frames), masks, region)
        good = ~film.bad
        if not good.sum() >= _LEAST_FRAMES:
            raise NoMotionError(
                "demonstration video",
                f"has {int(good.sum())} frames that can be compared, need {_LEAST_FRAMES}",
                "check that the camera stands still and that the video shows the whole motion",
            )
        signals = hand_signals(demo.robot, demo.log, demo.points_moving, times[good], offset_s)
        touch = touch_interval(signals)
        if not touch.gripped and demo.robot.hand_bodies:
            gaps = surface_gaps(demo.robot, demo.log, demo.points_moving, times[good], offset_s)
            touch = reached(touch, signals, gaps)
        return KeyframeView(
            camera=small,
            frames_srgb=film.frames_srgb[good],
            masks=masks[good],
            region=region,
            signals=signals,
            touch=touch,
            way=_way(demo, float(times[0]), float(times[-1])),
            pixel_m=float(np.median(small.project(demo.points_moving)[1])) / small.fx,
        )

    def moved_part(self, demo: Demonstration, params: KeyframeParams) -> MovedPart:
        """Whether the prompted part is the one that moved."""
        static, other = (
            hand_signals(demo.robot, demo.log, points, self.signals.times_s, demo.clock_offset_s)
            for points in (demo.points_static, demo.points_other)
        )
        return moved_part(
            (demo.points_moving, demo.points_static, demo.points_other),
            (self.signals, static, other),
            self.frames_srgb,
            self.masks,
            self.camera,
            params,
        )

    def interval(self, params: KeyframeParams) -> tuple[Departures, Interval]:
        """The part's departures and the interval seen in them, whether they mean a motion or not."""
        count = reference_count(self.signals.times_s, params)
        seen = departures(self.frames_srgb, self.masks, self.region, self.touch, count, params)
        return seen, find_interval(self.signals.times_s, seen, self.way, self.touch, self.pixel_m, params)

    def signs(self, demo: Demonstration, interval: Interval, params: KeyframeParams) -> MotionSigns:
        """What speaks for and against a motion."""
        times, touch = self.signals.times_s, self.touch
        last = int(np.searchsorted(times, interval.end.time_s, side="right"))
        during = slice(touch.first, min(max(last, touch.first + 3), touch.last) + 1)
        held = self.way.between(float(times[during][0]), float(times[during][-1]))
        return MotionSigns(
            changed=float(interval.smoothed.max()),
            following=following(
                demo.scene,
                demo.labels,
                self.camera,
                self.frames_srgb[during],
                np.stack([grown(mask, params.dilate_px) for mask in self.masks[during]]),
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


def _way(demo: Demonstration, first_s: float, last_s: float) -> Way:
    times = np.arange(first_s, last_s + _WAY_STEP_S / 2, _WAY_STEP_S, dtype=np.float64)
    points = demo.robot.ee_poses(demo.log.at(times + demo.clock_offset_s)[0])[:, :3, 3]
    columns = [smooth(column, _WAY_STEP_S, _WAY_SMOOTH_S) for column in points.T]
    return Way(times_s=times, points=np.stack(columns, 1))
