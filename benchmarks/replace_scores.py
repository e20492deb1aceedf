"""Agreement of a replaced object, its shadow, the emptied table and the robot with path-traced images."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, sobel

from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.episode import NEW_CAMERA
from aomgen.core.light import hemisphere_light
from aomgen.core.project import Project
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.errors import UnknownNameError
from aomgen.lighting.shadowed_twin import render_state
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import STAGES
from aomgen.splatting.metrics import psnr, ssim
from aomgen.twin.twin import TwinModel, TwinState
from benchmarks.images import masked_psnr
from benchmarks.replace_pictures import RoomPictures, SeenGeometry, see_geometry
from benchmarks.replace_rooms import CONDITIONS, ROOMS, RoomTruth

Pictures = Mapping[str, NDArray[np.uint8]]
# The object's box in an image is grown by this share of its sides.
GROWN: Final = 0.2
# Distance around the object within which shadows are compared on the table, and largest height of the table's points, [m].
AROUND_M, TABLE_M = 0.25, 0.003
# A point is hidden in a view that shows a surface this much nearer, [m].
HIDDEN_M: Final = 0.01
# Fewer pixels than this are not scored.
MIN_PIXELS: Final = 40
# Pixels with a lower coverage are holes.
COVERED: Final = 0.98


def score_room(pictures: RoomPictures) -> dict[str, float]:
    """Compute metrics of a room: medians over its images."""
    shots, traced = pictures.shots, pictures.trace()
    drawn = {name: pictures.draw(shot) for name, shot in shots.items()}
    seen = {name: see_geometry(pictures, shot, pictures.cameras) for name, shot in shots.items()}
    figures = {f"replace.{key}": value for key, value in _object_figures(drawn, traced, seen).items()}
    flat = {name: pictures.draw(shots[name], twin=_unlit(pictures.twin)) for name in ("closed", "open")}
    bare = {name: pictures.draw(shots[name], shadow=False) for name in ("closed", "open")}
    figures["replace.without_light"] = _object_figures(flat, traced, seen)["psnr"]
    figures["replace.without_shadow"] = _object_figures(bare, traced, seen)["psnr"]
    shadows = {
        "shadow.ratio": [("closed", "empty"), ("open", "empty")],
        "shadow.arm": [("empty_reached", "empty")],
    }
    for name, pairs in shadows.items():
        for key, value in _shadow_figures(pictures, pairs, drawn, traced, seen).items():
            figures[f"{name}_{key}"] = value
    robot = [
        masked_psnr(drawn[name][NEW_CAMERA], traced[name][NEW_CAMERA], seen[name].labels[NEW_CAMERA] == ROBOT)
        for name in ("empty", "empty_reached")
    ]
    figures["robot.psnr_new_view"] = float(np.median(robot))
    return figures | _hole_figures(pictures, drawn["empty"], traced["empty"])


def _object_figures(
    drawn: Mapping[str, Pictures], traced: Mapping[str, Pictures], seen: Mapping[str, SeenGeometry]
) -> dict[str, float]:
    """Compute PSNR and SSIM in the object's box, closed and open."""
    found = []
    for name in ("closed", "open"):
        for camera, labels in seen[name].labels.items():
            rows, columns = _grown_box(np.isin(labels, (STATIC, MOVING)))
            one, other = (images[name][camera][rows, columns] / 255 for images in (drawn, traced))
            found.append((psnr(one, other), ssim(one, other)))
    values = np.median(found, 0)
    return {"psnr": float(values[0]), "ssim": float(values[1])}


