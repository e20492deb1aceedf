import base64
import json
import threading
import urllib.request
from collections.abc import Iterator
from io import BytesIO
from urllib.error import HTTPError

import numpy as np
import pytest
from PIL import Image

from aomgen.capture.read import read_capture
from aomgen.errors import BackendError, InputError
from aomgen.prompting import session as sessions
from aomgen.prompting.server import PromptServer
from aomgen.prompting.session import PromptSession

STATED = {"category": "microwave", "instruction": "open it"}


class BrightPixels:
    """A segmenter whose mask is what is brighter than grey, within the box."""

    def prepare(self, name, image_srgb):
        self.bright = image_srgb.mean(2) > 128
        return self

    def mask(self, part, box_px, points):
        mask = np.zeros_like(self.bright)
        x0, y0, x1, y1 = np.asarray(box_px, int) if len(box_px) else (100, 100, 200, 180)
        mask[y0:y1, x0:x1] = True
        return mask


@pytest.fixture
def server(capture_copy, monkeypatch) -> Iterator[PromptServer]:
    monkeypatch.setattr(sessions, "choose_segmenter", lambda folders, name: BrightPixels())
    with PromptServer(PromptSession(capture_copy), 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def ask(server, path, body=None, **headers):
    data = None if body is None else json.dumps(body).encode()
    headers = ({"Content-Type": "application/json"} if body is not None else {}) | headers
    with urllib.request.urlopen(urllib.request.Request(server.url + path, data, headers)) as answer:
        content = answer.read()
        return json.loads(content) if answer.headers.get_content_type() == "application/json" else content


def refusal(server, path, body=None, **headers):
    with pytest.raises(HTTPError) as caught:
        ask(server, path, body, **headers)
    return caught.value.code, json.loads(caught.value.read())["error"]


def test_page_images_and_masks(server, sample):
    assert b"<canvas" in ask(server, "")
    state = ask(server, "api/state")
    assert state["images"] == sorted(path.name for path in (sample / "scan").iterdir())
    assert len(state["prompts"]) == 6
    assert len(set(state["proposed"])) == 6
    assert Image.open(BytesIO(ask(server, "api/image?index=5"))).size == (640, 480)
    answer = ask(server, "api/mask", {"image": 5, "part": "moving", "points": [[150, 120, 1]]})
    mask = np.asarray(Image.open(BytesIO(base64.b64decode(answer["mask"]))))
    assert mask.shape == (480, 640)
    assert mask[110, 110] == 255
    assert answer["box"] == [98, 98, 202, 182]
    assert ask(server, "api/mask", {"image": 5, "part": "moving", "points": [[9, 9, 0]]})["mask"] == ""


def test_save_writes_what_a_run_reads(server):
    prompts = ask(server, "api/state")["prompts"]
    prompts[0]["box"] = [100, 100, 300, 300]
    prompts[0]["points"] = []
    assert ask(server, "api/save", {"prompts": prompts, **STATED}) == {"missing": {}}
    capture = read_capture(server.session.capture)
    assert capture.prompts[0].box.tolist() == [100, 100, 300, 300]
    assert (capture.category, capture.instruction) == ("microwave", "open it")
    assert ask(server, "api/save", {"prompts": prompts[1:], **STATED}) == {"missing": {"robot": 1}}


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"box": [0, 0, 9000, 9]}, "outside"),
        ({"image": "none.jpg"}, "none.jpg"),
        ({"box": [30, 30, 10, 10]}, "corner"),
        ({"part": "door"}, "invalid"),
        ({"points": [[float("nan"), 2, 1]]}, "invalid"),
    ],
)
def test_invalid_prompts_are_not_saved(server, changes, word):
    before = (server.session.capture / "capture.toml").read_bytes()
    prompts = ask(server, "api/state")["prompts"]
    prompts[0] |= changes
    code, text = refusal(server, "api/save", {"prompts": prompts, **STATED})
    assert code == 400
    assert word in text
    assert (server.session.capture / "capture.toml").read_bytes() == before


def test_invalid_requests_are_refused(server):
    assert refusal(server, "api/image?index=64")[0] == 400
    assert refusal(server, "api/mask", {"image": -1, "part": "moving"})[0] == 400
    assert refusal(server, "api/mask", {"file": "x"})[0] == 400


def test_done_ends_the_server(capture_copy, monkeypatch):
    monkeypatch.setattr(sessions, "choose_segmenter", lambda folders, name: BrightPixels())
    with PromptServer(PromptSession(capture_copy), 0) as server:
        threading.Timer(0.2, lambda: ask(server, "api/done", {})).start()
        server.serve_forever()


def test_without_weights_there_are_no_masks(capture_copy, monkeypatch):
    def refuse(folders, name):
        raise BackendError("MobileSAM", "is not installed", "make weights")

    monkeypatch.setattr(sessions, "choose_segmenter", refuse)
    session = PromptSession(capture_copy)
    assert "make weights" in session.describe()["no_masks"]
    assert session.segment(0, "robot", [[5, 5, 1]], []) is None


def test_missing_capture_is_named(tmp_path):
    with pytest.raises(InputError, match=r"capture\.toml"):
        PromptSession(tmp_path)


def test_proposals_are_shown_as_such_and_confirmed_by_saving(capture_copy, monkeypatch):
    path = capture_copy / "capture.toml"
    path.write_text(path.read_text("utf-8").rstrip() + "\nproposed = true\nconfidence = 0.61\n", "utf-8")
    monkeypatch.setattr(sessions, "choose_segmenter", lambda folders, name: BrightPixels())
    session = PromptSession(capture_copy)
    last = session.describe()["prompts"][-1]
    assert (last["proposed"], last["confidence"]) == (True, 0.61)
    session.save(session.prompts, STATED)
    assert "proposed" not in path.read_text("utf-8")
    assert not any("proposals" in note for note in read_capture(capture_copy).notes)
