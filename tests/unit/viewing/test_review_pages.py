"""The review in two real browsers at once, and what its requests refuse."""

import json
import shutil
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from urllib.error import HTTPError

import numpy as np
import pytest

from aomgen.io.images import decode_image
from aomgen.io.review import REVIEW_FILE, read_reviews
from aomgen.viewing.review_pages import list_review_routes
from aomgen.viewing.view_server import PACKAGE
from aomgen.web.page_server import PageServer, send_file
from browser import needs_chromium, open_page
from reviewed_run import FRAMES, write_reviewed_run
from small_episodes import FPS

# Grey level of the first view in the middle of the frame that is shown.
READ_GREY = """() => {
    const view = document.querySelector("#views video"), canvas = document.createElement("canvas");
    canvas.width = view.videoWidth; canvas.height = view.videoHeight;
    const pen = canvas.getContext("2d");
    pen.drawImage(view, 0, 0);
    return pen.getImageData(40, 32, 1, 1).data[0];
}"""


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return write_reviewed_run(tmp_path / "run")


@pytest.fixture
def server(out: Path) -> Iterator[PageServer]:
    shared = {f"GET /{name}": send_file(PACKAGE, name) for name in ("pages.css", "pages.js")}
    with PageServer(shared | list_review_routes(out), 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.stop()
        thread.join()


def ask(server, path, body=None):
    data = None if body is None else json.dumps(body).encode()
    headers = {"Content-Type": "application/json"} if body is not None else {}
    with urllib.request.urlopen(urllib.request.Request(server.url + path, data, headers)) as answer:
        content = answer.read()
        return json.loads(content) if answer.headers.get_content_type() == "application/json" else content


def refuse(server, path, body=None) -> str:
    with pytest.raises(HTTPError) as caught:
        ask(server, path, body)
    return json.loads(caught.value.read())["error"]


def test_the_wall_is_sent_again_only_when_it_has_changed(server):
    wall = ask(server, "review/draws")
    assert len(wall["draws"]) == 5
    assert ask(server, "review/draws?version=" + wall["version"]) == {"version": wall["version"]}
    change = {"number": 2, "change": {"decision": "rejected", "add_tags": ["dark"]}}
    assert ask(server, "review/change", change) == {"decision": "rejected", "tags": ["dark"], "note": ""}
    again = ask(server, "review/draws?version=" + wall["version"])
    assert [draw["decision"] for draw in again["draws"]] == ["", "", "rejected", "", ""]


def test_images_are_those_of_the_first_and_last_frame(server):
    levels = [
        decode_image(ask(server, f"review/thumbnail?number=1&frame={frame}"), Path("frame"))[48, 80, 0]
        for frame in ("first", "last")
    ]
    np.testing.assert_allclose(levels, [30, 30 + 6 * (FRAMES - 1)], atol=3)


def test_pages_of_draws_state_their_limits_and_phases(server):
    episode = ask(server, "review/draw?number=2")
    assert episode["limits"][0]["figure"] == "torque_share"
    assert [(phase["name"], phase["first"], phase["last"]) for phase in episode["phases"]] == [
        ("approach", 0, 2),
        ("contact", 3, 8),
        ("retreat", 9, 11),
    ]
    forces = next(item for item in episode["series"] if item["title"] == "finger force")
    assert [line["values"][3] for line in forces["lines"]] == [0.0, 4.0]
    rejected = ask(server, "review/draw?number=3")
    assert rejected["pair"] == "wrist_1_link and table"
    assert rejected["figures"] == {"planned penetration of other bodies": "3.00 mm"}


def test_damage_is_one_sentence_and_the_rest_stays_up(server, out):
    (out / "08_episodes" / "000001" / "front.mp4").write_bytes(b"no video")
    assert "does not match its digest" in refuse(server, "review/draw?number=1")
    assert "is not a video" in refuse(server, "review/thumbnail?number=1&frame=first")
    assert "there is no draw 9" in refuse(server, "review/draw?number=9")
    assert "has no images" in refuse(server, "review/thumbnail?number=3&frame=first")
    assert "no camera 2" in refuse(server, "review/video?number=1&camera=2")
    assert "not permitted" in refuse(server, "review/draw?number=1&file=/etc/passwd")
    assert "is missing" in refuse(server, "review/change", {"number": 3, "change": {"decision": "rejected"}})
    (out / REVIEW_FILE).write_text("{")
    assert "is not valid JSON" in refuse(server, "review/draws")
    (out / REVIEW_FILE).unlink()
    assert len(ask(server, "review/draws")["draws"]) == 5
    shutil.rmtree(out)
    assert "is missing" in refuse(server, "review/draws")


@needs_chromium
def test_two_windows_review_at_once(server, out):
    with open_page(server.url + "review#episode=2&t=0.5") as first:
        second = first.context.browser.new_page()
        second.goto(server.url + "review#episode=4")
        for page, number in ((first, 2), (second, 4)):
            page.wait_for_selector(f"body[data-opened='{number}']")
        first.wait_for_selector("body[data-frame='5']")
        assert first.evaluate(READ_GREY) == pytest.approx(40 + 6 * 5, abs=3)
        first.keyboard.press("ArrowRight")
        first.wait_for_selector("body[data-frame='6']")
        assert first.evaluate(READ_GREY) == pytest.approx(40 + 6 * 6, abs=3)
        assert first.url.endswith(f"#episode=2&t={6 / FPS:.2f}")
        first.keyboard.press("r")
        second.keyboard.press("a")
        second.keyboard.press("t")
        second.keyboard.type("well lit")
        second.keyboard.press("Enter")
        second.keyboard.press("n")
        second.keyboard.type("a good one")
        second.keyboard.press("Escape")
        first.wait_for_selector("#reject[aria-pressed=true]")
        second.wait_for_function("document.querySelector('#status').textContent.includes('4')")
        first.keyboard.press("Escape")
        first.wait_for_selector(".card[data-number='4'][data-decision=accepted] >> text=a good one")
        first.wait_for_selector(".card[data-number='2'][data-decision=rejected]")
        first.click("[data-outcome=committed]")
        assert first.locator(".card").count() == 2
        first.wait_for_selector(".card.rejected >> text=wrist_1_link and table")
    found = read_reviews(out)
    assert {number: (item.decision, item.tags, item.note) for number, item in found.items()} == {
        2: ("rejected", (), ""),
        4: ("accepted", ("well lit",), "a good one"),
    }