def _grown_box(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    found = []
    for axis in (1, 0):
        places = np.flatnonzero(mask.any(axis))
        more = round(GROWN / 2 * (places[-1] - places[0] + 1))
        found.append(slice(max(places[0] - more, 0), places[-1] + more + 1))
    return found[0], found[1]


def _unlit(twin: TwinModel) -> TwinModel:
    """Light the object at the brightness of a white sky in its own colors, whatever the light of the room."""
    if twin.relit is None:
        raise ValueError("the twin's object is not lit")
    last = twin.relit.lights[-1]
    level = float(last.irradiance(np.array([[0, 0, 1.0]])).mean())
    even = hemisphere_light(np.full(3, level), np.full(3, level))
    return replace(twin, relit=replace(twin.relit, lights=(*twin.relit.lights[:-1], even)))


def _shadow_figures(
    pictures: RoomPictures,
    pairs: list[tuple[str, str]],
    drawn: Mapping[str, Pictures],
    traced: Mapping[str, Pictures],
    seen: Mapping[str, SeenGeometry],
) -> dict[str, float]:
    """Compare ratios of gray levels with and without the object, on the table around it."""
    errors, correlations = [], []
    for with_it, without in pairs:
        for name, camera in pictures.cameras.items():
            table = [_on_table(pictures, seen[shot], name, camera) for shot in (with_it, without)]
            mask = binary_erosion(table[0] & table[1])
            if not mask.sum() >= MIN_PIXELS:
                continue
            one, other = (
                (_grey(images[with_it][name]) / np.maximum(_grey(images[without][name]), 4 / 255))[mask]
                for images in (drawn, traced)
            )
            one, other = np.clip(one, 0, 2), np.clip(other, 0, 2)
            errors.append(np.abs(one - other).mean())
            if one.std() > 0 and other.std() > 0:
                correlations.append(np.corrcoef(one, other)[0, 1])
    return {"mae": float(np.median(errors)), "correlation": float(np.median(correlations or [0.0]))}


def _on_table(pictures: RoomPictures, seen: SeenGeometry, name: str, camera: Camera) -> NDArray[np.bool_]:
    """Find pixels of the table around the object, (H, W)."""
    points = _points(camera, seen.depths[name])
    low, high = pictures.fitted.asset.static.bounds
    local = apply(invert(pictures.fitted.T_world_asset), points)[..., :2]
    away = np.linalg.norm(np.maximum(np.maximum(low[:2] - local, local - high[:2]), 0), axis=-1)
    level = np.abs(points[..., 2] - pictures.truth.layout.room.table_z) < TABLE_M
    return (seen.labels[name] == BACKGROUND) & level & (away < AROUND_M)


def _points(camera: Camera, depth: Array) -> Array:
    return camera.center + camera.directions() * depth[..., None]


def _grey(image: NDArray[np.uint8]) -> Array:
    return image.mean(-1) / 255


def _hole_figures(pictures: RoomPictures, drawn: Pictures, traced: Pictures) -> dict[str, float]:
    """Score the table at the recorded object's location: where some view shows it, and where none does."""
    empty, cameras = pictures.shots["empty"], pictures.cameras
    views = {name: pictures.truth.camera(name) for name in pictures.truth.answers["scan"]}
    covered = see_geometry(pictures, empty, cameras, recorded=True)
    bare = see_geometry(pictures, empty, cameras)
    scanned = see_geometry(pictures, empty, views, recorded=True)
    state = TwinState(
        joints=empty.joints, gripper=empty.gripper, theta=0.0, T_world_object=pictures.fitted.T_world_asset
    )
    known, levels, gradients, open_pixels, pixels = [], [], [], 0, 0
    for name, camera in cameras.items():
        hole = np.isin(covered.labels[name], (STATIC, MOVING)) & (bare.labels[name] == BACKGROUND)
        points = _points(camera, bare.depths[name])
        seen = np.zeros_like(hole)
        for view, scan_camera in views.items():
            seen |= _visible(points, scan_camera, scanned.labels[view], scanned.depths[view])
        if (hole & seen).sum() >= MIN_PIXELS:
            known.append(masked_psnr(drawn[name], traced[name], hole & seen))
        never = hole & ~seen
        if never.sum() >= MIN_PIXELS:
            levels.append(255 * abs(_grey(drawn[name])[never].mean() - _grey(traced[name])[never].mean()))
        inner = binary_erosion(never, iterations=2)
        if inner.sum() >= MIN_PIXELS:
            gradients.append(_gradient(drawn[name])[inner].mean() / _gradient(traced[name])[inner].mean())
        alpha = render_state(pictures.background, pictures.results.robot, state, camera).alpha
        open_pixels, pixels = open_pixels + int((alpha[hole] < COVERED).sum()), pixels + int(hole.sum())
    found = {"psnr_seen": known, "level_error": levels, "gradient_ratio": gradients}
    figures = {f"hole.{key}": float(np.median(values)) for key, values in found.items() if values}
    return figures | {"hole.open_share": open_pixels / max(pixels, 1)}


def _visible(points: Array, camera: Camera, labels: NDArray[np.uint8], depths: Array) -> NDArray[np.bool_]:
    """Find the points (H, W, 3) that a view shows, not hidden by the recorded object or the robot."""
    pixels, depth = camera.project(points)
    column, row = (np.floor(np.nan_to_num(pixels[..., k], nan=-1)).astype(int) for k in (0, 1))
    inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    return inside & (labels[row, column] == BACKGROUND) & (depths[row, column] > depth - HIDDEN_M)


def _gradient(image: NDArray[np.uint8]) -> Array:
    grey = _grey(image)
    return np.hypot(sobel(grey, 0), sobel(grey, 1))


def run_rooms(
    folder: Path, names: Sequence[str], run_project: Callable[..., None], notify: Callable[[str], None]
) -> dict[str, Any]:
    """Record rooms, replace their objects and score: medians, and a row each; existing results are kept."""
    rows = []
    for name in names:
        if name not in ROOMS:
            raise UnknownNameError("--room", name, ROOMS)
    for name in names:
        truth = RoomTruth(room=ROOMS[name], folder=folder / name)
        truth.record(lambda share, text, name=name: notify(f"{name} {share:4.0%} {text}"))
        project = Project(
            capture=truth.capture,
            out=folder / name / "run",
            assets=(truth.room.asset,),
            image_size=CONDITIONS.size,
        )
        run_project(project, until="replacement")
        notify(f"{name} scored")
        rows.append({"room": name, **score_room(RoomPictures(truth, results_of(project, STAGES)))})
    keys = dict.fromkeys(key for row in rows for key in row if key != "room")
    return {key: float(np.median([row[key] for row in rows if key in row])) for key in keys} | {"rooms": rows}
