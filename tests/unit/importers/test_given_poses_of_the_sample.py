"""Poses of a run, brought back as transforms.json, give the same cameras without mapping."""

import time
from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.scan_poses import SCAN_POSES_FILE, read_scan_poses
from aomgen.core.progress import silent
from aomgen.core.recording import Intrinsics
from aomgen.core.structure import Structure
from aomgen.core.transforms import apply, rotvec_from_matrix, similarity_parts
from aomgen.importers.scan_import import import_scan
from aomgen.structure.mapping import Workspace
from aomgen.structure.reconstruct import Photographs, StructureParams, reconstruct_structure
from foreign_scans import KnownScan, write_transforms
from similarity_fit import best_similarity

INTRINSICS = (600.0, 600.0, 320.0, 240.0)
PARAMS = StructureParams(max_features=3000)


def reconstruct(images: dict[str, Path], poses: dict[str, np.ndarray]) -> Structure:
    fx, fy, cx, cy = INTRINSICS
    known = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy)
    return reconstruct_structure(
        Photographs(images=images, intrinsics=known, Ts_scan_cam=poses), PARAMS, silent
    )


@pytest.mark.slow
def test_given_poses_give_the_cameras_of_a_run(sample: Path, tmp_path: Path, monkeypatch) -> None:
    images = {path.name: path for path in sorted((sample / "scan").glob("*.jpg"))[:24]}
    run = reconstruct(images, {})
    assert run.figures["mapper"] == "incremental"
    images = {name: images[name] for name in run.cameras_recon}
    poses = tuple(camera.T_world_cam for camera in run.cameras_recon.values())
    scan = KnownScan(tuple(images.values()), poses, 640, 480, INTRINSICS)
    import_scan(write_transforms(tmp_path / "source", scan), tmp_path / "capture", 0, silent)
    folder = tmp_path / "capture" / "scan"

    spent = []
    place, extend = Workspace.place, Workspace.extend_model

    def start(*args: object) -> None:
        spent.append(-time.monotonic())
        place(*args)

    def end(*args: object) -> object:
        model = extend(*args)
        spent[-1] += time.monotonic()
        return model

    monkeypatch.setattr(Workspace, "place", start)
    monkeypatch.setattr(Workspace, "extend_model", end)
    given = read_scan_poses(folder / SCAN_POSES_FILE).Ts_scan_cam
    again = reconstruct({name: folder / name for name in images}, given)
    # The alignment sees cameras and points alone, and both are the same up to a similarity.
    have = np.array([camera.center for camera in again.cameras_recon.values()])
    want = np.array([camera.center for camera in run.cameras_recon.values()])
    S = best_similarity(have, want)
    # Distance of the cameras from the middle of what they see.
    distance = np.median(np.linalg.norm(want - np.median(run.points_recon, axis=0), axis=1))
    shift = np.linalg.norm(apply(S, have) - want, axis=1).max() / distance
    _, R, _ = similarity_parts(S)
    turns = [
        R @ camera.T_world_cam[:3, :3] @ run.cameras_recon[name].T_world_cam[:3, :3].T
        for name, camera in again.cameras_recon.items()
    ]
    turn_deg = np.degrees(np.linalg.norm(rotvec_from_matrix(np.array(turns)), axis=1).max())
    print(
        f"{len(images)} images: triangulation {sum(spent):.1f} s; cameras differ by {shift:.2e} of their distance "
        f"and {turn_deg:.4f} deg; error {again.reprojection_error_px:.3f} px, mapped {run.reprojection_error_px:.3f} px; "
        f"points {len(again.points_recon)}, mapped {len(run.points_recon)}"
    )
    assert again.figures["mapper"] == "given poses"
    assert len(again.cameras_recon) == len(images)
    # SIFT locates features to about half a pixel; what remains beyond that is the poses' fault.
    assert again.reprojection_error_px <= 0.5
    assert shift <= 1e-3
    assert turn_deg <= 0.05
