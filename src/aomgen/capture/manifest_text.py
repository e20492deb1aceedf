"""The text of a capture.toml as its tables, for changes that leave all other bytes as they are."""

import re
import tomllib
from collections.abc import Collection
from pathlib import Path
from typing import Any, Final

from aomgen.errors import MalformedFileError, MissingFileError

# Value of what an import cannot know and a person has to state.
PLACEHOLDER: Final = "TODO"
# A line that begins a table or an element of an array of tables, and its name.
_HEADER: Final = re.compile(r"\s*\[\[?\s*([A-Za-z0-9_\-\"'][A-Za-z0-9_.\-\"' ]*?)\s*\]\]?\s*(#.*)?$")


def read_manifest_text(path: Path) -> str:
    """Read the UTF-8 text of a capture.toml with its line ends as they are.

    Raises:
        MissingFileError: There is no such file.
        MalformedFileError: It is not UTF-8.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "give the folder that holds capture.toml")
    try:
        return path.read_bytes().decode()
    except UnicodeDecodeError as error:
        raise MalformedFileError(path, f"is not UTF-8 text ({error})", "save it as UTF-8") from error


def parse_manifest_text(text: str, path: Path, *, without: Collection[str] = ()) -> dict[str, Any]:
    """Return the top-level keys of a capture.toml and their values, without some of them.

    A change has left the others alone if they are equal before and after it.

    Raises:
        MalformedFileError: The text is not TOML.
    """
    try:
        content = tomllib.loads(text.removeprefix("\ufeff"))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise MalformedFileError(path, f"is not valid TOML ({error})", "correct that line") from error
    return {key: value for key, value in content.items() if key not in without}


def split_tables(text: str) -> list[tuple[str, str]]:
    """Split a capture.toml into name and text of each table; comments directly above a header belong to it.

    The first name is "", of the lines before the first header. A line within a value that looks like a header splits
    its table as well, so what is joined again has to be compared by `parse_manifest_text`.

    Example:
        >>> split_tables('format = 1\\n# images\\n[scan]\\nimages = "scan"\\n')
        [('', 'format = 1\\n# images\\n'), ('scan', '[scan]\\nimages = "scan"\\n')]
    """
    blocks: list[tuple[str, list[str]]] = [("", [])]
    for line in text.splitlines(keepends=True):
        found = _HEADER.match(line)
        if not found:
            blocks[-1][1].append(line)
            continue
        previous, above = blocks[-1][1], []
        while previous and previous[-1].lstrip().startswith("#"):
            above.insert(0, previous.pop())
        if previous and previous[-1].strip():  # the comments follow a key, not an empty line
            previous.extend(above)
            above = []
        blocks.append((re.sub(r"[\"' ]", "", found[1]), [*above, line]))
    return [(header, "".join(lines)) for header, lines in blocks]
