"""Speed and accuracy of render sessions relative to full renders of the same frames."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np

from aomgen.core.gaussians import concatenate
from aomgen.splatting import native
from aomgen.splatting.rasterizer import RigidParts
from aomgen.splatting.session import Motion, RenderSession
from benchmarks.moving_scenes import MovingScene, touched_share
from benchmarks.timing import draw_planes, interleaved_ms

BATCH_FRAMES = 24


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionSpeed:
    """Medians, [ms].

    Attributes:
        picture_ms: Time of an 8-bit image, rendered over that of the previous frame.
        draw_ms: Time of color, depth and alpha as floats, into new arrays.
        full_ms: Time of the same floats, by a full render of static and moving Gaussians together.
        speed_over_full: full_ms over picture_ms, median of the rounds.
        frames_per_s: 8-bit images in a batch of `BATCH_FRAMES`, spread over the threads.
        tiles_share: Tiles in which moving Gaussians are visible in a frame or in the previous one.
        max_difference: Largest difference of red, green, blue or alpha from a full render.
    """

    picture_ms: float
    draw_ms: float
    full_ms: float
    speed_over_full: float
    frames_per_s: float
    tiles_share: float
    max_difference: float


def measure_session(scene: MovingScene, threads: int, isa: str, repeats: int) -> SessionSpeed:
    """Time frames of a session and full renders of the same frames alternately.

    Args:
        scene: Static and moving Gaussians.
        threads: Worker threads.
        isa: One of `native.instruction_sets()`.
        repeats: Number of frames of each kind, and of batches.
    """
    session = RenderSession(scene.static, scene.camera, threads=threads, instruction_set=isa)
    context = native.Context(threads, isa)
    times = interleaved_ms(_passes(scene, session, context), repeats)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    batch_ms = medians.pop("batch_ms")
    return SessionSpeed(
        **medians,
        speed_over_full=float(np.median(times["full_ms"] / times["picture_ms"])),
        frames_per_s=1e3 * BATCH_FRAMES / batch_ms,
        tiles_share=touched_share(scene, 1),
        max_difference=_difference(scene, session, context),
    )


def _passes(
    scene: MovingScene, session: RenderSession, context: native.Context
) -> dict[str, Callable[[], None]]:
    parts, motion = _frames(scene, scene.parts)
    everything = concatenate([scene.static, scene.moving])
    together, _ = _frames(scene, _parts_of_everything(scene), standing=True)
    planes = np.empty((5, scene.camera.height, scene.camera.width), np.float32)
    picture = session.picture(scene.moving, parts[0])
    numbers = {name: count() for name in ("picture", "draw", "full")}

    def next_frame(name: str) -> int:
        return next(numbers[name]) % BATCH_FRAMES

    return {
        "picture_ms": lambda: _ignore(
            session.picture(scene.moving, parts[next_frame("picture")], into=picture)
        ),
        "draw_ms": lambda: _ignore(session.draw(scene.moving, parts[next_frame("draw")])),
        "full_ms": lambda: draw_planes(
            everything, scene.camera, context, planes, together[next_frame("full")]
        ),
        "batch_ms": lambda: _ignore(session.draw_many(scene.moving, motion)),
    }


def _ignore(_: Any) -> None:
    return None


def _parts_of_everything(scene: MovingScene) -> np.ndarray:
    """Return part 0 for static Gaussians, followed by the parts of the scene."""
    return np.concatenate([np.zeros(len(scene.static), np.int32), scene.parts + 1])


def _frames(
    scene: MovingScene, indices: np.ndarray, *, standing: bool = False
) -> tuple[list[RigidParts], Motion]:
    Ts = np.stack([scene.Ts_world_part(frame) for frame in range(BATCH_FRAMES)])
    if standing:
        Ts = np.concatenate([np.broadcast_to(np.eye(4), (BATCH_FRAMES, 1, 4, 4)), Ts], 1)
    parts = [RigidParts(indices=indices, Ts_world_part=frame) for frame in Ts]
    return parts, Motion(parts=indices, Ts_world_part=Ts)


def _difference(scene: MovingScene, session: RenderSession, context: native.Context) -> float:
    """Compute the largest difference of a few frames of the session from full renders with a context."""
    everything = concatenate([scene.static, scene.moving])
    parts, _ = _frames(scene, scene.parts)
    together, _ = _frames(scene, _parts_of_everything(scene), standing=True)
    planes = np.empty((5, scene.camera.height, scene.camera.width), np.float32)
    worst = 0.0
    for frame in (0, 1, 7):
        drawn = session.draw(scene.moving, parts[frame])
        draw_planes(everything, scene.camera, context, planes, together[frame])
        have = np.concatenate([np.moveaxis(drawn.rgb, 2, 0), drawn.alpha[None]])
        # A session's colors are limited to 1.
        worst = max(worst, float(np.abs(have - np.minimum(planes[[0, 1, 2, 4]], 1)).max()))
    return worst
