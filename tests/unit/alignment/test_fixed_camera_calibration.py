"""Fixed cameras and clocks are found from drawn films of a moving arm, and refused where they cannot be."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from aomgen.alignment.bundle_terms import BundleParams
from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.fixed_camera_calibration import (
    AlignedScan,
    FixedCameraVideo,
    calibrate_fixed_cameras,
)
from aomgen.core.alignment import Alignment
from aomgen.core.camera import Camera, camera_in_world, look_at
from aomgen.core.progress import silent
from aomgen.core.recording import JointLog
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, similarity, transform
from aomgen.errors import AlignmentError, SyncError
from aomgen.io.video import Video
from aomgen.robots.robot import RobotConfiguration, RobotModel
from aomgen.robots.silhouette import SilhouetteRenderer
from small_alignment import ALIGNMENT

SCAN_JOINTS = np.array([3.5, -2.2, 2.4, 0.25, 1.35, 0.0])
S_WORLD_RECON = similarity(0.37, matrix_from_rotvec([1.1, -0.7, 2.0]), [0.4, -0.2, 0.9])
S_RECON_WORLD = np.array(np.linalg.inv(S_WORLD_RECON), np.float64)
ALIGNED = replace(ALIGNMENT, S_world_recon=S_WORLD_RECON)
# Where structure from motion puts a fixed camera: some millimetres and hundredths of a degree away.
MISPLACED = transform(matrix_from_rotvec([0.0012, -0.0009, 0.0007]), [0.003, -0.002, 0.003])
PARAMS = BundleParams(frames=20, width=320, points=200)
FPS, SECONDS = 10.0, 5.0


@dataclass(frozen=True)
class Stage:
    """A robot that moves along a log before a cloudy wall."""

    robot: RobotModel
    log: JointLog
    colors: np.ndarray
    views: list[AlignmentImage]
    points_recon: np.ndarray
    scan_off_rad: np.ndarray = field(default_factory=lambda: np.zeros(6))

    def scene(self) -> AlignedScan:
        configuration = RobotConfiguration(
            robot=self.robot, joints=SCAN_JOINTS + self.scan_off_rad, gripper=0.1
        )
        return AlignedScan(
            alignment=ALIGNED,
            views=self.views,
            points_recon=self.points_recon,
            configuration=configuration,
            log=self.log,
        )

    def picture(self, bodies: np.ndarray, wall: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        image = np.where((bodies >= 0)[..., None], self.colors[bodies], wall)
        return (image + rng.normal(0, 3, image.shape)).clip(0, 255).astype(np.uint8)

    def film(self, camera: Camera, offset_s: float, rate: float = 0.0, seed: int = 0) -> Video:
        rng = np.random.default_rng(seed)
        times = np.arange(int(FPS * SECONDS)) / FPS
        joints, gripper = self.log.at(times + offset_s + rate * (times - times.mean()))
        wall = clouds(rng)
        with SilhouetteRenderer(self.robot, max_width=320, max_height=240) as renderer:
            frames = [
                self.picture(renderer.draw(camera, row, float(closing))[0], wall, rng)
                for row, closing in zip(joints, gripper, strict=True)
            ]
        return Video(times_s=times, frames_srgb=np.stack(frames), fps=FPS)


def clouds(rng: np.random.Generator) -> np.ndarray:
    return 120 + np.stack([gaussian_filter(rng.normal(0, 400, (240, 320)), 8) for _ in range(3)], -1)


def world_camera(eye: list[float], target: tuple[float, float, float] = (-0.2, 0.0, 0.35)) -> Camera:
    pose = look_at(eye, target)
    return Camera(fx=440.0, fy=440.0, cx=160.0, cy=120.0, width=320, height=240, T_world_cam=pose)


FRONT, SIDE = world_camera([-1.7, -1.0, 0.9]), world_camera([0.4, -1.9, 0.7])


def placed(camera: Camera, T_error: np.ndarray = MISPLACED) -> Camera:
    """As structure from motion would place it, recon frame."""
    return camera_in_world(S_RECON_WORLD, camera.move(camera.T_world_cam @ T_error))


def camera_video(
    camera: Camera, video: Video, T_world_cam: np.ndarray | None = None, clock_offset_s: float | None = None
) -> FixedCameraVideo:
    return FixedCameraVideo(
        video=video, camera_recon=placed(camera), T_world_cam=T_world_cam, clock_offset_s=clock_offset_s
    )


def calibrate(stage: Stage, cameras: dict[str, FixedCameraVideo]) -> Alignment:
    return calibrate_fixed_cameras(stage.scene(), cameras, silent, PARAMS)


def error_px(found: Camera, true: Camera) -> float:
    """Median shift of the arm's workspace in the picture; 1 px as structure from motion places it."""
    places = np.random.default_rng(0).uniform([-0.7, -0.4, 0.1], [0.2, 0.4, 0.8], (50, 3))
    return float(np.median(np.linalg.norm(found.project(places)[0] - true.project(places)[0], axis=1)))


