"""`python -m benchmarks accuracy`: run a capture up to its twin, then score its estimates and renderings."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.appearance.stage import select_training_frames
from aomgen.core.camera import Camera
from aomgen.core.project import Project
from aomgen.io.artifact import read_json
from aomgen.motion.estimates_file import ESTIMATES, describe_estimates
from aomgen.motion.stage import motion_evidence
from aomgen.pipeline.rendering import render_twin
from aomgen.pipeline.runner import TIMINGS, results_of
from aomgen.pipeline.stages import STAGES
from aomgen.results import Results
from aomgen.twin.twin import TwinModel, TwinState
from benchmarks.accuracy import score_estimates
from benchmarks.alignment_methods import bound_twin, paper_figures, with_paper_alignment, with_parts
from benchmarks.images import TrueMasks, pooled_ious, score_replay, score_scan
from benchmarks.motion_methods import paper_motion_figures
from benchmarks.truth import Truth, read_truth

LAST_STAGE = "twin"


def run_accuracy(
    capture_folder: Path,
    out: Path | None,
    run_project: Callable[..., None],
    *,
    saga: bool = False,
    paper: bool = False,
) -> dict[str, Any]:
    """Compute metrics of one capture, by dotted name, as the capture format defines them.

    Args:
        capture_folder: A capture with `truth/`.
        out: Run folder, continued when it exists; a temporary one when None.
        run_project: Runs a project up to a stage.
        saga: Also find the parts with affinity features, and give the IoUs of both methods.
        paper: Also align by the paper's rigid ICP and cut the robot by link boxes, and recover the
            motion by the paper's estimators.
    """
    truth = read_truth(capture_folder)
    with tempfile.TemporaryDirectory() as scratch:
        out = (out or Path(scratch) / "run").resolve()
        project = Project(capture=capture_folder.resolve(), out=out)
        run_project(project, until=LAST_STAGE)
        results = results_of(project, STAGES)
        estimates = read_json(out / ESTIMATES)
        figures = _score(results, estimates, truth, results.twin)
        if saga:
            figures.update(_beside_saga(results, estimates, truth, figures))
        if paper:
            figures.update(_beside_paper(results, truth))
        figures["seconds"] = read_json(out / TIMINGS)
    return dict(sorted(figures.items()))


def _score(results: Results, estimates: dict[str, Any], truth: Truth, twin: TwinModel) -> dict[str, Any]:
    name, robot = results.demo_camera, results.robot
    video, structure, capture = results.videos[name], results.structure, results.capture
    figures = score_estimates(estimates, truth, robot, video.times_s, name)
    cameras = {
        image: structure.cameras_recon[image].move(T)
        for image, T in estimates["scan"].items()
        if T is not None
    }

    def render(camera: Camera, state: TwinState) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        image, _, labels = render_twin(twin, robot, camera, state)
        return image, labels

    masks = truth.folder / "masks"
    scan_masks = TrueMasks(folder=masks / "scan", lens=structure.scan_lens)
    scanned, scan_ious = score_scan(capture, cameras, twin.scan_state, scan_masks, render)
    camera = structure.demo_cameras_recon[name].move(estimates["demo_cameras"][name])
    joints, gripper = capture.joint_log.at(video.times_s + estimates["clock_offset_s"])
    theta = estimates["theta"] or {"times_s": [0.0], "values": [0.0]}
    thetas = np.interp(video.times_s, theta["times_s"], theta["values"])
    rest = twin.scan_state
    states = [
        TwinState(joints=q, gripper=float(g), theta=float(value), T_world_object=rest.T_world_object)
        for q, g, value in zip(joints, gripper, thetas, strict=True)
    ]
    demo_masks = TrueMasks(folder=masks / name, lens=structure.demo_lenses.get(name))
    fitted = select_training_frames(len(results.scan_images), len(video.times_s)).tolist()
    replay, demo_ious = score_replay(video, camera, states, demo_masks, render, fitted)
    return figures | scanned | replay | pooled_ious(scan_ious, demo_ious)


def _beside_paper(results: Results, truth: Truth) -> dict[str, Any]:
    """Compute metrics of the paper's alignment, link boxes and motion, under separate names."""
    aligned, seconds = with_paper_alignment(results, results.out / "paper" / "alignment")
    labelled, _ = with_parts(aligned, results.out / "paper" / "parts", lambda scene, labels: None)
    moved = describe_estimates(labelled, results.motion, [])
    scored = paper_figures(_score(labelled, moved, truth, bound_twin(labelled)), seconds)
    lens = results.structure.demo_lenses.get(results.demo_camera)
    masks = TrueMasks(folder=truth.folder / "masks" / results.demo_camera, lens=lens)
    return scored | paper_motion_figures(results, truth, masks)


def _beside_saga(
    results: Results, estimates: dict[str, Any], truth: Truth, figures: dict[str, Any]
) -> dict[str, Any]:
    """Compute IoUs of a twin whose parts were found with affinity features, and those of the run."""
    project = results.project.model_copy(update={"parts_method": "saga"})
    asked = replace(results, project=project)
    labelled, seconds = with_parts(asked, results.out / "saga", partial(motion_evidence, asked))
    scored = _score(labelled, estimates, truth, bound_twin(labelled))
    ious = [name for name in scored if name.startswith("parts.")]
    return (
        {name.replace("parts.", "parts.saga."): scored[name] for name in ious}
        | {name.replace("parts.", "parts.closed_form."): figures[name] for name in ious}
        | {"parts.saga.seconds": round(seconds, 1)}
    )
