"""The `[scan]` table of capture.toml, changed line by line, so that everything else stays as it is written."""

import tomllib
from pathlib import Path
from typing import Any

from aomgen.core.recording import Intrinsics
from aomgen.errors import ConfigError, MalformedFileError


def change_scan_table(text: str, images: str, intrinsics: Intrinsics | None, path: Path) -> str:
    """Return the text of a capture.toml with another scan.

    Args:
        text: TOML.
        images: Folder of the scan's images.
        intrinsics: Of the images, None where they are unknown.
        path: Of the file, for errors.

    Raises:
        MalformedFileError: The text is not TOML.
        ConfigError: The table is not written as lines under a header `[scan]`.
    """
    before = _parse(text, path)
    table: dict[str, Any] = {"images": images}
    if intrinsics:
        table["intrinsics"] = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
    lines = text.splitlines(keepends=True)
    start = next((i for i, line in enumerate(lines) if line.split("#")[0].strip() == "[scan]"), None)
    refusal = ConfigError(
        path, "has a [scan] that cannot be changed line by line", "take it out, and import again"
    )
    if start is None and "scan" in before:
        raise refusal
    body = [f'images = "{images}"\n']
    if intrinsics:
        body.append(f"intrinsics = {table['intrinsics']}\n")
    if start is None:
        # Tables may have any order, but lines before the first header belong to the whole file.
        gap = "" if not text or text.endswith("\n\n") else "\n" if text.endswith("\n") else "\n\n"
        changed = f"{text}{gap}[scan]\n{''.join(body)}"
    else:
        end = next((i for i in range(start + 1, len(lines)) if lines[i].startswith("[")), len(lines))
        kept = [line for line in lines[start + 1 : end] if not line.strip() or line.strip().startswith("#")]
        changed = "".join([*lines[: start + 1], *body, *kept, *lines[end:]])
    if _parse(changed, path) != before | {"scan": table}:
        raise refusal
    return changed


def _parse(text: str, path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise MalformedFileError(path, f"is not valid TOML ({error})", "correct that line") from error
