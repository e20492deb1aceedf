"""A run or a single capture as displayed by the twin page: motions, scenes and overlays, each opened on first use."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.capture.read import read_capture
from aomgen.core.camera import Camera, CameraPath
from aomgen.core.project import Project
from aomgen.core.recording import CAPTURE_FILE
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.episodes.ledger import unit_of
from aomgen.episodes.variations import scale_fit
from aomgen.errors import InputError, MissingFileError, OutdatedRunError, UnknownNameError
from aomgen.io.artifact import load_artifact
from aomgen.io.episode_folder import (
    CommittedEpisode,
    episode_folder,
    list_committed,
    read_episode,
    read_variation,
)
from aomgen.parts.stage import COVERAGE
from aomgen.parts.survey import Survey
from aomgen.pipeline.manifest import MANIFEST, read_manifest
from aomgen.pipeline.rendering import open_twin
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import STAGES, find_project
from aomgen.prompting.scan_choice import ScanImages
from aomgen.results import Results
from aomgen.robots.robot import RobotModel
from aomgen.simulation.episode_scene import episode_scene
from aomgen.twin.twin import TwinModel, interpolate_state
from aomgen.viewing import overlays
from aomgen.viewing.draw_list import DrawList
from aomgen.viewing.motions import ShownMotion, read_recording, show_episode
from aomgen.viewing.rejected_draw import NOTE, PAIR, replan_draw
from aomgen.viewing.scenes import (
    PosableScene,
    ScannedScene,
    ViewedScene,
    open_episode_scene,
    open_recorded_scene,
)

RECORDING: Final = "recording"
# Number of episodes that are kept open; each contains a copy of the twin of some ten MB.
KEPT_EPISODES: Final = 2
# Depth of a displayed camera as a share of the median distance between scan cameras and object.
CAMERA_SHARE: Final = 0.05
# Sentences about missing results, by the first stage that has not finished.
LACKS: Final = {
    "structure": "The scan is not reconstructed yet; the page shows its images and the recording.",
    "gaussians": "The scan has cameras but no Gaussians yet; the page shows its images and the recording.",
    "alignment": "The scene can be orbited; it is not aligned with the robot yet and therefore has no scale.",
    "parts": "The scene can be orbited; its parts are not separated yet.",
    "motion": "The scene can be orbited; the object's joint is not estimated yet.",
    "twin": "The scene can be orbited; the twin is not built yet, so nothing can move.",
    "replacement": "There are no episodes yet: no asset has replaced the object.",
    "episodes": "The episodes are not complete yet; those that are committed are shown.",
}


class OpenedRun:
    """Results of a run at the time when it was opened; only the list of its committed episodes is updated."""

    def __init__(self, results: Results, token: str) -> None:
        self.results, self.token = results, token
        self.done = {stage.name for stage in STAGES if _is_current(results, stage.name)}
        self.episode = lru_cache(KEPT_EPISODES)(self._read_episode)
        self.motion = lru_cache(KEPT_EPISODES)(self._open_motion)
        self.scene = lru_cache(KEPT_EPISODES)(self._open_scene)
        self.overlay = lru_cache(None)(self._open_overlay)
        self.pivot = lru_cache(None)(self._find_pivot)

    def list_notes(self) -> list[str]:
        """List sentences about missing results of the run."""
        notes = []
        for stage in STAGES:
            manifest = read_manifest(self.results.folders[stage.name])
            if manifest and manifest.version != stage.version:
                notes.append(
                    f"{OutdatedRunError(self.results.out, stage.name, manifest.version, stage.version)}."
                )
        missing = next((name for name in LACKS if name not in self.done), None)
        return [*notes, *([LACKS[missing]] if missing else [])]

    def list_motions(self) -> list[dict[str, str]]:
        """List name and title of every motion, the recording first."""
        numbers = [int(folder.name) for folder in list_committed(self.results.folders["episodes"])]
        shown = numbers if "replacement" in self.done else []
        return [
            {"name": RECORDING, "title": "recording"},
            *({"name": str(number), "title": f"episode {number}"} for number in shown),
        ]

    @cached_property
    def posable(self) -> tuple[TwinModel, RobotModel]:
        """Return the twin of the recording and its robot."""
        return open_twin(self.results.out)

    @cached_property
    def scan(self) -> ScanImages:
        """Return the images of the scan.

        Raises:
            InputError: The capture is missing or damaged.
        """
        return ScanImages(self.results.recorded.scan_images, self.results.recorded.scan_video)

    @property
    def has_parts(self) -> bool:
        """True if the parts of the scene are known, so that they can be hidden."""
        return "parts" in self.done

    @cached_property
    def survey(self) -> Survey | None:
        """Coverage of the scan; None before it is measured."""
        if "parts" not in self.done:
            return None
        return load_artifact(self.results.folders["parts"], COVERAGE, Survey)

    @cached_property
    def scan_cameras(self) -> Mapping[str, Camera]:
        """Scan cameras by image name, in the frame of the scene."""
        aligned = "alignment" in self.done
        return self.results.scan_cameras if aligned else self.results.structure.cameras_recon

    def _read_episode(self, name: str) -> CommittedEpisode:
        if not name.isdigit():
            raise UnknownNameError("motion", name, [RECORDING, "the number of an episode"])
        home = self.results.folders["episodes"]
        folder = episode_folder(home, int(name))
        if folder.is_dir():
            return read_episode(folder)
        return replan_draw(self.results, DrawList(self.results.out, home).find(int(name)))

    def _open_motion(self, name: str) -> tuple[ShownMotion, str]:
        """Open a motion, with a sentence about its missing data."""
        if name != RECORDING:
            committed = self.episode(name)
            return show_episode(committed), str(committed.episode.verdict.get(NOTE, ""))
        try:
            motion, problem = read_recording(self.results, self.done), ""
        except InputError as error:
            # The twin can be displayed without its capture.
            if "twin" not in self.done:
                raise
            fixed = {name: item.camera for name, item in self.results.alignment.cameras.items()}
            cameras = {name: CameraPath(camera=item, Ts_world_cam=item.T_world_cam[None]) for name, item in fixed.items()}  # fmt: skip
            motion = ShownMotion(
                title=RECORDING, times_s=np.zeros(1), trajectory=None, cameras=cameras, videos={}
            )
            problem = f"The recording cannot be shown: {error}."
        if not motion.cameras and "gaussians" in self.done:
            name, camera = next(iter(self.scan_cameras.items()))
            path = CameraPath(camera=camera, Ts_world_cam=camera.T_world_cam[None])
            motion = replace(motion, cameras={name: path})
        return motion, problem

    def _open_scene(self, name: str) -> ViewedScene | None:
        """Open the scene of a motion; None before Gaussians exist."""
        if name == RECORDING:
            if "twin" in self.done:
                return open_recorded_scene(*self.posable)
            if "gaussians" not in self.done:
                return None
            if "parts" in self.done:
                return ScannedScene(self.results.scene, self.results.parts.labels)
            aligned = "alignment" in self.done
            return ScannedScene(self.results.gaussians if aligned else self.results.gaussians_recon, None)
        episode, motion = self.episode(name).episode, self.motion(name)[0]
        first = interpolate_state(episode, float(episode.times_s[0]))
        eyes = np.stack([path.camera.center for path in motion.cameras.values()])
        asset = unit_of(episode.index).asset
        variation = read_variation(self.episode(name))
        return open_episode_scene(self.results, self.posable[1], asset, variation, first, eyes)

    def _find_pivot(self, name: str) -> Array:
        """Return the center of rotation (3,) of the view: the object, or else the center of the scan."""
        scene = self.scene(name)
        if isinstance(scene, PosableScene):
            return scene.find_center()
        if self.survey is not None:
            sides = [k for k, side in enumerate(self.survey.names) if side.endswith("of the object")]
            return self.survey.points_world[np.isin(self.survey.sides, sides)].mean(0)
        points = self.results.structure.points_recon
        if "alignment" in self.done:
            points = apply(self.results.alignment.S_world_recon, points)
        return np.median(points, 0)

    def find_up(self) -> Array:
        """Return the unit vector (3,) upward: the world's z axis, or the mean of the cameras before the alignment."""
        if "alignment" in self.done:
            return np.array([0.0, 0.0, 1.0])
        up = -np.mean([camera.T_world_cam[:3, 1] for camera in self.scan_cameras.values()], 0)
        return up / np.linalg.norm(up)

    def list_overlays(self, name: str) -> list[str]:
        """List the names of the overlays of a motion."""
        if name != RECORDING:
            return ["colliders", "cameras", "contacts", "axis"]
        needs = {
            "colliders": "twin",
            "cameras": "structure",
            "coverage": "parts",
            "contacts": "twin",
            "axis": "motion",
        }
        return [overlay for overlay, stage in needs.items() if stage in self.done]

    def _open_overlay(self, name: str, kind: str) -> overlays.Overlay:
        if kind not in self.list_overlays(name):
            raise UnknownNameError("overlay", kind, self.list_overlays(name))
        if kind == "cameras":
            fixed = {key: path.camera for key, path in self.motion(name)[0].cameras.items()}
            arms = [np.linalg.norm(item.center - self.pivot(name)) for item in self.scan_cameras.values()]
            return overlays.outline_cameras(self.scan_cameras, fixed, CAMERA_SHARE * float(np.median(arms)))
        if name != RECORDING:
            episode = self.episode(name).episode
            makers = {"contacts": overlays.outline_contacts, "axis": overlays.outline_episode_axis}
            return makers[kind](episode) if kind in makers else self._open_episode_colliders(name)
        if kind == "colliders":
            robot = self.posable[1]
            model = robot.spec(visual=False).compile()
            return overlays.outline_colliders(model, lambda state: robot.qpos(state.joints, state.gripper)[0])
        motion = self.results.motion
        if kind == "contacts":
            return overlays.outline_patches(motion)
        points = [item.point for item in motion.contacts]
        return overlays.outline_axis(motion, np.mean(points, 0) if points else self.pivot(name))

    def _open_episode_colliders(self, name: str) -> overlays.Overlay:
        episode, results = self.episode(name).episode, self.results
        scale = read_variation(self.episode(name)).scale
        fitted = scale_fit(results.fitted_assets[unit_of(episode.index).asset], scale)
        shared, demo = results.episode_scene, results.demonstration
        bolted = bool(episode.verdict["bolted"])
        scene = episode_scene(
            results.robot, fitted, demo, shared.support, shared.obstacles, bolted=bolted
        ).place_at(episode.T_world_object)

        return overlays.outline_colliders(
            scene.model,
            lambda state: scene.qpos(state.joints, state.gripper, state.theta)[0],
            episode.verdict.get(PAIR, ()),
        )


