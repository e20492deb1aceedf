import numpy as np
import pytest

from aomgen.capture.read import read_capture
from aomgen.cli.app import main
from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.errors import BackendError, ConfigError, NoMotionError
from aomgen.parts.scan_views import ScanView
from aomgen.prompting import proposals
from aomgen.prompting.proposals import Proposal, as_section, write_proposals


def strip_prompts(capture, *parts: str) -> str:
    """Delete the prompts of some parts from a capture.toml, and return its text."""
    path = capture / "capture.toml"
    head, *prompts = path.read_text("utf-8").split("[[prompts]]")
    kept = [prompt for prompt in prompts if not any(f'"{part}"' in prompt for part in parts)]
    path.write_text("# by hand\n" + "[[prompts]]".join([head, *kept]), "utf-8")
    return path.read_text("utf-8")


@pytest.fixture
def seen(monkeypatch) -> list[list[str]]:
    """Parts that are asked for; each is found on two images, without any computation."""
    asked: list[list[str]] = []

    def propose(results, segmenter, parts, progress):
        asked.append(list(parts))
        camera = Camera(fx=600, fy=600, cx=320, cy=240, width=640, height=480, T_world_cam=np.eye(4))
        blank = np.zeros((480, 640), bool)
        return [
            Proposal(
                part=part,
                view=ScanView(
                    name=name, camera=camera, image_srgb=np.zeros((480, 640, 3), np.uint8), robot=blank
                ),
                box=np.array([-5.0, 10.0, 90.0, 500.0]),
                confidence=0.724,
            )
            for part in parts
            for name in ("0010.jpg", "0013.jpg")
        ]

    class Bent:
        scan_lens = None

    monkeypatch.setattr(proposals, "choose_segmenter", lambda folders, name: None)
    monkeypatch.setattr(
        proposals, "locate_robot", lambda results, progress: results.__dict__.update(structure=Bent())
    )
    monkeypatch.setattr(proposals, "propose_prompts", propose)
    return asked


def silent(share, text):
    pass


def test_missing_prompts_are_proposed_and_the_rest_of_the_file_stays(capture_copy, seen):
    text = strip_prompts(capture_copy, "static", "moving")
    written = write_proposals(capture_copy, silent)
    assert seen == [["static", "moving"]]
    assert len(written) == 4
    changed = (capture_copy / "capture.toml").read_text("utf-8")
    assert changed.startswith(text.split("[[prompts]]")[0].rstrip())
    assert changed.count("proposed = true\nconfidence = 0.72\n") == 4
    capture = read_capture(capture_copy)
    robot = [prompt for prompt in capture.prompts if prompt.part == "robot"]
    assert len(robot) == 2
    np.testing.assert_allclose(capture.prompts[-1].box, [0, 10, 90, 480])
    assert any("static 0.72, moving 0.72" in note for note in capture.notes)


def test_a_capture_with_all_prompts_is_left_alone(capture_copy, seen):
    before = (capture_copy / "capture.toml").read_bytes()
    with pytest.raises(ConfigError, match="has prompts of robot, static, moving already"):
        write_proposals(capture_copy, silent)
    assert seen == []
    assert (capture_copy / "capture.toml").read_bytes() == before


@pytest.mark.parametrize("error", [NoMotionError("video", "nothing moves"), KeyboardInterrupt()])
def test_nothing_is_written_where_proposals_fail(capture_copy, seen, monkeypatch, error):
    text = strip_prompts(capture_copy, "robot", "static", "moving")

    def fail(*_):
        raise error

    monkeypatch.setattr(proposals, "propose_prompts", fail)
    with pytest.raises(type(error)):
        write_proposals(capture_copy, silent)
    assert (capture_copy / "capture.toml").read_text("utf-8") == text


def test_missing_weights_are_named_before_any_work(capture_copy, monkeypatch, tmp_path):
    text = strip_prompts(capture_copy, "moving")
    monkeypatch.setenv("AOMGEN_WEIGHTS", str(tmp_path / "none"))
    monkeypatch.setattr(proposals, "locate_robot", lambda *_: pytest.fail("work began"))
    with pytest.raises(BackendError, match="weights are missing"):
        write_proposals(capture_copy, silent)
    assert (capture_copy / "capture.toml").read_text("utf-8") == text


def test_init_proposes_only_what_it_can_use(capture_copy, seen, tmp_path, monkeypatch, capsys):
    def check(choices, recorded):
        """The checks without those that decode the videos."""
        if "microwave:none" in choices.assets:
            raise ConfigError("microwave:none", "is no asset")
        return recorded.notes

    monkeypatch.setattr("aomgen.pipeline.preflight.check_project", check)
    monkeypatch.setattr("aomgen.pipeline.preflight.machine_warnings", lambda *_: ())
    text = strip_prompts(capture_copy, "moving")
    project = tmp_path / "project.toml"
    command = ["aomgen", "init", str(capture_copy), "--propose", "--project", str(project)]
    monkeypatch.setattr("sys.argv", [*command, "--asset", "microwave:none"])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == ConfigError.exit_code
    assert (capture_copy / "capture.toml").read_text("utf-8") == text
    capsys.readouterr()
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit) as caught:
        main()
    told = capsys.readouterr().out
    assert caught.value.code in (0, None), told
    assert "proposed moving on 0010.jpg, confidence 0.72" in told
    assert "warning: the prompts of capture.toml are proposals (moving 0.72)" in told
    assert project.is_file()
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == ConfigError.exit_code
    assert len(seen) == 1


def test_boxes_are_written_in_pixels_of_the_distorted_image():
    lens = Lens(fx=600, fy=600, cx=320, cy=240, width=640, height=480, k1=-0.2, k2=0.0, p1=0.0, p2=0.0)
    camera = Camera(fx=600, fy=600, cx=320, cy=240, width=640, height=480, T_world_cam=np.eye(4))
    blank = np.zeros((480, 640), bool)
    view = ScanView(name="0.jpg", camera=camera, image_srgb=np.zeros((480, 640, 3), np.uint8), robot=blank)
    box = np.array([40.0, 60.0, 300.0, 200.0])
    section = as_section(Proposal(part="static", view=view, box=box, confidence=1.3), lens, (640, 480))
    back = lens.undistort(np.array(section.box).reshape(2, 2))
    assert section.box is not None
    assert section.box[0] > box[0] + 5  # a barrel lens draws corners to the middle
    assert np.all(back.ravel()[:2] < box[:2] + 15)
    assert section.confidence == 1.0
    plain = as_section(Proposal(part="static", view=view, box=box, confidence=0.5), None, (640, 480))
    assert plain.box == box.tolist()
