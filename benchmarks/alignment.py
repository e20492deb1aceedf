"""`python -m benchmarks alignment`: share and accuracy of alignments from good and bad starts.

For solvable starts the alignment must be within `TOLERANCE_M` at the end effector, unsolvable ones must be
refused; no wrong alignment may be returned.
"""

import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.alignment.align import align
from aomgen.alignment.pose_search import Scan
from aomgen.alignment.stage import boxes_of, camera_errors_of, views_of
from aomgen.core.alignment import Alignment
from aomgen.core.progress import silent
from aomgen.core.project import Project
from aomgen.core.transforms import apply, matrix_from_rotvec
from aomgen.errors import AlignmentError
from aomgen.pipeline.project_file import read_project
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import STAGES
from aomgen.results import Results
from benchmarks.accuracy import robust_similarity
from benchmarks.alignment_cases import UNSOLVABLE, Case, Scene, make_case, resimilated, without_robot
from benchmarks.truth import read_truth

TOLERANCE_M = 0.006
PROJECT_FILE = "project.toml"
# Six starts of ten have a solution.
SOLVABLE_SHARE = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Outcome of one start.

    Attributes:
        scene, kind, done: See `Case`.
        refusal: The reason, empty when an alignment was returned.
        error_m: Error of the end effector, None when there is no solution or the alignment was refused.
        sd_m: The alignment's own estimate of this error.
        seconds: Processor time.
    """

    scene: str
    kind: str
    done: tuple[str, ...]
    refusal: str
    error_m: float | None
    sd_m: float | None
    seconds: float

    @property
    def right(self) -> bool:
        """Return whether the outcome is right: a right solution, or a refusal where there is none."""
        if self.kind == "solvable":
            return self.error_m is not None and self.error_m <= TOLERANCE_M
        return bool(self.refusal)

    @property
    def wrong(self) -> bool:
        """Return whether a wrong solution was returned."""
        return not self.refusal and not self.right


def run_alignment_bench(
    paths: Iterable[Path],
    starts: int,
    seed: int,
    run_project: Callable[..., None],
    notify: Callable[[dict[str, Any]], None],
) -> dict[str, Any]:
    """Compute metrics by name, with one row for every start.

    Args:
        paths: Captures with `truth/` (their structure is made first), or finished runs of such.
        starts: Number of starts, over all paths.
        seed: Seed of all random choices.
        run_project: Runs a project up to a stage.
        notify: Receives the row of every start as soon as it is known.
    """
    scenes = [_scene_of(path, run_project) for path in paths]
    bare = [without_robot(scene) for scene in scenes]
    rng = np.random.default_rng(seed)
    outcomes = []
    for number in range(starts):
        index = number % len(scenes)
        # Kinds alternate, so that few starts contain all of them.
        turn = number // len(scenes)
        solvable = int((turn + 1) * SOLVABLE_SHARE) > int(turn * SOLVABLE_SHARE)
        kind = "solvable" if solvable else UNSOLVABLE[(turn - int(turn * SOLVABLE_SHARE)) % len(UNSOLVABLE)]
        outcomes.append(_try(make_case(scenes[index], bare[index], kind, rng)))
        notify(_row(outcomes[-1]))
    figures = summary(outcomes)
    figures["frame_invariance_mm"] = max(_frame_spread_mm(scene, rng) for scene in scenes)
    figures["rows"] = [_row(outcome) for outcome in outcomes]
    return figures


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """Compute shares and worst cases."""
    solvable = [o for o in outcomes if o.kind == "solvable"]
    unsolvable = [o for o in outcomes if o.kind != "solvable"]
    solved = [o for o in solvable if o.right]
    errors = np.array([o.error_m for o in solvable if o.error_m is not None])
    ratios = np.array([o.error_m / o.sd_m for o in solved if o.error_m is not None and o.sd_m])
    return {
        "starts": len(outcomes),
        "solvable_answered": _share([o.right for o in solvable]),
        "answered_wrongly": sum(o.wrong for o in outcomes),
        "unsolvable_refused": _share([o.right for o in unsolvable]),
        "end_effector_mm": 1e3 * float(np.median(errors)) if len(errors) else None,
        "end_effector_mm_worst": 1e3 * float(errors.max()) if len(errors) else None,
        "within_two_sd": _share(list(ratios <= 2)),
        "median_error_in_sd": float(np.median(ratios)) if len(ratios) else None,
        "cpu_s": float(np.median([o.seconds for o in outcomes])),
    }


def _share(flags: list[bool]) -> float | None:
    return float(np.mean(flags)) if len(flags) else None


def _try(case: Case) -> Outcome:
    began = time.process_time()
    try:
        found, refusal = _align(case.scene), ""
    except AlignmentError as error:
        found, refusal = None, error.problem
    seconds = time.process_time() - began
    known = found is not None and case.kind == "solvable"
    return Outcome(
        scene=case.scene.name,
        kind=case.kind,
        done=case.done,
        refusal=refusal,
        error_m=_error_m(found.S_world_recon, case.scene) if known and found else None,
        sd_m=found.ee_sd_m if found else None,
        seconds=seconds,
    )


def _align(scene: Scene) -> Alignment:
    scan = Scan(
        views=scene.views,
        boxes=scene.robot_boxes,
        points_recon=scene.points_recon,
        errors=scene.errors,
    )
    return align(scan, scene.configuration, silent, np.random.default_rng(0))


def _error_m(S_world_recon: np.ndarray, scene: Scene) -> float:
    ee = scene.configuration.ee_world
    return float(np.linalg.norm(apply(S_world_recon @ np.linalg.inv(scene.S_world_recon), ee) - ee))


def _frame_spread_mm(scene: Scene, rng: np.random.Generator) -> float:
    """Measure the deviation of the results for one scene in differently scaled and rotated frames."""
    points = scene.configuration.points_world(100)
    placed = []
    for scale in (0.05, 20.0):
        turned = resimilated(scene, scale, matrix_from_rotvec(rng.normal(0, 1.5, 3)), rng)
        E = _align(turned).S_world_recon @ np.linalg.inv(turned.S_world_recon)
        placed.append(apply(E, points))
    return 1e3 * float(np.linalg.norm(placed[0] - placed[1], axis=1).max())


def _row(outcome: Outcome) -> dict[str, Any]:
    return {
        "scene": outcome.scene,
        "kind": outcome.kind,
        "right": outcome.right,
        "error_mm": None if outcome.error_m is None else 1e3 * outcome.error_m,
        "sd_mm": None if outcome.sd_m is None else 1e3 * outcome.sd_m,
        "cpu_s": outcome.seconds,
        "done": ", ".join(outcome.done),
        "refusal": outcome.refusal,
    }


def _scene_of(path: Path, run_project: Callable[..., None]) -> Scene:
    if (path / PROJECT_FILE).is_file():
        return load_scene(results_of(read_project(path / PROJECT_FILE), STAGES))
    with tempfile.TemporaryDirectory() as scratch:
        project = Project(capture=path.resolve(), out=Path(scratch) / "run")
        run_project(project, until="structure")
        return load_scene(results_of(project, STAGES))


def load_scene(results: Results) -> Scene:
    """Load a capture with truth, ready to be disturbed, from a run that is finished up to its structure."""
    capture, structure = results.pinhole_capture, results.structure
    truth = read_truth(capture.folder)
    names = sorted(name for name in structure.cameras_recon if name in truth.scan)
    recon = np.array([structure.cameras_recon[name].center for name in names])
    S_world_recon, _ = robust_similarity(recon, np.array([truth.scan[name][:3, 3] for name in names]))
    first = {name: video.frames_srgb[0] for name, video in results.videos.items()}
    return Scene(
        name=capture.name,
        views=views_of(structure, results.scan_images, first),
        robot_boxes=boxes_of(structure, capture.prompts, ("robot",)),
        other_boxes=boxes_of(structure, capture.prompts, ("static", "moving")),
        points_recon=structure.points_recon,
        configuration=results.configuration_in(capture),
        S_world_recon=S_world_recon,
        errors=camera_errors_of(structure),
    )
