"""Speed and accuracy of the splatting engine on a table-top scene, on this machine."""

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.splatting import native
from benchmarks.agreement import Oracle
from benchmarks.moving_scenes import MovingScene, arm_scene, objects_scene
from benchmarks.scenes import table_camera, table_top
from benchmarks.sessions import measure_session
from benchmarks.timing import (
    forward_pass,
    gradient_pass,
    interleaved_ms,
    torch_threads,
    training_pass,
)

# Number of vector operations for blending one splat into sixteen pixels, counted in the inner loop.
OPERATIONS_PER_PAIR = 28
SESSION_SHARE = 0.25
BOUND = (
    f"share_of_bound = bound / ns_per_pair; bound: {OPERATIONS_PER_PAIR} vector operations for every pair of "
    "a splat and a pixel that is evaluated, at the rate at which one thread was measured to do fused "
    "multiply-adds in the same instruction set. Finding the pairs (which blocks of a tile a splat "
    "touches) counts as blending time, not as work. A machine that does other operations beside "
    "multiply-adds could stay below the bound."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedCase:
    """One scene and machine setting.

    Attributes:
        gaussians: Number of Gaussians in the scene; slightly more than half of them are in view.
        width, height: Image size, [px].
        sh_degree: 0..3.
        threads: Worker threads.
        isa: One of `native.instruction_sets()`.
    """

    gaussians: int = 100_000
    width: int = 640
    height: int = 480
    sh_degree: int = 3
    threads: int
    isa: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """Duration of the measurements.

    Attributes:
        repeats: Timed runs of every function, alternately; the median counts.
        tiles: Number of tiles of the image that are compared with float64.
        arm: Static Gaussians, moving Gaussians and image side [px] of the scene with an arm.
    """

    repeats: int = 15
    tiles: int = 80
    arm: tuple[int, int, int] = (80_000, 60_000, 256)


def default_cases() -> tuple[SpeedCase, ...]:
    """Return three scene sizes at two image sizes; then the other instruction sets, and one thread."""
    best, *others = native.instruction_sets()
    threads = native.library().aomgen_processor_count()
    sizes = [(640, 480), (320, 240)]
    counts = [20_000, 100_000, 300_000]
    cases = [
        SpeedCase(gaussians=count, width=width, height=height, threads=threads, isa=best)
        for width, height in sizes
        for count in counts
    ]
    cases += [SpeedCase(threads=threads, isa=isa) for isa in others]
    return (*cases, SpeedCase(threads=1, isa=best))


def measure(cases: tuple[SpeedCase, ...], effort: Effort) -> dict[str, Any]:
    """Measure median wall times, errors and work of every case; the last one also on every instruction set.

    Returns:
        `cases`: for each a dict with the case's fields, forward_ms and forward_backward_ms
        (gradients by all parameters from a given gradient by the image; into the same arrays every
        time), torch_forward_backward_ms (the same through torch, into new tensors), session_ms
        (an image of a session: moving objects are visible in about `SESSION_SHARE` of the tiles, and
        session_tiles_share is the actual share), the work as `_work` states, and the fields of `Agreement`.
        `stages`: for each case the medians of the engine's stages, [ms].
        `sessions`: for each case, and for a scene with an arm, the fields of `SessionSpeed`.
        `instruction_sets`: see `compare_instruction_sets`.
        `bound`: the definition of share_of_bound.
    """
    results, stages, sessions = [], [], []
    for case in cases:
        gaussians = table_top(case.gaussians, case.sh_degree)
        camera = table_camera(case.width, case.height)
        context = native.Context(case.threads, case.isa)
        times, case_stages = _times(gaussians, camera, context, case.threads, effort.repeats)
        work = _work(context, case_stages["blend"] * case.threads)
        scene = objects_scene(case.gaussians, camera, SESSION_SHARE)
        session = {"scene": "objects"} | _session(scene, case.threads, case.isa, effort.repeats)
        of_session = {"session_ms": session["picture_ms"], "session_tiles_share": session["tiles_share"]}
        errors = asdict(Oracle(gaussians, camera, effort.tiles).compare(context))
        results.append(asdict(case) | times | of_session | work | errors)
        stages.append(case_stages)
        sessions.append(session)
    static, moving, side = effort.arm
    arm = arm_scene(static, moving, table_camera(side, side))
    sessions.append({"scene": "arm"} | _session(arm, cases[0].threads, cases[0].isa, effort.repeats))
    return {
        "cases": results,
        "stages": stages,
        "sessions": sessions,
        "instruction_sets": compare_instruction_sets(cases[-1], effort.repeats),
        "bound": BOUND,
    }


def compare_instruction_sets(case: SpeedCase, rounds: int) -> dict[str, Any]:
    """Time every instruction set on one thread alternately, round by round, in processor time.

    Returns:
        By instruction set: medians forward_ms and forward_backward_ms, and the medians over the
        rounds of their ratios to the best instruction set.
    """
    gaussians = table_top(case.gaussians, case.sh_degree)
    camera = table_camera(case.width, case.height)
    names = native.instruction_sets()
    functions: dict[str, Callable[[], None]] = {}
    for name in names:
        context = native.Context(1, name)
        functions[f"{name} forward"] = forward_pass(gaussians, camera, context)
        functions[f"{name} forward_backward"] = gradient_pass(gaussians, camera, context)
    with torch_threads(1):
        times = interleaved_ms(functions, rounds, time.process_time)
    figures: dict[str, Any] = {"gaussians": case.gaussians, "threads": 1, "rounds": rounds}
    for name in names:
        figures[name] = {}
        for pass_name in ("forward", "forward_backward"):
            own, best = times[f"{name} {pass_name}"], times[f"{names[0]} {pass_name}"]
            figures[name][f"{pass_name}_ms"] = float(np.median(own))
            figures[name][f"{pass_name}_ratio"] = float(np.median(own / best))
    return figures


def _times(
    gaussians: Gaussians, camera: Camera, context: native.Context, threads: int, repeats: int
) -> tuple[dict[str, float], dict[str, float]]:
    """Compute medians of whole passes, and of the engine's stages: the backward ones of the training pass."""
    notes: dict[str, list[dict[str, float]]] = defaultdict(list)

    def noted(name: str, function: Callable[[], None]) -> Callable[[], None]:
        def run() -> None:
            function()
            notes[name].append(context.stage_times_ms())

        return run

    passes = {
        "forward_ms": forward_pass(gaussians, camera, context),
        "forward_backward_ms": gradient_pass(gaussians, camera, context),
        "torch_forward_backward_ms": training_pass(gaussians, camera, context),
    }
    with torch_threads(threads):
        times = interleaved_ms({name: noted(name, function) for name, function in passes.items()}, repeats)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    stages = {}
    for stage in notes["forward_ms"][0]:
        source = notes["forward_backward_ms" if stage.endswith("backward") else "forward_ms"]
        stages[stage] = float(np.median([note[stage] for note in source[1:]]))
    return medians, stages


def _session(scene: MovingScene, threads: int, isa: str, repeats: int) -> dict[str, Any]:
    fields = {
        "static": len(scene.static),
        "moving": len(scene.moving),
        "width": scene.camera.width,
        "height": scene.camera.height,
        "threads": threads,
        "isa": isa,
    }
    return fields | asdict(measure_session(scene, threads, isa, repeats))


def _work(context: native.Context, blend_thread_ms: float) -> dict[str, float]:
    """Compute the work of the context's last pass, in pairs of a splat and a pixel.

    Args:
        context: Context after a pass.
        blend_thread_ms: Blending time of that pass times threads, [ms].

    Returns:
        evaluated_pairs (computed), blended_pairs (drawn), ns_per_pair (blending time of one
        thread per evaluated pair) and share_of_bound, see `BOUND`.
    """
    evaluated, blended = context.count_pairs()
    ns_per_pair = 1e6 * blend_thread_ms / evaluated
    bound_ns = 1e9 * OPERATIONS_PER_PAIR / context.vector_throughput()
    return {
        "evaluated_pairs": evaluated,
        "blended_pairs": blended,
        "ns_per_pair": ns_per_pair,
        "share_of_bound": bound_ns / ns_per_pair,
    }
