"""Write prompts and other statements of a person into a capture.toml; all other bytes of the file remain unchanged."""

from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path

import tomlkit
from tomlkit.exceptions import TOMLKitError

from aomgen.capture.capture_schema import PromptSection
from aomgen.capture.manifest_text import parse_manifest_text, read_manifest_text, split_tables
from aomgen.errors import MalformedFileError
from aomgen.io.atomic import write_text
from aomgen.io.schema import format_toml_value

# Decimals of a coordinate in pixels; a mouse is not more precise.
DECIMALS = 1


def save_prompts(path: Path, prompts: Sequence[PromptSection], stated: Mapping[str, str]) -> None:
    """Replace all `[[prompts]]` tables and the stated top-level values of a capture.toml, atomically.

    Raises:
        MissingFileError, MalformedFileError: The file is missing or not valid TOML.
    """
    text = read_manifest_text(path)
    try:
        changed = replace_prompts(text, prompts, stated)
    except TOMLKitError as error:
        raise MalformedFileError(path, f"is not valid TOML ({error})", "correct that line") from error
    # Guards against changes of other tables by the TOML library.
    kept, before = (parse_manifest_text(item, path, without=["prompts"]) for item in (changed, text))
    if kept != before | dict(stated):
        raise MalformedFileError(
            path, "has tables that cannot be preserved", "change their order in an editor"
        )
    write_text(path, changed)


def replace_prompts(text: str, prompts: Sequence[PromptSection], stated: Mapping[str, str]) -> str:
    """Return the text of a capture.toml with other `[[prompts]]` tables, which come last, and other top-level values.

    Raises:
        TOMLKitError: The text is not valid TOML.

    Example:
        >>> print(replace_prompts('format = 1', [PromptSection(part="moving", image="0.jpg", box=[1, 2, 30, 40])], {}))
        format = 1
        <BLANKLINE>
        [[prompts]]
        part = "moving"
        image = "0.jpg"
        box = [1.0, 2.0, 30.0, 40.0]
        <BLANKLINE>
    """
    mark = "\ufeff" if text.startswith("\ufeff") else ""
    blocks = split_tables(text.removeprefix(mark))
    document = tomlkit.parse(
        "".join(_comments_above(block) if name == "prompts" else block for name, block in blocks)
    )
    document.pop("prompts", None)  # prompts that are written as one value
    for key, value in stated.items():
        if document.get(key) != value:
            document[key] = value
    kept = mark + tomlkit.dumps(document).rstrip("\r\n")
    newline = "\r\n" if "\r\n" in text else "\n"
    return newline.join([kept, *_format(prompts), ""])


def _comments_above(block: str) -> str:
    """Return the lines of a table above its header."""
    lines = block.splitlines(keepends=True)
    return "".join(takewhile(lambda line: line.lstrip().startswith("#"), lines))


def _format(prompts: Sequence[PromptSection]) -> list[str]:
    lines: list[str] = []
    for prompt in prompts:
        lines += [
            "",
            "[[prompts]]",
            f'part = "{prompt.part}"',
            f"image = {format_toml_value(prompt.image)}",
        ]
        if prompt.points:
            rows = ", ".join(f"[{_number(x)}, {_number(y)}, {int(on)}]" for x, y, on in prompt.points)
            lines.append(f"points = [{rows}]")
        if prompt.box is not None:
            lines.append(f"box = [{', '.join(map(_number, prompt.box))}]")
        if prompt.proposed and prompt.confidence is not None:
            lines += ["proposed = true", f"confidence = {prompt.confidence:.2f}"]
    return lines


def _number(value: float) -> str:
    return str(round(float(value), DECIMALS))
