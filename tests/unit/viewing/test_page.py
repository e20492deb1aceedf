"""What a person does with the twin page, in a real browser."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from aomgen.viewing.view_server import ViewServer
from browser import needs_chromium, open_page

# Waits until the view is at rest, and returns its pixels.
SETTLE = """async () => {
  await new Promise(done => setTimeout(done, 50));
  while (document.body.dataset.sharp !== "true") await new Promise(done => setTimeout(done, 20));
  const canvas = document.getElementById("view");
  return [canvas.width, canvas.height, canvas.toDataURL()];
}"""


@contextmanager
def serve(folder: Path) -> Iterator[ViewServer]:
    with ViewServer(folder, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@needs_chromium
@pytest.mark.slow
def test_scrub_toggle_and_orbit(finished_toy_run: Path):
    with serve(finished_toy_run) as server, open_page(server.url + "#t=2.0", 1000, 800) as page:
        page.wait_for_selector("body[data-drawings]", timeout=60_000)
        start = page.evaluate(SETTLE)
        assert page.evaluate("frame") == 10
        assert start[0] / start[1] == pytest.approx(4 / 3, abs=0.02)

        # Of many events only some are drawn, and the last one is.
        drawings = int(page.evaluate("document.body.dataset.drawings"))
        page.evaluate(
            """() => { const scrub = document.getElementById("scrub");
            for (let k = 0; k < 60; k++) { scrub.value = k % 48; scrub.dispatchEvent(new Event("input")); } }"""
        )
        page.wait_for_selector("body[data-frame='11']")
        moved = page.evaluate(SETTLE)
        assert int(page.evaluate("document.body.dataset.drawings")) - drawings < 10
        assert moved[2] != start[2]

        # An arrow does one thing, wherever the focus is: it steps a frame.
        page.focus("#scrub")
        page.keyboard.press("ArrowRight")
        page.wait_for_selector("body[data-frame='12']")
        page.focus("#slider-gripper")
        before = page.evaluate("pose.gripper")
        page.keyboard.press("ArrowRight")
        assert page.evaluate("[frame, pose.gripper > arguments]".replace("arguments", str(before))) == [
            12,
            True,
        ]
        page.click("#rest")

        shown = page.evaluate(SETTLE)
        page.uncheck("[data-toggle=moving]")
        hidden = page.evaluate(SETTLE)
        assert hidden[2] != shown[2]
        page.check("[data-toggle=axis]")
        page.check("[data-toggle=moving]")
        assert page.evaluate(SETTLE)[2] == shown[2]
        assert page.evaluate("last.lines.region.length") > 20

        box = page.locator("#frame").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + 100, box["y"] + 100)
        page.mouse.down()
        page.mouse.move(box["x"] + 180, box["y"] + 110, steps=3)
        page.mouse.up()
        orbited = page.evaluate(SETTLE)
        assert orbited[2] != shown[2]
        page.keyboard.press("r")
        assert page.evaluate(SETTLE)[2] == shown[2]

        page.click("[data-compare=wipe]")
        page.wait_for_selector("body[data-film]")
        assert page.is_visible("#wipe")
        page.wait_for_function("location.hash.includes('t=2.40')")
        page.select_option("#motion", "7")
        page.wait_for_function("location.hash.includes('episode=7')")
