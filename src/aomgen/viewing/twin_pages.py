"""Requests of the twin page: contents of a run, images of its scenes with overlays, and frames of its videos."""

import base64
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field

from aomgen.api.arguments import require_array, require_poses
from aomgen.capture.capture_check import check_capture
from aomgen.conventions import PART_LABELS
from aomgen.errors import AomgenError, ConfigError, MissingFileError, UnknownNameError
from aomgen.io.images import encode_jpeg
from aomgen.pipeline.preflight import category_warnings
from aomgen.twin.twin import TwinState
from aomgen.viewing.observed import describe_support, project_coverage
from aomgen.viewing.opened import OpenedRun, ViewedFolder
from aomgen.viewing.overlays import Moment, project_overlay
from aomgen.viewing.scenes import PosableScene, ViewedScene
from aomgen.web.page_server import (
    JPEG_QUALITY,
    PageRequest,
    RequestFields,
    Response,
    Route,
    send_file,
    send_jpeg,
    send_json,
)

PACKAGE: Final = "aomgen.viewing"
FILES: Final = ("twin.css", "twin.js", "orbit.js", "capture.js", "keys.js")
# Largest width of a rendered image, [px]: wider images take too long for interactive use.
MAX_WIDTH: Final = 1600

# The surveyed points of the robot are on its surface if no joint differs more than this from the scan, [rad].
AS_SCANNED_RAD: Final = 0.02


class MotionRequest(RequestFields):
    """Name of a motion."""

    name: str


class FrameRequest(RequestFields):
    """Camera and time [s] of a recorded frame."""

    motion: str
    camera: str
    time: float


class ScanImageRequest(RequestFields):
    """Number of a scan image."""

    index: int


class DrawRequest(RequestFields):
    """View, state and parts of a rendering.

    `camera` is the camera of the motion whose intrinsics are used; T_world_cam is the pose of the view, row by row.
    """

    motion: str
    camera: str
    T_world_cam: tuple[float, ...]
    width: Annotated[int, Field(ge=16, le=MAX_WIDTH)]
    time: float
    joints: tuple[float, ...]
    gripper: float
    theta: float
    parts: tuple[str, ...]
    overlays: tuple[str, ...]


class TwinPages:
    """Routes of the twin page of a run or capture."""

    def __init__(self, viewed: ViewedFolder) -> None:
        self._viewed = viewed
        # One thread renders and opens scenes: two threads would compete for the same processors, and the renderer
        # allocates memory for each thread.
        self._work = ThreadPoolExecutor(max_workers=1, thread_name_prefix="draw")

    def list_routes(self) -> dict[str, Route]:
        """Return the routes by method and path."""
        return {
            "GET /": send_file(PACKAGE, "twin.html"),
            **{f"GET /{name}": send_file(PACKAGE, name) for name in FILES},
            "GET /api/run": self._get_run,
            "GET /api/motion": self._get_motion,
            "GET /api/frame": self._get_frame,
            "GET /api/capture": self._get_capture,
            "GET /api/check": self._get_check,
            "GET /api/scan": self._get_scan,
            "POST /api/draw": self._post_draw,
        }

    def _get_run(self, request: PageRequest) -> Response:
        opened = self._viewed.open()
        return send_json(
            {
                "name": opened.results.out.name,
                "token": opened.token,
                "notes": opened.list_notes(),
                "motions": opened.list_motions(),
            }
        )

    def _get_motion(self, request: PageRequest) -> Response:
        name = request.parse(MotionRequest).name
        return send_json(self._work.submit(_describe_motion, self._viewed.last, name).result())

    def _get_frame(self, request: PageRequest) -> Response:
        wanted = request.parse(FrameRequest)
        motion = self._work.submit(self._viewed.last.motion, wanted.motion).result()[0]
        if wanted.camera not in motion.videos:
            raise UnknownNameError("camera", wanted.camera, motion.videos)
        return Response("image/jpeg", motion.videos[wanted.camera](wanted.time))

    def _get_capture(self, request: PageRequest) -> Response:
        opened = self._viewed.last
        recorded = opened.results.recorded
        prompts = [
            {"part": item.part, "image": item.image, "points": item.points.tolist(), "box": item.box.tolist()}
            for item in recorded.prompts
        ]
        return send_json({"images": opened.scan.names, "size": list(recorded.scan_size), "prompts": prompts})

    def _get_check(self, request: PageRequest) -> Response:
        recorded = self._viewed.last.results.recorded
        try:
            _, facts, warnings = check_capture(recorded)
        except AomgenError as error:
            return send_json({"facts": "", "warnings": [str(error)]})
        return send_json({"facts": facts, "warnings": [*warnings, *category_warnings(recorded)]})

    def _get_scan(self, request: PageRequest) -> Response:
        index = request.parse(ScanImageRequest).index
        images = self._viewed.last.scan
        if not 0 <= index < len(images.names):
            raise IndexError(f"the scan has no image {index}")
        return send_jpeg(images.read(index))

    def _post_draw(self, request: PageRequest) -> Response:
        wanted = request.parse(DrawRequest)
        drawing: Future[dict[str, Any]] = self._work.submit(draw, self._viewed.last, wanted)
        return send_json(drawing.result())