@pytest.fixture(scope="module")
def stage(robot: RobotModel) -> Stage:
    rng = np.random.default_rng(8)
    times = np.arange(0.0, 7.0, 0.02)
    phase = times[:, None] / np.array([4.7, 5.9, 3.9, 2.9, 3.3, 3.7]) * 2 * np.pi
    sway = np.array([0.55, 0.35, 0.4, 0.4, 0.4, 0.5])
    joints = SCAN_JOINTS + sway * (np.sin(phase) + 0.4 * np.sin(1.7 * phase + 1.0) - 0.4 * np.sin(1.0))
    log = JointLog(
        times_s=times,
        joints=joints + rng.normal(0, 2e-4, joints.shape),
        gripper=np.clip(times / 7, 0, 1),
        joint_names=robot.joint_names,
    )
    colors = rng.uniform(60, 220, (len(robot.body_names), 1)) + rng.normal(0, 15, (1, 3))
    points = apply(S_RECON_WORLD, rng.uniform([-1.2, -1, 0], [0.8, 1, 1], (400, 3)))
    stage = Stage(robot=robot, log=log, colors=colors, views=[], points_recon=points)
    with SilhouetteRenderer(robot, max_width=320, max_height=240) as renderer:
        for index in range(6):
            angle = 2 * np.pi * index / 8
            camera = world_camera([-0.2 + 1.9 * np.cos(angle), 1.9 * np.sin(angle), 0.5 + 0.06 * index])
            bodies, _ = renderer.draw(camera, SCAN_JOINTS, 0.1)
            image = stage.picture(bodies, clouds(rng), rng)
            recon = camera_in_world(S_RECON_WORLD, camera)
            stage.views.append(AlignmentImage(name=f"{index}", camera_recon=recon, image_srgb=image))
    return stage


@pytest.fixture(scope="module")
def front_film(stage: Stage) -> Video:
    """The moving arm from the front, 0.4 s before the log; rendered once."""
    return stage.film(FRONT, 0.4)


@pytest.mark.slow
def test_several_cameras_and_their_clocks_are_found_and_a_blind_one_is_kept(stage: Stage) -> None:
    wall = world_camera([-1.7, -1.0, 0.9], (-3.0, -3.0, 0.9))
    cameras = {
        "front": camera_video(FRONT, stage.film(FRONT, 1.2)),
        "side": camera_video(SIDE, stage.film(SIDE, -0.5, seed=1), SIDE.T_world_cam),
        "wall": camera_video(wall, stage.film(wall, 0.3)),
    }
    found = calibrate(stage, cameras)
    for name, true, offset in (("front", FRONT, 1.2), ("side", SIDE, -0.5)):
        camera = found.cameras[name]
        assert camera.require_clock().offset_s == pytest.approx(offset, abs=0.01)
        assert error_px(camera.camera, true) < 0.3
        assert camera.warnings(name) == []
    assert "calibration agrees" in found.cameras["side"].note
    blind = found.cameras["wall"]
    assert blind.clock is None
    there = camera_in_world(found.S_world_recon, cameras["wall"].camera_recon)
    assert blind.camera.T_world_cam == pytest.approx(there.T_world_cam)
    assert any("as the scan placed it" in warning for warning in blind.warnings("wall"))
    with pytest.raises(SyncError, match="stands still"):
        blind.require_clock()
    elbow = np.array([-0.3, 0.0, 0.5])
    assert np.linalg.norm(apply(found.S_world_recon @ S_RECON_WORLD, elbow) - elbow) < 0.002


@pytest.mark.slow
def test_a_clock_that_drifts_is_refused_with_the_factor(stage: Stage) -> None:
    found = calibrate(stage, {"front": camera_video(FRONT, stage.film(FRONT, 0.5, rate=0.02))})
    camera = found.cameras["front"]
    assert camera.clock is None
    assert error_px(camera.camera, FRONT) < 0.3
    with pytest.raises(SyncError, match="while the video counts 1 s") as refused:
        camera.require_clock()
    factor = float(refused.value.remedy.rsplit(" ", 1)[1])
    assert factor == pytest.approx(1 / 1.02, abs=0.002)


