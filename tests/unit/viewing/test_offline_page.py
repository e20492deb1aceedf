import base64
import json
import re
from io import BytesIO
from pathlib import Path

import av
import numpy as np
import pytest

from aomgen.core.project import Project
from aomgen.errors import MissingFileError
from aomgen.io.images import decode_image
from aomgen.io.review import ReviewChange, change_review
from aomgen.pipeline.project_file import write_project
from aomgen.pipeline.rendering import render_twin
from aomgen.pipeline.stages import PROJECT_FILE
from aomgen.viewing.offline_page import draw_strip, write_offline_page
from browser import needs_chromium, open_page
from reviewed_run import FRAMES, write_reviewed_run


def read_content(page: Path) -> dict:
    found = re.search(
        r'<script id="data" type="application/json">(.*?)</script>', page.read_text("utf-8"), re.DOTALL
    )
    assert found is not None
    return json.loads(found[1])


def decode(url: str) -> bytes:
    return base64.b64decode(url.partition(",")[2])


def test_a_page_holds_all_episodes_but_the_rejected_ones(tmp_path: Path) -> None:
    out, page = write_reviewed_run(tmp_path / "run"), tmp_path / "page.html"
    change_review(out, out / "08_episodes" / "000002", ReviewChange(decision="rejected"))
    change_review(out, out / "08_episodes" / "000004", ReviewChange(note="</script><b>bold"))
    (out / "08_episodes" / "000001" / "front.mp4").unlink()
    with pytest.raises(Exception, match=r"front.mp4: is missing"):
        write_offline_page(out, page)
    (out / "08_episodes" / "000001" / "episode.json").unlink()
    assert write_offline_page(out, page) == page.stat().st_size
    content = read_content(page)
    assert [item["number"] for item in content["episodes"]] == [4]
    assert content["episodes"][0]["note"] == "</script><b>bold"
    assert (content["kept"], content["rejected_by_review"], content["strip"]) == (1, 1, None)
    assert [(item["reason"], item["count"]) for item in content["reasons"]] == [
        ("out_of_view", 1),
        ("collision", 1),
    ]
    with av.open(BytesIO(decode(content["players"][0]["video"]))) as video:
        shapes = [frame.to_ndarray(format="rgb24").shape for frame in video.decode(video=0)]
    assert shapes == [(64, 160, 3)] * FRAMES


@needs_chromium
def test_the_page_opens_from_a_file(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    write_offline_page(write_reviewed_run(tmp_path / "run"), page)
    with open_page(page.as_uri()) as shown:
        assert shown.locator(".card").count() == 3
        shown.wait_for_function(
            "[...document.images].every(image => image.complete && image.naturalWidth === 160)"
        )
        shown.wait_for_function("document.querySelector('video').videoWidth === 160")


def test_a_run_that_has_made_nothing_is_named(tmp_path: Path) -> None:
    write_project(tmp_path / PROJECT_FILE, Project(capture=tmp_path, out=tmp_path, assets=("microwave:1",)))
    with pytest.raises(MissingFileError, match="neither a twin nor an episode"):
        write_offline_page(tmp_path, tmp_path / "page.html")


def test_the_strip_shows_the_twin_at_joint_values(toy_scene) -> None:
    twin, robot, camera = toy_scene.twin, toy_scene.robot, toy_scene.camera
    closed, opened = (
        decode_image(decode(url), Path("strip"))
        for url in draw_strip(twin, robot, camera, np.array([0.0, 1.2]))
    )
    rendered = render_twin(twin, robot, camera, twin.scan_state)[0]
    assert np.abs(closed.astype(int) - rendered).mean() < 3
    assert np.abs(opened.astype(int) - closed).max() > 60
