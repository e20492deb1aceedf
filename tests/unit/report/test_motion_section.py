"""Pictures and charts of a recovered motion show what the estimate says, at the right place."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.joint import Joint, JointType
from aomgen.core.motion import ContactPatch, MotionCurve, MotionEstimate
from aomgen.io.artifact import save_artifact
from aomgen.motion.estimates_file import REFUSED_MOTION, forget_refusal
from aomgen.report.images import AXIS, TOUCH, axis_space, overlay_motion
from aomgen.report.motion_section import motion_charts, motion_sentence, write_refusal

TIMES_S = np.linspace(0, 4, 41, dtype=np.float64)
HELD = np.array([0.5, 0.0, 0.2])
ORIGIN = np.array([0.5, 0.4, 0.0])
# From x = -0.7 towards +x: y is to the left of the picture, z up.
CAMERA = Camera(
    fx=300, fy=300, cx=160, cy=120, width=320, height=240, T_world_cam=look_at((-0.7, 0.2, 0.2), (0.5, 0.2, 0.2))
)  # fmt: skip


def estimate(joint_type: JointType = "revolute", axis: tuple = (0.0, 0.0, 1.0)) -> MotionEstimate:
    upper = 1.0 if joint_type == "revolute" else 0.2
    count = len(TIMES_S)
    ramp = np.clip(TIMES_S - 1, 0, 2) / 2
    curve = MotionCurve(
        times_s=TIMES_S,
        scores=ramp,
        smoothed=ramp,
        threshold=0.1,
        distances_m=ramp,
        speeds_m_s=ramp,
        gripper=ramp,
    )
    patch = ContactPatch(finger="left", point=HELD, normal=np.array([1.0, 0, 0]), spread_m=0.01, gap_m=0.001)
    return MotionEstimate(
        clock_offset_s=0.0,
        clock_offset_sd_s=0.0,
        start_s=1.0,
        end_s=3.0,
        curve=curve,
        contacts=(patch,),
        grasp_ee=np.zeros(3),
        joint=Joint(type=joint_type, axis=np.array(axis), origin=ORIGIN, lower=0.0, upper=upper),
        axis_sd_rad=0.01,
        origin_sd_m=0.01,
        axis_ci95_rad=0.1,
        origin_ci95_m=0.02,
        type_margin=10.0,
        ee_turn_ratio=1.0,
        times_s=TIMES_S,
        thetas=upper * ramp,
        theta_sd=np.full(count, 0.05 * upper),
        slip_m=np.full(count, 0.004),
        pivot_rad=np.full(count, 0.1),
        direction="opening",
        part_odds=9.0,
    )


def test_the_region_of_a_hinge_is_narrowest_at_the_held_point() -> None:
    centers, circles = axis_space(estimate(), HELD)
    radii = np.linalg.norm(circles - centers[:, None], axis=-1)
    middle = len(centers) // 2
    assert centers[middle] == pytest.approx([0.5, 0.4, 0.2])
    assert radii[middle] == pytest.approx(0.02)
    reach = 0.7 * 0.4
    assert centers[-1] == pytest.approx([0.5, 0.4, 0.2 + reach])
    assert radii[-1] == pytest.approx(0.02 + reach * np.tan(0.1))
    assert (circles[-1] - centers[-1])[:, 2] == pytest.approx(0.0)


def test_the_region_of_a_slide_is_a_cone_from_the_held_point() -> None:
    centers, circles = axis_space(estimate("prismatic", (-1.0, 0.0, 0.0)), HELD)
    radii = np.linalg.norm(circles - centers[:, None], axis=-1)
    assert centers[0] == pytest.approx(HELD)
    assert radii[0] == pytest.approx(0.0)
    assert centers[-1] == pytest.approx(HELD - [0.2, 0, 0])
    assert radii[-1] == pytest.approx(0.2 * np.tan(0.1))


def drawn(theta: float = 0.0, motion: MotionEstimate | None = None) -> np.ndarray:
    return overlay_motion(
        np.zeros((240, 320, 3), np.uint8), CAMERA, motion or estimate(), HELD, theta
    ).astype(int)


def where(image: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Columns and rows (N, 2) of a color."""
    rows, columns = np.nonzero(np.all(image == color, axis=-1))
    return np.stack([columns, rows], 1)