def _is_current(results: Results, name: str) -> bool:
    stage = next(stage for stage in STAGES if stage.name == name)
    manifest = read_manifest(results.folders[name])
    return manifest is not None and manifest.version == stage.version


class ViewedFolder:
    """Folder of a run or a capture, which is opened again after a change."""

    def __init__(self, folder: Path) -> None:
        """Open a folder.

        Raises:
            InputError, ConfigError: The folder contains neither a run nor a readable capture.
        """
        self._folder = folder
        self._opened = OpenedRun(self._find_results(), "")

    def open(self) -> OpenedRun:
        """Return the current state of the run.

        Raises:
            MissingFileError: The folder was moved or deleted.
        """
        token = self._compute_token()
        if token != self._opened.token:
            self._opened = OpenedRun(self._find_results(), token)
        return self._opened

    @property
    def last(self) -> OpenedRun:
        """Return the run as it was opened last; it can be rendered even if its folder was deleted."""
        return self._opened

    def _find_results(self) -> Results:
        if (self._folder / CAPTURE_FILE).is_file():
            # A single capture is displayed like a run without results.
            folder = read_capture(self._folder).folder.resolve()
            return results_of(Project(capture=folder, out=folder), STAGES)
        return results_of(find_project(self._folder), STAGES)

    def _compute_token(self) -> str:
        """Return a text that changes whenever a stage is committed; for new episodes the twin stays open."""
        results, opened = self._opened.results, self._opened
        for folder in (self._folder, *([results.out] if opened.done else [])):
            if not folder.exists():
                raise MissingFileError(
                    folder, "was moved or deleted", "the page still shows what was read before"
                )
        times = [
            file.stat().st_mtime_ns if (file := results.folders[stage.name] / MANIFEST).is_file() else 0
            for stage in STAGES
        ]
        return " ".join(map(str, times))
