"""Columns of a table are found, or the table is refused; no value is read from another column."""

from pathlib import Path

import pytest

from aomgen.capture.log_table import LogTable, read_log_table
from aomgen.errors import MalformedFileError


def read(folder: Path, text: str, *required: str) -> LogTable:
    path = folder / "log.csv"
    path.write_text(text, "utf-8")
    return read_log_table(path, required)


@pytest.mark.parametrize("required", [(), ("time", "q")])
@pytest.mark.parametrize(
    ("text", "header"),
    [
        ("\ttime\tq\n0\t0.5\t7\n1\t0.6\t7\n", ("", "time", "q")),
        ("time\tq\t\n0.5\t7\t\n0.6\t7\t\n", ("time", "q", "")),
        ("time\tq\tforce [N]\n0.5\t7\t1\n0.6\t7\t1\n", ("time", "q", "force [N]")),
        ("\t# note\n\t\ntime\tq\n0.5\t7\n0.6\t7\n", ("time", "q")),
        ("#\ttime\tq\n0.5\t7\n0.6\t7\n", ("time", "q")),
    ],
)
def test_tabs_delimit_fields(tmp_path: Path, text: str, header: tuple[str, ...], required: tuple[str, ...]):
    table = read(tmp_path, text, *required)
    assert table.header == header
    assert table.column("time", float) == [0.5, 0.6]
    assert table.column("q", float) == [7, 7]


@pytest.mark.parametrize(
    "text",
    [
        "time,q\n0,0.5,7\n1,0.6,7\n",
        "time q\n0 0.5 7\n1 0.6 7\n",
        "time [ms] q\n0.5 7\n0.6 7\n0.7 7\n",
        "time,q,gripper\n0.5,7,0\n0,6,7,0\n",
    ],
)
def test_rows_with_other_columns_than_the_header_are_refused(tmp_path: Path, text: str):
    with pytest.raises(MalformedFileError, match=r"row \d has \d fields, the header has \d"):
        read(tmp_path, text, "q")


@pytest.mark.parametrize(
    ("text", "header"),
    [
        # `rostopic echo -p` writes the names of the joints as values.
        (
            "%time,field.seq,field.name0,field.position0\n17,0,elbow,0.5\n18,1,elbow,0.6\n",
            ("time", "field.seq", "field.name0", "field.position0"),
        ),
        ("# time q\n0.5 7\n0.6 7\n", ("time", "q")),
        ("# recorded in lab\nTime (s),q 1\n0.5,7\n0.6,7\n", ("Time (s)", "q 1")),
        ("# recorded by me at the lab\ntime,0,1\n0.5,7,8\n0.6,7,8\n", ("time", "0", "1")),
    ],
)
def test_a_header_of_unknown_names_may_be_a_comment(tmp_path: Path, text: str, header: tuple[str, ...]):
    table = read(tmp_path, text)
    assert table.header == header
    assert len(table.rows) == 2


def test_a_table_without_rows_has_a_header(tmp_path: Path):
    assert read(tmp_path, "# time,q\n").header == ("time", "q")
