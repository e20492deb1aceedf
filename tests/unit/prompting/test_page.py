"""A person's clicks in a real browser."""

import re
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from aomgen.prompting.server import PromptServer
from aomgen.prompting.session import PromptSession
from browser import needs_chromium, open_page


@contextmanager
def served(session: PromptSession) -> Iterator[PromptServer]:
    with PromptServer(session, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@needs_chromium
@pytest.mark.slow
def test_clicks_give_the_bundled_prompts_again(capture_copy: Path):
    path = capture_copy / "capture.toml"
    text = path.read_text("utf-8")
    wanted = tomllib.loads(text)["prompts"]
    path.write_text(re.sub(r"\n\[\[prompts\]\].*", "", text, flags=re.DOTALL))
    before = path.read_text("utf-8")
    session = PromptSession(capture_copy)
    milliseconds = []
    with served(session) as server, open_page(server.url) as page:
        for prompt in wanted:
            index = session.images.names.index(prompt["image"])
            page.click(f"[data-part={prompt['part']}]")
            page.locator(f"[data-index='{index}'].thumb").last.click()
            page.wait_for_selector(f"canvas[data-index='{index}']")
            encoded = session.encode(index)
            assert encoded is not None
            encoded.result()  # As after the seconds in which a person looks.
            area = page.locator("canvas").bounding_box()
            assert area is not None
            scale = area["width"] / session.size[0]

            def at(x: float, y: float, area=area, scale=scale) -> tuple[float, float]:
                return area["x"] + scale * x, area["y"] + scale * y

            page.evaluate("delete document.body.dataset.maskMs")
            page.mouse.click(*at(*prompt["points"][0][:2]))
            page.wait_for_selector("body[data-mask-ms]")
            milliseconds.append(page.evaluate("Number(document.body.dataset.maskMs)"))
            page.mouse.move(*at(*prompt["box"][:2]))
            page.mouse.down()
            page.mouse.move(*at(*prompt["box"][2:]), steps=3)
            page.mouse.up()
        page.wait_for_selector("body[data-missing='0']")
        page.keyboard.press("s")
        page.wait_for_selector("#save:disabled")
        page.click("#done")
    found = tomllib.loads(path.read_text("utf-8"))["prompts"]
    assert path.read_text("utf-8").startswith(before)
    assert [(item["part"], item["image"]) for item in found] == [
        (item["part"], item["image"]) for item in wanted
    ]
    for item, want in zip(found, wanted, strict=True):
        np.testing.assert_allclose(item["box"], want["box"], atol=1.0)
        np.testing.assert_allclose(item["points"], want["points"], atol=1.0)
    # On two idle cores a mask takes 0.2 s; other tests run beside this one.
    assert np.median(milliseconds) < 3000
