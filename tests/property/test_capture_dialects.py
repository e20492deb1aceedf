"""A sound capture is accepted, and read as the same values, in whichever dialect its files are written."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aomgen.capture.capture_check import check_capture
from aomgen.capture.joint_log import read_joint_log
from aomgen.capture.log_table import SEPARATORS
from aomgen.capture.read import read_capture
from aomgen.core.recording import JointLog, Recording
from aomgen.errors import AomgenError
from aomgen.io.images import read_image
from aomgen.io.video import Video, read_video
from broken_captures import write_small
from capture_dialects import DIALECTS

SAMPLE = Path(__file__).parents[2] / "src" / "aomgen" / "samples" / "microwave-a"
CASES = Path(__file__).parents[3] / "shared" / "cases"


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sound") / "capture"
    write_small(SAMPLE, folder)
    return folder


@pytest.fixture(scope="module")
def sound_capture(sound) -> Recording:
    """The capture before it is changed, read once."""
    return read_capture(sound)


@pytest.fixture(scope="module")
def sound_video(sound_capture) -> Video:
    """Frames of the video before it is changed, decoded once."""
    return read_video(sound_capture.cameras[0].video)


@pytest.mark.parametrize("name", DIALECTS)
def test_a_dialect_is_accepted_or_named(sound, sound_capture, sound_video, tmp_path, name):
    dialect, folder = DIALECTS[name], tmp_path / "capture"
    shutil.copytree(sound, folder)
    dialect.change(folder)
    if dialect.refused:
        with pytest.raises(AomgenError) as caught:
            check_capture(read_capture(folder))
        assert all(word in str(caught.value) for word in dialect.words), caught.value
        return
    capture = read_capture(folder)
    _, _, warnings = check_capture(capture)
    if dialect.words:
        (said,) = warnings
        assert all(word in said for word in dialect.words), said
    else:
        assert warnings == ()
    assert_same(sound_capture, sound_video, capture, dialect)


def assert_same(sound: Recording, video: Video, capture: Recording, dialect) -> None:
    if dialect.log:
        assert_same_log(sound.joint_log, capture.joint_log)
    if dialect.video:
        assert_same_video(video, capture.cameras[0].video)
    if dialect.scan:
        for ours, theirs in zip(sound.scan_images, capture.scan_images, strict=True):
            difference = np.abs(read_image(ours).astype(int) - read_image(theirs))
            assert difference.mean() < 6


def assert_same_log(ours: JointLog, theirs: JointLog) -> None:
    """The same joints and gripper over time from the start, up to whole turns."""
    start = theirs.times_s[0] - ours.times_s[0]
    moments = theirs.times_s - start
    moments = moments[moments <= ours.times_s[-1]]
    joints, grip = ours.at(moments)
    difference = theirs.at(moments + start)[0] - joints
    turns = 2 * np.pi * np.round(difference.mean(0) / (2 * np.pi))
    assert np.abs(difference - turns).max() < 0.03
    assert np.abs(theirs.at(moments + start)[1] - grip).max() < 0.03


def assert_same_video(want: Video, theirs: Path) -> None:
    """Frames of one time show the same."""
    found = read_video(theirs)
    at = np.abs(want.times_s - found.times_s[:, None]).argmin(1)
    assert np.abs(want.times_s[at] - found.times_s).max() < 0.002
    assert found.times_s[-1] == pytest.approx(want.times_s[-1], abs=0.21)
    differences = found.frames_srgb.astype(np.int16) - want.frames_srgb[at]
    assert np.abs(differences).mean() < 4
    # A wrong matrix or range shifts a color as a whole.
    assert np.abs(differences.mean((0, 1, 2))).max() < 2.2


HIGHLIGHTS = {
    "L2-500hz-8ms": (),
    "L18-jitter-ros": (),
    "L5-wrap": ("unwrapped",),
    "L9a-blank-last": (),
    "L4-reversed-ends-holding": ("reversed", "gripper_range"),
}


@given(data=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_mixture_of_text_dialects_reads_the_same_numbers(tmp_path, data):
    """Separator, encoding, line ends, quotes, comments, column order and clock are independent of each other."""
    rng = np.random.default_rng(0)
    names = ["a", "b", "grip"]
    values = np.column_stack([0.02 * np.arange(40), rng.uniform(-3, 3, (1, 2)) + rng.normal(0, 0.01, (40, 2)),
                              np.linspace(0, 1, 40)])  # fmt: skip
    separator = data.draw(st.sampled_from(SEPARATORS))
    comma = separator != "," and data.draw(st.booleans())
    clock, ticks = data.draw(
        st.sampled_from([("time_s", 1), ("timestamp", 1e3), ("t_us", 1e6), ("Time [ns]", 1e9)])
        if separator != " "
        else st.sampled_from([("time_s", 1), ("t_us", 1e6)])
    )
    order = data.draw(st.permutations(range(4)))
    header = [[clock, *names][k] for k in order]

    def field(row: np.ndarray, k: int) -> str:
        text = f"{row[k] * ticks:.9f}" if k == 0 else f"{row[k]:.9f}"
        return text.replace(".", ",") if comma else text

    lines = [separator.join(header), *(separator.join(field(row, k) for k in order) for row in values)]
    for _ in range(data.draw(st.integers(0, 3))):
        lines.insert(
            data.draw(st.integers(1, len(lines))), data.draw(st.sampled_from(["", "# note", "  ", "% note"]))
        )
    end = data.draw(st.sampled_from(["\n", "\r\n", "\r"]))
    encoding = data.draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "latin-1"]))
    path = tmp_path / "log.csv"
    path.write_bytes(end.join(lines).encode(encoding))
    log, _ = read_joint_log(path, ["a", "b"], "grip")
    assert np.allclose(log.times_s, values[:, 0])
    assert np.allclose(log.joints, values[:, 1:3])
    assert np.allclose(log.gripper, values[:, 3])


@pytest.mark.skipif(not CASES.is_dir(), reason="the foreign files lie beside the project, not in it")
class TestForeignFiles:
    """Captures as other programs wrote them."""

    @pytest.fixture
    def folder(self, tmp_path) -> Path:
        shutil.copytree(CASES / "capture", tmp_path / "capture")
        for path in (tmp_path / "capture").rglob("*"):
            path.chmod(0o755)
        return tmp_path / "capture"

    def check(self, folder: Path) -> tuple[str, ...]:
        return check_capture(read_capture(folder))[2]

    def put_log(self, folder: Path, name: str) -> None:
        import gzip

        (folder / "demo" / "joints.csv").write_bytes(
            gzip.decompress((CASES / f"{name}.joints.csv.gz").read_bytes())
        )

    @pytest.mark.parametrize("name", HIGHLIGHTS)
    def test_logs_that_are_accepted(self, folder, name):
        self.put_log(folder, name)
        said = " ".join(self.check(folder))
        assert all(word in said for word in HIGHLIGHTS[name])
        assert bool(said) == bool(HIGHLIGHTS[name])

    def test_wrapped_angles_are_those_of_the_sound_log(self, folder):
        sound = read_capture(folder).joint_log
        self.put_log(folder, "L5-wrap")
        assert_same_log(sound, read_capture(folder).joint_log)

    def test_a_gripper_in_metres_is_asked_for(self, folder):
        self.put_log(folder, "L3a-grip-metres")
        with pytest.raises(AomgenError, match=r"meters\?.*gripper_range = \[0.085, 0\]"):
            self.check(folder)

    def test_a_trimmed_video_has_the_frames_that_are_shown(self, folder):
        sound = read_video(folder / "demo" / "front.mp4")
        assert_same_video(sound, CASES / "V1-editlist.front.mp4")
        assert len(read_video(CASES / "V1-editlist.front.mp4").times_s) == 95

    def test_a_variable_rate_keeps_its_times(self, folder):
        assert_same_video(read_video(folder / "demo" / "front.mp4"), CASES / "V2-vfr.front.mp4")

    def test_grey_images_of_16_bits_are_as_sharp_as_their_originals(self, folder):
        for path in sorted((CASES / "S1a-grey16").iterdir()):
            (folder / "scan" / f"{path.stem}.jpg").unlink()
            shutil.copy(path, folder / "scan")
        assert self.check(folder) == ()
