"""What `python -m benchmarks splatting` writes, on a tiny case."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from aomgen.splatting import native
from aomgen.splatting.session import RenderSession
from benchmarks import agreement
from benchmarks.moving_scenes import arm_scene
from benchmarks.projection import parameters_of
from benchmarks.scenes import table_camera, table_top
from benchmarks.sessions import measure_session
from benchmarks.splatting import (
    OPERATIONS_PER_PAIR,
    Effort,
    SpeedCase,
    default_cases,
    measure,
)
from benchmarks.table import as_table
from benchmarks.tiles_float64 import TileReference, choose_tiles
from benchmarks.timing import interleaved_ms, torch_threads

FRACTIONS = {
    "forward_ms",
    "forward_backward_ms",
    "torch_forward_backward_ms",
    "session_ms",
    "session_tiles_share",
    "max_forward_error",
    "forward_error_p999",
    "forward_error_decided",
    "max_gradient_error",
    "gradient_error_decided",
    "decided_share",
    "ns_per_pair",
    "share_of_bound",
}
KEYS = {
    "gaussians": int,
    "width": int,
    "height": int,
    "sh_degree": int,
    "threads": int,
    "isa": str,
    "evaluated_pairs": int,
    "blended_pairs": int,
} | {name: float for name in FRACTIONS}
SESSION_FIGURES = ("picture_ms", "draw_ms", "full_ms", "speed_over_full", "frames_per_s")


@pytest.fixture(scope="module")
def figures():
    isa = native.instruction_sets()[-1]
    case = SpeedCase(gaussians=400, width=64, height=48, threads=1, isa=isa)
    return measure((case,), Effort(repeats=2, tiles=4, arm=(300, 200, 64)))


def test_every_case_has_every_key(figures):
    (case,) = figures["cases"]
    assert {name: type(value) for name, value in case.items()} == KEYS
    assert all(np.isfinite(case[name]) and case[name] > 0 for name in FRACTIONS)


def test_work_is_what_float64_counts(figures):
    """All tiles of the picture are compared, so that every blended pair is counted there too."""
    (case,) = figures["cases"]
    camera, parameters = table_camera(64, 48), parameters_of(table_top(400, 3))
    blended = TileReference(parameters, camera, 3, choose_tiles(camera, 12, seed=0)).images().blended
    assert case["blended_pairs"] == pytest.approx(blended, rel=1e-3)
    assert case["evaluated_pairs"] >= case["blended_pairs"]


def test_the_share_of_the_bound_follows_its_definition(figures):
    (case,) = figures["cases"]
    assert case["ns_per_pair"] == pytest.approx(1e6 * figures["stages"][0]["blend"] / case["evaluated_pairs"])
    throughput = native.Context(1, case["isa"]).vector_throughput()
    share = 1e9 * OPERATIONS_PER_PAIR / throughput / case["ns_per_pair"]
    assert case["share_of_bound"] == pytest.approx(share, rel=0.5)  # measured twice on a busy machine
    assert str(OPERATIONS_PER_PAIR) in figures["bound"]


def test_the_engine_agrees_with_float64(figures):
    (case,) = figures["cases"]
    assert case["forward_error_decided"] < 2e-5
    assert case["gradient_error_decided"] < 1e-4
    assert case["decided_share"] > 0.9


def test_sessions_draw_what_full_renders_draw(figures):
    objects, arm = figures["sessions"]
    assert [session["scene"] for session in figures["sessions"]] == ["objects", "arm"]
    assert objects["static"] + objects["moving"] == 400
    assert (arm["static"], arm["moving"], arm["width"], arm["height"]) == (300, 200, 64, 64)
    for session in figures["sessions"]:
        assert session["max_difference"] < 1e-5
        assert 0 < session["tiles_share"] <= 1
        assert all(session[name] > 0 for name in SESSION_FIGURES)
    assert figures["cases"][0]["session_ms"] == objects["picture_ms"]


def test_a_wrong_session_shows_in_its_difference(monkeypatch):
    right = RenderSession.draw

    def wrong(session, moving, parts):
        """Moving Gaussians stay where they were at the first frame."""
        wrong.parts = getattr(wrong, "parts", parts)
        return right(session, moving, wrong.parts)

    monkeypatch.setattr(RenderSession, "draw", wrong)
    scene = arm_scene(300, 200, table_camera(64, 64))
    speed = measure_session(scene, 1, native.instruction_sets()[0], repeats=1)
    assert speed.max_difference > 1e-2


def test_instruction_sets_are_compared_with_the_best(figures):
    comparison = figures["instruction_sets"]
    for name in native.instruction_sets():
        assert comparison[name]["forward_ms"] > 0
        assert comparison[name]["forward_backward_ms"] > 0
    assert comparison[native.instruction_sets()[0]]["forward_ratio"] == 1


def test_the_default_cases_are_the_promised_ones():
    cases = default_cases()
    assert len(cases) == 6 + len(native.instruction_sets())
    assert {(case.gaussians, case.width, case.height) for case in cases[:6]} == {
        (count, *size) for count in (20_000, 100_000, 300_000) for size in ((640, 480), (320, 240))
    }
    assert {case.isa for case in cases} == set(native.instruction_sets())
    assert cases[-1].threads == 1
    assert all(case.sh_degree == 3 and case.threads >= 1 for case in cases)


@pytest.mark.parametrize("damage", ["picture", "gradient"])
def test_a_wrong_engine_shows_in_the_errors(monkeypatch, damage):
    """Either the picture gets brighter by 0.01, or gradients by 1 % larger, where nothing is at a limit."""
    oracle = agreement.Oracle(table_top(400, 1), table_camera(64, 48), tiles=4)
    right = agreement.draw

    def wrong(*arguments):
        drawn = right(*arguments)
        if damage == "picture":
            return replace(drawn, rgb=drawn.rgb + 0.01)
        return replace(drawn, rgb=drawn.rgb * 1.01 - 0.01 * drawn.rgb.detach())

    monkeypatch.setattr(agreement, "draw", wrong)
    errors = oracle.compare(native.Context(1))
    if damage == "picture":
        assert errors.forward_error_decided == pytest.approx(0.01, abs=1e-4)
        assert errors.max_forward_error >= errors.forward_error_decided
    else:
        assert errors.forward_error_decided < 1e-4
        assert errors.gradient_error_decided > 1e-3
        assert errors.max_gradient_error > 1e-3


def test_functions_take_turns():
    calls = []
    times = interleaved_ms({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 3)
    assert calls == list("abababab")
    assert {name: len(values) for name, values in times.items()} == {"a": 3, "b": 3}


def test_torch_gets_its_threads_back():
    before = torch.get_num_threads()
    with pytest.raises(KeyError), torch_threads(before + 1):
        raise KeyError
    assert torch.get_num_threads() == before


def test_table():
    text = as_table([{"name": "avx2", "ms": 12.3456, "error": 3e-6}, {"name": "x", "ms": None, "error": 0.0}])
    assert text.splitlines() == ["name     ms    error", "avx2  12.35  3.0e-06", "   x      -        0"]
    assert as_table([]) == ""
