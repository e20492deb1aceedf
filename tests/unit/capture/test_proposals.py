import pytest

from aomgen.capture.read import read_capture
from aomgen.errors import InputError


def mark(capture, lines: str) -> None:
    """Add lines to the last prompt of a capture."""
    path = capture / "capture.toml"
    path.write_text(path.read_text("utf-8").rstrip() + f"\n{lines}\n", "utf-8")


def test_a_capture_with_proposals_warns_until_they_are_confirmed(capture_copy):
    before = read_capture(capture_copy)
    mark(capture_copy, "proposed = true\nconfidence = 0.61")
    after = read_capture(capture_copy)
    (warning,) = set(after.notes) - set(before.notes)
    assert "proposals (moving 0.61)" in warning
    assert "aomgen prompts" in warning
    assert len(after.prompts) == len(before.prompts)


@pytest.mark.parametrize(
    "lines", ["proposed = true", "confidence = 0.5", "proposed = true\nconfidence = 1.5", "proposed = 0.5"]
)
def test_a_proposal_without_its_confidence_is_refused(capture_copy, lines):
    mark(capture_copy, lines)
    with pytest.raises(InputError, match=r"confidence|proposed"):
        read_capture(capture_copy)


def test_missing_parts_are_accepted_only_where_prompts_may_be_incomplete(capture_copy):
    path = capture_copy / "capture.toml"
    path.write_text(path.read_text("utf-8").split("[[prompts]]")[0], "utf-8")
    with pytest.raises(InputError, match="init --propose"):
        read_capture(capture_copy)
    assert read_capture(capture_copy, complete=False).prompts == ()
