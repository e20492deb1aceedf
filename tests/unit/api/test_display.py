"""What a run shows while it works, with and without a terminal."""

import io
import re
import time
from dataclasses import replace

from rich.console import Console

from aomgen.api.display import PlainDisplay, TerminalDisplay, format_finished_line
from aomgen.pipeline.stages import STAGES

STRUCTURE = STAGES[0]
FIGURES = {"registered": 50, "of": 64, "points": 5925, "reprojection_error_px": 0.557}
SENTENCE = (
    " 37.4s structure from motion: 50 of 64 images registered (poor, good above 95 %); "
    "reprojection error 0.56 px (good below 1); 5,925 points"
)


def test_without_a_terminal_a_line_comes_every_few_seconds(capsys) -> None:
    """Also while the stage says nothing itself."""
    with PlainDisplay(every_s=0.02) as shown:
        shown.begin(STRUCTURE, fresh=False)
        shown.progress(0.25, "finding features")
        time.sleep(0.3)
        shown.end(STRUCTURE, 37.4, FIGURES)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "  ...    structure from motion"
    assert len(lines) > 4
    running = r"  \.\.\.    structure from motion (0|25) %, (finding features, )?about \d+ (s|min) left"
    assert all(re.fullmatch(running, line) for line in lines[1:-1])
    assert lines[-1] == f"  {SENTENCE}"


def test_a_stage_that_is_slower_than_its_weight_says_so(capsys) -> None:
    """Half a second for a tenth of the way leaves five, whatever its weight says."""
    episodes = STAGES[-1]
    with PlainDisplay(every_s=0.05) as shown:
        for stage in STAGES[:-1]:
            shown.begin(stage, fresh=True)
        shown.begin(replace(episodes, weight=0.0), fresh=False)
        time.sleep(0.5)
        shown.progress(0.1, "")
        time.sleep(0.2)
    left = re.search(r"10 %, about (\d+) s left", capsys.readouterr().out.splitlines()[-1])
    assert left is not None
    assert 4 <= int(left[1]) <= 9


def test_nothing_is_said_between_stages(capsys) -> None:
    with PlainDisplay(every_s=0.01) as shown:
        shown.begin(STRUCTURE, fresh=True)
        time.sleep(0.1)
        shown.warn(STRUCTURE, "the scan is short")
    assert capsys.readouterr().out.splitlines() == [
        "  kept   structure from motion",
        "         warning: the scan is short",
    ]


def test_good_and_poor_are_colored_on_a_terminal() -> None:
    line = format_finished_line(STRUCTURE, 37.4, FIGURES)
    assert line.plain == f"  {SENTENCE}"
    assert [span.style for span in line.spans] == ["yellow", "green"]


def test_text_with_brackets_is_shown_as_it_is() -> None:
    """Titles and notes are text, not markup of the terminal library."""
    output = io.StringIO()
    Console(file=output).print(format_finished_line(replace(STRUCTURE, title="parts [/bold] of"), 1.0, {}))
    assert "parts [/bold] of" in output.getvalue()


def test_a_stage_on_a_terminal_ends_in_its_line(capsys) -> None:
    with TerminalDisplay() as shown:
        shown.begin(STRUCTURE, fresh=False)
        shown.progress(0.5, "matching")
        shown.end(STRUCTURE, 37.4, FIGURES)
    assert SENTENCE in capsys.readouterr().out
