"""`aomgen bench accuracy`: run a capture up to its twin, then score what it wrote and drew."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.capture_check import read_demo_videos
from aomgen.capture.read import read_capture
from aomgen.core.camera import Camera
from aomgen.core.recording import Capture
from aomgen.io.jsonfile import read_json
from aomgen.io.video import Video
from aomgen.pipeline.posed_videos import select_training_frames
from aomgen.pipeline.project import Project
from aomgen.pipeline.rendering import draw_twin, open_twin
from aomgen.pipeline.runner import TIMINGS
from aomgen.pipeline.working import with_joint_zeros, working_capture
from aomgen.robots.loading import choose_robot
from aomgen.structure.stage import load_structure
from aomgen.twin.twin import Twin, TwinState
from benchmarks.accuracy import score_estimates
from benchmarks.alignment_methods import paper_figures, paper_twin
from benchmarks.images import TrueMasks, pooled_ious, score_replay, score_scan
from benchmarks.motion_methods import paper_motion_figures
from benchmarks.saga import saga_twin
from benchmarks.truth import Truth, read_truth

LAST_STAGE = "twin"
STRUCTURE_FOLDER = "01_structure"
ALIGNMENT_FOLDER = "03_alignment"


def run_accuracy(
    capture_folder: Path,
    out: Path | None,
    run_project: Callable[..., None],
    *,
    saga: bool = False,
    paper: bool = False,
) -> dict[str, Any]:
    """Figures of one capture, by dotted name, as the capture format defines them.

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
        run_project(Project(capture=capture_folder.resolve(), out=out), until=LAST_STAGE)
        recorded = working_capture(read_capture(capture_folder), out / STRUCTURE_FOLDER)
        capture = with_joint_zeros(recorded, out / ALIGNMENT_FOLDER)
        estimates = read_json(out / "estimates.json")
        name = capture.cameras[0].name
        video = read_demo_videos(capture)[name]
        robot = choose_robot(capture.robot)
        figures = score_estimates(estimates, truth, robot, video.times_s, name)
        twin, _ = open_twin(out)
        figures.update(_score_pictures(capture, estimates, out, video, truth, twin))
        if saga:
            figures.update(_beside_saga(capture, estimates, out, video, truth, figures))
        if paper:
            other, moved, seconds = paper_twin(out, capture, estimates)
            scored = score_estimates(moved, truth, robot, video.times_s, name)
            scored |= _score_pictures(capture, moved, out, video, truth, other)
            figures.update(paper_figures(scored, seconds))
            structure = load_structure(out / STRUCTURE_FOLDER)
            masks = TrueMasks(folder=truth.folder / "masks" / name, lens=structure.demo_lenses.get(name))
            figures.update(paper_motion_figures(out, capture_folder.resolve(), truth, masks))
        figures["seconds"] = read_json(out / TIMINGS)
    return dict(sorted(figures.items()))


def _score_pictures(
    capture: Capture, estimates: dict[str, Any], out: Path, video: Video, truth: Truth, twin: Twin
) -> dict[str, Any]:
    name, (_, robot) = capture.cameras[0].name, open_twin(out)
    structure = load_structure(out / STRUCTURE_FOLDER)
    cameras = {
        image: structure.cameras_recon[image].moved(T)
        for image, T in estimates["scan"].items()
        if T is not None
    }

    def render(camera: Camera, state: TwinState) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        return draw_twin(twin, robot, camera, state)

    masks = truth.folder / "masks"
    scan_masks = TrueMasks(folder=masks / "scan", lens=structure.scan_lens)
    figures, scan_ious = score_scan(capture, cameras, twin.scan_state, scan_masks, render)
    camera = structure.demo_cameras_recon[name].moved(estimates["demo_cameras"][name])
    joints, gripper = capture.joint_log.at(video.times_s + estimates["clock_offset_s"])
    theta = estimates["theta"] or {"times_s": [0.0], "values": [0.0]}
    thetas = np.interp(video.times_s, theta["times_s"], theta["values"])
    rest = twin.scan_state
    states = [
        TwinState(joints=q, gripper=float(g), theta=float(value), T_world_object=rest.T_world_object)
        for q, g, value in zip(joints, gripper, thetas, strict=True)
    ]
    demo_masks = TrueMasks(folder=masks / name, lens=structure.demo_lenses.get(name))
    fitted = select_training_frames(capture, len(video.times_s)).tolist()
    replay, demo_ious = score_replay(video, camera, states, demo_masks, render, fitted)
    return figures | replay | pooled_ious(scan_ious, demo_ious)


def _beside_saga(
    capture: Capture,
    estimates: dict[str, Any],
    out: Path,
    video: Video,
    truth: Truth,
    figures: dict[str, Any],
) -> dict[str, Any]:
    """IoUs of a twin whose parts were found with affinity features, beside those of the run."""
    twin, seconds = saga_twin(out, capture)
    scored = _score_pictures(capture, estimates, out, video, truth, twin)
    ious = [name for name in scored if name.startswith("parts.")]
    return (
        {name.replace("parts.", "parts.saga."): scored[name] for name in ious}
        | {name.replace("parts.", "parts.closed_form."): figures[name] for name in ious}
        | {f"parts.saga.seconds_{step}": value for step, value in seconds.items()}
    )