def test_the_axis_is_drawn_where_it_is_and_veiled_around() -> None:
    image = drawn()
    center, _ = CAMERA.project(np.array([[0.5, 0.4, 0.2]]))
    line = where(image, AXIS)
    assert np.median(line[:, 0]) == pytest.approx(center[0, 0], abs=2)
    # The waist is 2 cm wide: 5 px at this depth; half of it is veiled but not the line.
    beside = image[120, round(center[0, 0]) + 3]
    assert 0 < beside[2] < AXIS[2]
    assert image[120, round(center[0, 0]) + 15].max() == 0


def test_the_contact_is_drawn_where_the_part_carried_it() -> None:
    """A quarter turn about the hinge takes the held point from y = 0 to y = 0.4 and 0.4 m away."""
    for theta, place in ((0.0, HELD), (np.pi / 2, [0.9, 0.4, 0.2])):
        pixel, _ = CAMERA.project(np.array([place]))
        assert where(drawn(theta), TOUCH).mean(0) == pytest.approx(pixel[0], abs=6)


def test_an_axis_behind_the_camera_is_left_out() -> None:
    away = Camera(
        fx=300, fy=300, cx=160, cy=120, width=320, height=240, T_world_cam=look_at((-0.7, 0.2, 0.2), (-2, 0.2, 0.2))
    )  # fmt: skip
    image = overlay_motion(np.zeros((240, 320, 3), np.uint8), away, estimate(), HELD, 0.0)
    assert not image.any()


def test_an_axis_known_to_a_hair_is_a_line() -> None:
    sure = replace(estimate(), axis_ci95_rad=0.0, origin_ci95_m=0.0)
    assert len(where(drawn(motion=sure), AXIS)) > 50


def test_the_charts_show_score_value_with_its_band_and_grip() -> None:
    score, theta, grip = (item for item in motion_charts(estimate()) if item.startswith("<svg"))
    assert 'class="span"' in score
    assert "threshold" in score
    assert "joint value [deg]" in theta
    assert "slip [mm]" in grip
    assert "pivot [deg]" in grip
    assert ">-0<" not in score + theta + grip
    polygon = re.search(r'points="([^"]+)" class="band"', theta)
    assert polygon is not None
    low, high = (float(polygon[1].split()[k].split(",")[1]) for k in (0, -1))
    # 1.96 deviations of 0.05 rad to either side, in a chart of 172 px from the band's low to 1.08 of its high.
    half = 1.96 * 0.05
    assert low - high == pytest.approx(172 * 2 * half / (1.08 * (1 + half) + half), abs=0.2)


def test_the_sentence_claims_no_certainty_that_nobody_estimated() -> None:
    assert "the 95 % interval of its axis is +-5.7 deg, of its origin +-20 mm" in motion_sentence(estimate())
    slide = motion_sentence(estimate("prismatic", (-1.0, 0.0, 0.0)))
    assert "+-5.7 deg. " in slide
    unsure = motion_sentence(replace(estimate(), axis_ci95_rad=0.0, origin_ci95_m=0.0))
    assert "It is a revolute joint. " in unsure


def refused_curve() -> MotionCurve:
    times = np.arange(20) / 10
    return MotionCurve(
        times_s=times,
        scores=np.full(20, 0.01),
        smoothed=np.zeros(20),
        threshold=0.02,
        distances_m=np.full(20, 0.3),
        speeds_m_s=np.zeros(20),
        gripper=np.zeros(20),
    )


def test_the_score_is_drawn_beside_the_reason(tmp_path: Path) -> None:
    save_artifact(tmp_path, REFUSED_MOTION, refused_curve())
    page = write_refusal(tmp_path, "the part does not move")
    assert page is not None
    text = page.read_text()
    assert "the part does not move" in text
    assert text.count("<svg") == 2


def test_a_run_refused_elsewhere_or_forgotten_has_no_page(tmp_path: Path) -> None:
    assert write_refusal(tmp_path, "no images") is None
    save_artifact(tmp_path, REFUSED_MOTION, refused_curve())
    write_refusal(tmp_path, "the part does not move")
    forget_refusal(tmp_path)
    assert list(tmp_path.iterdir()) == []
