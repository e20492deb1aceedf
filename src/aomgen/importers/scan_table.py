"""The `[scan]` table of a capture.toml, derived from an imported scan."""

from pathlib import Path
from typing import Any

from aomgen.capture.manifest_text import parse_manifest_text, split_tables
from aomgen.core.recording import Intrinsics
from aomgen.errors import ConfigError
from aomgen.io.schema import format_toml_value


def change_scan_table(text: str, images: str, intrinsics: Intrinsics | None, path: Path) -> str:
    """Return the text of a capture.toml with another scan; comments of the table are kept.

    Args:
        text: TOML.
        images: Folder of the scan's images.
        intrinsics: Intrinsics of the images; None if unknown.
        path: Path of the file, for errors.

    Raises:
        MalformedFileError: The text is not TOML.
        ConfigError: The table is not written as lines under a header `[scan]`.
    """
    before = parse_manifest_text(text, path)
    table: dict[str, Any] = {"images": images}
    if intrinsics:
        table["intrinsics"] = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
    lines = [f"{key} = {format_toml_value(value)}\n" for key, value in table.items()]
    if "scan" in before:
        changed = "".join(
            _replace_keys(block, lines) if name == "scan" else block for name, block in split_tables(text)
        )
    else:
        # Tables may have any order, but lines before the first header are top-level keys.
        gap = "" if not text or text.endswith("\n\n") else "\n" if text.endswith("\n") else "\n\n"
        changed = f"{text}{gap}[scan]\n{''.join(lines)}"
    if parse_manifest_text(changed, path) != before | {"scan": table}:
        raise ConfigError(
            path, "has a [scan] that cannot be changed line by line", "remove it, and import again"
        )
    return changed


def _replace_keys(block: str, keys: list[str]) -> str:
    """Replace all keys of a table; its header, comments and empty lines are kept."""
    lines = block.splitlines(keepends=True)
    header = next(number for number, line in enumerate(lines) if line.lstrip().startswith("["))
    kept = [line for line in lines[header + 1 :] if not line.strip() or line.strip().startswith("#")]
    return "".join([*lines[: header + 1], *keys, *kept])
