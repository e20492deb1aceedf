import base64
import io
import json

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from aomgen.conventions import PART_LABELS
from aomgen.errors import ConfigError, PoseError, ShapeError, UnknownNameError
from aomgen.viewing.opened import ViewedFolder
from aomgen.viewing.twin_pages import TwinPages
from aomgen.web.page_server import PageRequest, Route


@pytest.fixture(scope="module")
def routes(viewed: ViewedFolder) -> dict[str, Route]:
    return TwinPages(viewed).list_routes()


def get(routes: dict[str, Route], path: str, **query: str):
    response = routes[f"GET {path}"](PageRequest(query, b""))
    return json.loads(response.content) if response.kind == "application/json" else response.content


def draw(routes: dict[str, Route], motion: str, **changes):
    described = get(routes, "/api/motion", name=motion)
    rest = described["scene"]["controls"]["rest"]
    wanted = {
        "motion": motion,
        "camera": "front",
        "T_world_cam": described["cameras"]["front"]["Ts_world_cam"][0],
        "width": 160,
        "time": 0.4,
        **rest,
        "parts": list(PART_LABELS),
        "overlays": [],
    }
    body = json.dumps(wanted | changes).encode()
    return json.loads(routes["POST /api/draw"](PageRequest({}, body)).content)


def test_a_run_is_described(routes):
    run = get(routes, "/api/run")
    assert [item["name"] for item in run["motions"]] == ["recording", "7"]
    assert run["notes"] == []
    recording, episode = (get(routes, "/api/motion", name=name) for name in ("recording", "7"))
    assert len(recording["states"]["theta"]) == len(recording["times"]) == 48
    assert max(recording["states"]["theta"]) == pytest.approx(1.2)
    assert episode["scene"]["overlays"] == ["colliders", "cameras", "contacts", "axis"]
    assert Image.open(io.BytesIO(get(routes, "/api/frame", motion="7", camera="front", time="0.3"))).size == (160, 120)  # fmt: skip


@pytest.mark.parametrize("motion", ["recording", "7"])
def test_a_view_has_its_overlays(routes, motion):
    overlays = get(routes, "/api/motion", name=motion)["scene"]["overlays"]
    drawn = draw(routes, motion, overlays=overlays, time=4.0 if motion == "recording" else 0.4)
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(drawn["image"]))))
    assert image.shape == (120, 160, 3)
    assert image.std() > 10
    for name in ("collider", "scan", "axis", "contact"):
        assert drawn["lines"][name]
    assert bool(drawn["coverage"]) == ("coverage" in overlays)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"joints": [0.0]}, ShapeError),
        ({"gripper": 2.0}, ConfigError),
        ({"T_world_cam": [1.0] * 16}, PoseError),
        ({"T_world_cam": [1.0] * 3}, ShapeError),
        ({"parts": ["door"]}, UnknownNameError),
        ({"camera": "../front"}, UnknownNameError),
        ({"overlays": ["shadow"]}, UnknownNameError),
        ({"width": 100_000}, ValidationError),
        ({"file": "/etc/passwd"}, ValidationError),
    ],
)
def test_an_invalid_request_is_refused(routes, changes, error):
    with pytest.raises(error):
        draw(routes, "recording", **changes)


def test_a_capture_has_images_prompts_and_checks(routes):
    capture = get(routes, "/api/capture")
    assert len(capture["images"]) == 13
    assert {item["part"] for item in capture["prompts"]} == {"robot", "static", "moving"}
    assert get(routes, "/api/scan", index="3").startswith(b"\xff\xd8")
    with pytest.raises(IndexError):
        get(routes, "/api/scan", index="13")
    assert "ur5e" in get(routes, "/api/check")["facts"]
