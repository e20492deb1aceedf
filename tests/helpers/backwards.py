"""Recordings reversed in time: a motion that opened an object closes it."""

from dataclasses import replace

import numpy as np

from aomgen.core.demonstration import Demonstration, RecordedObject
from aomgen.core.transforms import apply


def closing_of(demo: Demonstration) -> Demonstration:
    """Reverse in time a demonstration that opens its object; joint value 0 is the opened state."""
    joint, last = demo.joint, float(demo.times_s[0] + demo.times_s[-1])
    opened = float(demo.thetas[-1])
    return replace(
        demo,
        joints=demo.joints[::-1],
        gripper=demo.gripper[::-1],
        Ts_world_ee=demo.Ts_world_ee[::-1],
        thetas=opened - demo.thetas[::-1],
        start_s=last - demo.end_s,
        end_s=last - demo.start_s,
        joint=replace(joint, axis=-np.asarray(joint.axis)),
    )


def scanned_open(demo: Demonstration, recorded: RecordedObject) -> RecordedObject:
    """Move the object to its state after the demonstration."""
    moved = apply(demo.joint.motion(demo.thetas[-1]), recorded.moving_points_world)
    return replace(recorded, moving_points_world=moved)
