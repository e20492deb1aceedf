"""The product and its tests import neither the benchmarks nor the synthetic captures."""

import ast
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
# Packages beside the product, and the folders whose code may import each.
LABORATORY = {
    "synthetic": ("synthetic", "benchmarks", "tests/unit/synthetic", "tests/unit/benchmarks"),
    "benchmarks": ("benchmarks", "tests/unit/synthetic", "tests/unit/benchmarks"),
}


def find_packages(path: Path) -> set[str]:
    """Return the first names of all modules that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add((node.module or "").split(".")[0])
        elif isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
    return names


@pytest.mark.parametrize("package", LABORATORY)
def test_product_and_its_tests_do_not_import_the_laboratory(package: str) -> None:
    allowed = [REPOSITORY / folder for folder in LABORATORY[package]]
    files = [
        path
        for folder in ("src", "benchmarks", "synthetic", "examples", "plugins", "recipes", "tests")
        for path in (REPOSITORY / folder).rglob("*.py")
        if not any(path.is_relative_to(folder) for folder in allowed)
    ]
    assert len(files) > 300
    assert [str(path.relative_to(REPOSITORY)) for path in files if package in find_packages(path)] == []
