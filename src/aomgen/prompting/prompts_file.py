"""Write what a person states about a capture into its capture.toml; every other byte of the file stays as it is."""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import tomlkit
from tomlkit.exceptions import TOMLKitError

from aomgen.capture.capture_schema import PromptSection
from aomgen.errors import InputError
from aomgen.io.atomic import write_text

# Decimals of a coordinate, [px]: a mouse is not more precise.
DECIMALS = 1


def save_prompts(path: Path, prompts: Sequence[PromptSection], stated: Mapping[str, str]) -> None:
    """Replace all `[[prompts]]` tables of a capture.toml by these, and the stated top-level values, atomically.

    Raises:
        InputError: The file is missing or is no TOML.
    """
    try:
        # Not `read_text`, which would turn CRLF line ends into LF.
        text = path.read_bytes().decode("utf-8")
        changed = replace_prompts(text, prompts, stated)
    except FileNotFoundError as error:
        raise InputError(path, "is missing", "give the folder that holds capture.toml") from error
    except (UnicodeDecodeError, TOMLKitError) as error:
        raise InputError(path, f"is not valid TOML ({error})", "correct the line") from error
    write_text(path, changed)


def replace_prompts(text: str, prompts: Sequence[PromptSection], stated: Mapping[str, str]) -> str:
    """Return the text of a capture.toml with other `[[prompts]]` tables, which come last, and other top-level values.

    Raises:
        TOMLKitError: The text is no TOML.

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
    document = tomlkit.parse(text)
    document.pop("prompts", None)
    for key, value in stated.items():
        if document.get(key) != value:
            document[key] = value
    kept = tomlkit.dumps(document).rstrip("\r\n")
    newline = "\r\n" if "\r\n" in text else "\n"
    result = newline.join([kept, *_format(prompts), ""])
    # A guard against a library that moves what it should keep.
    if _without_prompts(result) != _without_prompts(text) | dict(stated):
        raise TOMLKitError("the other tables cannot be kept as they are")
    return result


def _without_prompts(text: str) -> dict[str, object]:
    return {key: value for key, value in tomllib.loads(text).items() if key != "prompts"}


def _format(prompts: Sequence[PromptSection]) -> list[str]:
    lines: list[str] = []
    for prompt in prompts:
        lines += [
            "",
            "[[prompts]]",
            f'part = "{prompt.part}"',
            f"image = {tomlkit.item(prompt.image).as_string()}",
        ]
        if prompt.points:
            rows = ", ".join(f"[{_number(x)}, {_number(y)}, {int(on)}]" for x, y, on in prompt.points)
            lines.append(f"points = [{rows}]")
        if prompt.box is not None:
            lines.append(f"box = [{', '.join(map(_number, prompt.box))}]")
    return lines


def _number(value: float) -> str:
    return str(round(float(value), DECIMALS))
