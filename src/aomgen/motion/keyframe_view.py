"""The demonstration in the size that keyframes are looked for in."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.motion import MotionCurve
from aomgen.core.values import Array
from aomgen.io.images import resize
from aomgen.motion.demonstration import Demonstration
from aomgen.motion.hand import HandSignals, Touch, hand_signals, touch_interval
from aomgen.motion.keyframes import (
    Interval,
    KeyframeParams,
    find_interval,
    motion_scores,
    part_region,
    reference_count,
)
from aomgen.motion.moved_part import MovedPart, moved_part
from aomgen.motion.params import MotionParams
from aomgen.physics.robot_masks import MasksAt


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeView:
    """Small frames, robot masks, the part's pixels and the hand at the same times."""

    frames_srgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    region: NDArray[np.bool_]
    signals: HandSignals
    touch: Touch

    @staticmethod
    def of(demo: Demonstration, masks_at: MasksAt, params: MotionParams) -> "KeyframeView":
        """Thin and shrink the film."""
        stride = max(1, int(np.floor(demo.video.fps / params.max_fps)))
        width = min(params.width, demo.camera.width)
        small = demo.camera.resized(width, round(width * demo.camera.height / demo.camera.width))
        times, offset_s = demo.video.times_s[::stride], demo.clock_offset_s
        signals = hand_signals(demo.robot, demo.log, demo.points_moving, times, offset_s)
        frames = [resize(frame, small.width, small.height) for frame in demo.video.frames_srgb[::stride]]
        return KeyframeView(
            frames_srgb=np.stack(frames),
            masks=masks_at(times + offset_s, small.width, small.height),
            region=part_region(demo.points_moving, small),
            signals=signals,
            touch=touch_interval(signals),
        )

    def moved_part(self, demo: Demonstration, params: KeyframeParams) -> MovedPart:
        """Whether the prompted part is the one that moved."""
        height, width = self.region.shape
        static, other = (
            hand_signals(demo.robot, demo.log, points, self.signals.times_s, demo.clock_offset_s)
            for points in (demo.points_static, demo.points_other)
        )
        return moved_part(
            (demo.points_moving, demo.points_static, demo.points_other),
            (self.signals, static, other),
            self.frames_srgb,
            self.masks,
            demo.camera.resized(width, height),
            params,
        )

    def interval(self, params: KeyframeParams) -> tuple[Array, Interval]:
        """Motion scores (T,) and the interval seen in them."""
        count = reference_count(self.signals.times_s, params)
        scores = motion_scores(self.frames_srgb, self.masks, self.region, self.touch, count, params)
        return scores, find_interval(self.signals.times_s, scores, self.touch, params)

    def curve(self, scores: Array, interval: Interval) -> MotionCurve:
        """The evidence for start and end."""
        return MotionCurve(
            times_s=self.signals.times_s,
            scores=scores,
            smoothed=interval.smoothed,
            threshold=interval.threshold,
            distances_m=self.signals.distances_m,
            speeds_m_s=self.signals.speeds_m_s,
            gripper=self.signals.gripper,
        )
