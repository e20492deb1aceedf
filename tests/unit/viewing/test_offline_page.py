import base64
import json
import re
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest

from aomgen.core.project import Project
from aomgen.errors import MissingFileError
from aomgen.io.episode_folder import commit_episode
from aomgen.io.images import decode_image
from aomgen.io.review import ReviewChange, change_review
from aomgen.io.video import encode_video, read_video
from aomgen.pipeline.project_file import write_project
from aomgen.pipeline.rendering import render_twin
from aomgen.pipeline.stages import PROJECT_FILE
from aomgen.viewing.offline_page import _embed_episode, draw_strip, write_offline_page
from browser import needs_chromium, open_page
from reviewed_run import FRAMES, write_reviewed_run
from small_episodes import make_episode


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


def test_views_of_several_heights_are_shown_completely(tmp_path: Path) -> None:
    episode = make_episode(0, 6, cameras=("front", "wrist"))
    cameras = {**episode.cameras, "wrist": episode.cameras["wrist"].resize(160, 128)}
    front, wrist = np.full((6, 64, 80, 3), 40, np.uint8), np.full((6, 128, 160, 3), 90, np.uint8)
    wrist[:, 64:] = 220
    videos = {"front": encode_video(front, 10), "wrist": encode_video(wrist, 10)}
    commit_episode(tmp_path, replace(episode, cameras=cameras), videos)
    (tmp_path / "shown.mp4").write_bytes(
        decode(_embed_episode(tmp_path, SimpleNamespace(number=0, asset="a"))["video"])
    )
    shown = read_video(tmp_path / "shown.mp4").frames_srgb
    assert shown.shape == (6, 128, 240, 3)
    assert shown[0, 96, 200] == pytest.approx(220, abs=6)


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
