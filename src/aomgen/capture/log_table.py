"""Tables of numbers as loggers, spreadsheets and numpy write them.

One description of what such a file may look like:

- Encoding: UTF-8 or UTF-16 with or without a byte order mark, otherwise Latin-1.
- Separator: comma, semicolon, tab, vertical bar or white space; the one that yields the required columns.
- Numbers: with a decimal point, or with a decimal comma where the comma does not separate columns.
- Lines: any line ends; empty lines and comments (`#`, `%`, `//`) anywhere, the header itself may be a
  comment as numpy writes it; repeated headers; an incomplete last line of a logger that was stopped.
"""

import csv
import io
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError, suggest

# Half an hour at 1 kHz, far above any demonstration.
MAX_ROWS: Final = 2_000_000
# Two million rows of 16 columns, [bytes].
MAX_BYTES: Final = 512 << 20
SEPARATORS: Final = (",", ";", "\t", "|", " ")
COMMENTS: Final = ("#", "%", "//")
# A line with which spreadsheets declare their separator.
_DECLARATION: Final = re.compile(r"sep=.$", re.IGNORECASE)
_DECIMAL_COMMA: Final = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?$")


@dataclass(frozen=True, slots=True, kw_only=True)
class LogTable:
    """The text of a table, without empty lines and comments.

    Attributes:
        path: File, for messages.
        header: Column names.
        rows: Fields of each row.
        lines: Number of each row's line in the file, from 1.
        notes: Sentences about skipped rows.
    """

    path: Path
    header: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]
    notes: tuple[str, ...]

    def column(self, name: str, convert: Callable[[str], float]) -> list[float]:
        """Convert the values of one column.

        Raises:
            MalformedFileError: A field that cannot be converted; names line and column.
        """
        at, values = self.header.index(name), []
        for line, fields in zip(self.lines, self.rows, strict=True):
            try:
                values.append(convert(fields[at]))
            except (ValueError, IndexError) as error:
                found = repr(fields[at]) if at < len(fields) else "nothing"
                raise MalformedFileError(
                    self.path,
                    f"row {line} has {found} in column '{name}', which is not a number",
                    "re-export the log or delete the row",
                ) from error
        return values


def read_number(text: str) -> float:
    """Parse a number with a decimal point or a decimal comma.

    Raises:
        ValueError: It is no number.

    Example:
        >>> read_number(" 1,25"), read_number("-3e-2")
        (1.25, -0.03)
    """
    text = text.strip()
    return float(text.replace(",", ".") if _DECIMAL_COMMA.match(text) else text)


def read_log_table(path: Path, required: Sequence[str]) -> LogTable:
    """Read a table in any of the dialects above.

    Args:
        required: Columns that must be there; empty where the layout is not known.

    Raises:
        MissingFileError, LimitExceededError: The file is missing or too large.
        MalformedFileError: No text, no header, a missing column, or a row whose fields do not match the columns.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "copy it there or correct capture.toml")
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"is larger than {MAX_BYTES} bytes")
    text = _decode(path.read_bytes(), path)
    # A tab at the start or the end of a line delimits an empty field.
    lines = [(number, line.strip(" ")) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line.strip() and not _DECLARATION.match(line)]
    if not len(lines) <= MAX_ROWS:
        raise LimitExceededError(path, f"has more than {MAX_ROWS} rows")
    try:
        start, header, separator = _find_header(lines, required, path)
        return _read_rows(path, lines[start + 1 :], header, separator)
    except csv.Error as error:
        raise MalformedFileError(path, f"is not a table ({error})", "re-export the log") from error


def _decode(data: bytes, path: Path) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encodings = ("utf-16",)
    else:
        encodings = ("utf-8-sig", "latin-1")
    for encoding in encodings:
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text
    raise MalformedFileError(path, "is not a text file", "export the log as CSV")


def _find_header(
    lines: list[tuple[int, str]], required: Sequence[str], path: Path
) -> tuple[int, list[str], str]:
    """Find the index of the header line, the column names and the separator.

    The header is the first line that is no comment, or the comment before it if this contains more of the required names.
    If no names are required, the comment must contain more names than the line and have as many fields.
    """
    first = next((k for k, (_, line) in enumerate(lines) if not _is_comment(line)), len(lines))
    found: tuple[int, list[str], str] = (first, [], ",")
    best = -1
    below = lines[min(first, len(lines) - 1)][1] if lines else ""
    for at in (first, first - 1):
        if not 0 <= at < len(lines):
            continue
        line = lines[at][1]
        if _is_comment(line):
            line = line.strip()
            for mark in COMMENTS:
                line = line.removeprefix(mark).strip()
        for separator in SEPARATORS:
            names = [name.strip() for name in next(_split([line], separator), [])]
            if required:
                score = sum(name in names for name in required)
            else:
                fits = len(names) == len(next(_split([below], separator), []))
                score = _count_names(names, line + below, separator) if fits else 0
            if score > best:
                best, found = score, (at, names, separator)
    missing = [name for name in required if name not in found[1]]
    if missing:
        listed = ", ".join(found[1]) or "none"
        raise MalformedFileError(
            path,
            f"has no column '{missing[0]}' (columns: {listed})",
            f"name it in capture.toml; {suggest(missing[0], found[1])}"
            if found[1]
            else "export it with a header",
        )
    repeated = [name for name in required if found[1].count(name) > 1]
    if repeated:
        raise MalformedFileError(path, f"has two columns '{repeated[0]}'", "rename one of them")
    return found


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(COMMENTS)


def _count_names(names: Sequence[str], line: str, separator: str) -> int:
    """Count the names in a header whose names are unknown; they may contain spaces if another separator is used."""
    if separator == " " and any(mark in line for mark in SEPARATORS if mark != " "):
        return 0
    return sum(bool(name) and not _is_number(name) for name in names)


def _is_number(text: str) -> bool:
    try:
        read_number(text)
    except ValueError:
        return False
    return True


def _split(lines: Sequence[str], separator: str) -> Iterator[list[str]]:
    if separator == " ":
        return (line.split() for line in lines)
    return csv.reader(io.StringIO("\n".join(lines)), delimiter=separator, skipinitialspace=True)


def _read_rows(path: Path, lines: list[tuple[int, str]], header: list[str], separator: str) -> LogTable:
    kept: list[tuple[int, list[str]]] = []
    headers = 0
    data = [(number, line) for number, line in lines if not _is_comment(line)]
    comments = len(lines) - len(data)
    split = _split([line for _, line in data], separator)
    for (number, _), fields in zip(data, split, strict=False):
        if [field.strip() for field in fields] == header:
            headers += 1
        elif any(field.strip() for field in fields):
            kept.append((number, fields))
    notes = []
    if comments:
        notes.append(f"{comments} comment line{'s' * (comments > 1)} skipped")
    if headers:
        notes.append(f"{headers} repeated header{'s' * (headers > 1)} skipped")
    if kept and len(kept[-1][1]) < len(header):
        number, fields = kept.pop()
        notes.append(
            f"the last row (line {number}) has {len(fields)} of {len(header)} fields and was dropped"
        )
    for number, fields in kept:
        # Separators may follow the last field. White space does not delimit an empty field, so each field is needed.
        beyond = any(field.strip() for field in fields[len(header) :])
        if beyond or (separator == " " and len(fields) < len(header)):
            raise MalformedFileError(
                path,
                f"row {number} has {len(fields)} fields, the header has {len(header)}",
                "export the log with one name per column",
            )
    return LogTable(
        path=path,
        header=tuple(header),
        rows=[fields for _, fields in kept],
        lines=[number for number, _ in kept],
        notes=tuple(notes),
    )
