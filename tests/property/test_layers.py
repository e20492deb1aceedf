"""The order of imports is the architecture: every import goes down, stages never import each other."""

import ast
from pathlib import Path

import pytest

import aomgen

ROOT = Path(aomgen.__file__).parent
REPOSITORY = Path(__file__).parents[2]
# Packages beside the product, and the folders whose code may import each: the product and its tests import neither.
LABORATORY = {
    "synthetic": ("synthetic", "benchmarks", "examples", "tests/unit/synthetic", "tests/unit/benchmarks"),
    "benchmarks": ("benchmarks", "tests/unit/synthetic", "tests/unit/benchmarks"),
}
STAGES = {
    "capture",
    "structure",
    "gaussians",
    "alignment",
    "parts",
    "motion",
    "appearance",
    "replacement",
    "episodes",
    "datasets",
}
LAYERS = [
    {"conventions", "errors"},
    {"core"},
    {"io"},
    {"assets"},
    {"splatting"},
    {"robots"},
    {"simulation", "segmentation"},
    {"twin"},
    {"capture"},
    {"results", "executors"},
    {"saved_units"},
    STAGES - {"capture"},
    {"paper"},
    {"pipeline"},
    {"report", "evaluation"},
    {"cli"},
]
LEVEL = {name: level for level, layer in enumerate(LAYERS) for name in layer}


def _imports(path: Path) -> set[str]:
    tree = ast.parse(path.read_text("utf-8"))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("aomgen."):
            names.add(node.module.split(".")[1])
        elif isinstance(node, ast.Import):
            names |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("aomgen.")}
    return names


def _owner(path: Path) -> str:
    return path.relative_to(ROOT).with_suffix("").parts[0]


def test_imports_go_down():
    wrong = []
    for path in sorted(ROOT.rglob("*.py")):
        owner = _owner(path)
        if owner in ("__init__", "samples"):
            continue
        for name in _imports(path):
            if name == owner:
                continue
            if not LEVEL[name] < LEVEL[owner]:
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    assert wrong == []


def _roots(path: Path) -> set[str]:
    """First names of all modules that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add((node.module or "").split(".")[0])
        elif isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
    return names


@pytest.mark.parametrize("package", LABORATORY)
def test_product_and_its_tests_do_not_import_the_laboratory(package):
    allowed = [REPOSITORY / folder for folder in LABORATORY[package]]
    files = [
        path
        for folder in ("src", "benchmarks", "synthetic", "examples", "plugins", "recipes", "tests")
        for path in (REPOSITORY / folder).rglob("*.py")
        if not any(path.is_relative_to(folder) for folder in allowed)
    ]
    assert len(files) > 300
    assert [str(path.relative_to(REPOSITORY)) for path in files if package in _roots(path)] == []


def test_heavy_libraries_stay_out_of_the_light_path():
    """Workers and the command line start without torch and pycolmap."""
    for folder in (
        "core",
        "io",
        "robots",
        "simulation",
        "assets",
        "twin",
        "motion",
        "episodes",
        "datasets",
    ):
        for path in (ROOT / folder).rglob("*.py"):
            assert not _roots(path) & {"torch", "pycolmap"}, path