def _describe_motion(opened: OpenedRun, name: str) -> dict[str, Any]:
    motion, problem = opened.motion(name)
    scene = opened.scene(name)
    described = motion.describe() | {"name": name, "note": problem, "scene": None}
    if scene is None or not motion.cameras:
        return described
    rest = scene.rest if isinstance(scene, PosableScene) else None
    shown: dict[str, Any] = {
        "parts": list(PART_LABELS) if opened.has_parts else [],
        "overlays": opened.list_overlays(name),
        "pivot": opened.pivot(name).tolist(),
        "up": opened.find_up().tolist(),
        "controls": None,
    }
    if isinstance(scene, PosableScene) and rest is not None:
        joint, robot = scene.twin.joint, scene.robot
        limits = np.clip(robot.joint_limits, -2 * np.pi, 2 * np.pi)
        shown["controls"] = {
            "joints": [
                {"name": key, "lower": low, "upper": high, "slides": bool(slides)}
                for key, (low, high), slides in zip(
                    robot.joint_names, limits.tolist(), robot.slides, strict=True
                )
            ],
            "theta": {"lower": joint.lower, "upper": joint.upper, "slides": joint.type == "prismatic"},
            "rest": {"joints": rest.joints.tolist(), "gripper": rest.gripper, "theta": rest.theta},
        }
    return described | {"scene": shown}


def draw(opened: OpenedRun, wanted: DrawRequest) -> dict[str, Any]:
    """Render a view and project its overlays.

    Returns:
        JPEG in base 64, overlays as segments [px] by class, coverage as points [px], and sentences about content
        that the scan does not show.

    Raises:
        UnknownNameError, ShapeError, PoseError, ConfigError: A name is unknown, or a value is invalid.
    """
    motion, scene = opened.motion(wanted.motion)[0], opened.scene(wanted.motion)
    if scene is None:
        raise MissingFileError(opened.results.out, "has no Gaussians yet", "finish the run first")
    for name in wanted.parts:
        if name not in PART_LABELS:
            raise UnknownNameError("parts", name, PART_LABELS)
    if wanted.camera not in motion.cameras:
        raise UnknownNameError("camera", wanted.camera, motion.cameras)
    T = require_poses("T_world_cam", require_array("T_world_cam", wanted.T_world_cam, (16,)).reshape(4, 4), single=True)  # fmt: skip
    optics = motion.cameras[wanted.camera].camera
    camera = optics.resize(wanted.width, max(1, round(optics.height * wanted.width / optics.width))).move(T)
    moment = Moment(_read_state(scene, wanted), wanted.time, camera)
    view = scene.draw(moment.state, camera, wanted.parts)
    lines: dict[str, Any] = {}
    for kind in wanted.overlays:
        if kind != "coverage":
            lines |= project_overlay(opened.overlay(wanted.motion, kind), moment)
    points = []
    if "coverage" in wanted.overlays and opened.survey is not None:
        points = project_coverage(
            opened.survey, camera, view.depth, with_robot=_is_as_scanned(scene, moment.state)
        )
    whole = set(wanted.parts) == set(PART_LABELS)
    notes = describe_support(
        camera,
        view.alpha if whole else None,
        opened.scan_cameras,
        opened.pivot(wanted.motion),
        opened.survey if wanted.motion == "recording" else None,
    )
    return {
        "image": base64.b64encode(encode_jpeg(view.image_srgb, JPEG_QUALITY, halve_colors=False)).decode(),
        "width": camera.width,
        "height": camera.height,
        "lines": lines,
        "coverage": points,
        "notes": notes,
    }


def _is_as_scanned(scene: ViewedScene, state: TwinState) -> bool:
    """Return whether the robot has its joint values of the scan."""
    if not isinstance(scene, PosableScene):
        return True
    return bool(np.abs(state.joints - scene.rest.joints).max() < AS_SCANNED_RAD)


def _read_state(scene: ViewedScene, wanted: DrawRequest) -> TwinState:
    if not isinstance(scene, PosableScene):
        return TwinState(joints=np.zeros(0), gripper=0.0, theta=0.0, T_world_object=np.eye(4))
    if not 0 <= wanted.gripper <= 1:
        raise ConfigError("gripper", f"is {wanted.gripper:g}", "pass 0 (open) to 1 (closed)")
    return TwinState(
        joints=require_array("joints", wanted.joints, (len(scene.robot.joint_names),)),
        gripper=wanted.gripper,
        theta=float(require_array("theta", wanted.theta, ())),
        T_world_object=scene.rest.T_world_object,
    )