@pytest.mark.slow
def test_a_known_clock_is_kept_and_a_slightly_wrong_calibration_contradicted(stage: Stage) -> None:
    wrong = FRONT.T_world_cam @ transform(np.eye(3), [0.02, 0.0, 0.01])
    cameras = {"front": camera_video(FRONT, stage.film(FRONT, 0.2), wrong, 0.2)}
    found = calibrate(stage, cameras).cameras["front"]
    assert found.require_clock().offset_s == 0.2
    assert error_px(found.camera, FRONT) < 0.3
    assert any("contradicts" in warning for warning in found.warnings("front"))
    assert found.figures["calibration_mm"] == pytest.approx(1e3 * np.hypot(0.02, 0.01), abs=4)


@pytest.mark.slow
def test_a_film_without_the_arm_moves_no_camera(stage: Stage) -> None:
    rng = np.random.default_rng(2)
    times = np.arange(int(FPS * SECONDS)) / FPS
    wall = (clouds(rng)[None] + rng.normal(0, 3, (len(times), 240, 320, 3))).clip(0, 255).astype(np.uint8)
    cameras = {"front": camera_video(FRONT, Video(times_s=times, frames_srgb=wall, fps=FPS), None, 0.2)}
    found = calibrate(stage, cameras).cameras["front"]
    assert found.warnings("front")
    # The scan views alone place the similarity.
    assert error_px(found.camera, FRONT.move(FRONT.T_world_cam @ MISPLACED)) < 0.2


def test_without_frames_cameras_stay_and_a_known_clock_is_kept(stage: Stage) -> None:
    empty = Video(times_s=np.zeros(1), frames_srgb=np.zeros((1, 240, 320, 3), np.uint8), fps=FPS)
    found = calibrate_fixed_cameras(
        stage.scene(),
        {"front": camera_video(FRONT, empty, None, 0.2), "side": camera_video(SIDE, empty)},
        silent,
        replace(PARAMS, frames=0),
    )
    camera = found.cameras["front"]
    there = camera_in_world(S_WORLD_RECON, placed(FRONT))
    assert camera.camera.T_world_cam == pytest.approx(there.T_world_cam, abs=1e-6)
    assert found.S_world_recon == pytest.approx(S_WORLD_RECON, abs=1e-6)
    assert camera.require_clock().offset_s == 0.2
    assert camera.warnings("front") == []
    # The offset of one camera is not that of the others.
    assert found.cameras["side"].clock is None


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        (invert(FRONT.T_world_cam), "inverse"),
        (np.diag([-1.0, -1, 1, 1]) @ FRONT.T_world_cam, "base_frame"),
        (FRONT.T_world_cam @ np.diag([1.0, -1, -1, 1]), "OpenGL"),
        (FRONT.T_world_cam @ transform(np.eye(3), [0.5, 0, 0]), "calibrate again"),
    ],
)
def test_a_gross_calibration_is_refused_with_its_mistake(stage: Stage, wrong: np.ndarray, hint: str) -> None:
    empty = Video(times_s=np.zeros(1), frames_srgb=np.zeros((1, 240, 320, 3), np.uint8), fps=FPS)
    with pytest.raises(AlignmentError, match="T_world_cam in capture") as refused:
        calibrate(stage, {"front": camera_video(FRONT, empty, wrong)})
    assert hint in str(refused.value)


@pytest.mark.slow
def test_joint_zeros_are_found_with_the_moving_arm(stage: Stage, front_film: Video) -> None:
    zeros = np.radians([0.0, 0.4, -0.4, 0.3, -0.3, 0.0])
    found = calibrate(worse(stage, -zeros), {"front": camera_video(FRONT, front_film)})
    assert np.degrees(found.joint_zeros_rad[1:4]) == pytest.approx(np.degrees(zeros[1:4]), abs=0.2)
    assert np.all(np.abs(found.joint_zeros_rad - zeros) < 4 * found.joint_zero_sds_rad)


@pytest.mark.slow
def test_joints_as_logged_stay(stage: Stage, front_film: Video) -> None:
    found = calibrate(stage, {"front": camera_video(FRONT, front_film)})
    assert np.abs(np.degrees(found.joint_zeros_rad)).max() < 0.1


def test_a_joint_far_off_is_refused_by_name(stage: Stage, front_film: Video) -> None:
    zeros = np.radians([0.0, 0.0, 3.5, 0.0, 0.0, 0.0])
    with pytest.raises(AlignmentError, match="elbow_joint"):
        calibrate(worse(stage, -zeros), {"front": camera_video(FRONT, front_film, None, 0.4)})


def worse(stage: Stage, added_rad: np.ndarray) -> Stage:
    """The stage with a log that is off; its pictures show the joints as they were."""
    return replace(stage, log=replace(stage.log, joints=stage.log.joints + added_rad), scan_off_rad=added_rad)
