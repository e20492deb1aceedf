"""Every Python file that the documentation names exists."""

import re
from pathlib import Path

import aomgen

REPOSITORY = Path(__file__).parents[2]
PACKAGE = Path(aomgen.__file__).parent
NAMED = re.compile(r"`([\w./-]+\.py)`")


def exists(name: str, document: Path) -> bool:
    """A path from the repository, the package, or the end of one: `panel.py`, `parts/panel.py`."""
    roots = (PACKAGE, *(REPOSITORY / name for name in ("benchmarks", "synthetic", "tests", "examples")))
    found = any(
        path.as_posix().endswith("/" + name) for root in roots for path in root.rglob(Path(name).name)
    )
    return found or (REPOSITORY / name).exists() or (document.parent / name).exists()


def test_named_files_exist():
    documents = [
        REPOSITORY / "README.md",
        REPOSITORY / "CONTRIBUTING.md",
        *(REPOSITORY / "docs").glob("*.md"),
    ]
    missing = [
        f"{document.name}: {name}"
        for document in documents
        for name in NAMED.findall(document.read_text("utf-8"))
        if not exists(name, document)
    ]
    assert missing == []
