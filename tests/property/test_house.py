"""The structure of the source: file sizes, import circles, names, reasons of constants, options that are set."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import aomgen

ROOT = Path(aomgen.__file__).parent
REPOSITORY = Path(__file__).parents[2]
FILES = {path: ast.parse(path.read_text("utf-8")) for path in sorted(ROOT.rglob("*.py"))}
LINES = {path: path.read_text("utf-8").splitlines() for path in FILES}
# Names that every package may have.
SHARED_NAMES = {"stage", "__init__", "__main__"}

MAX_FILE_LINES = 350


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


def imports_of(tree: ast.Module, modules: set[str]) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in modules else node.module)
    return found & modules


MODULES = {module_of(path) for path in FILES}
IMPORTS = {module_of(path): imports_of(tree, MODULES) - {module_of(path)} for path, tree in FILES.items()}


def twice(named: dict[str, set[str]]) -> dict[str, set[str]]:
    return {name: places for name, places in named.items() if len(places) > 1}


def is_number(node: ast.expr) -> bool:
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return is_number(node.left) and is_number(node.right)
    if isinstance(node, ast.Tuple | ast.List):
        return bool(node.elts) and all(map(is_number, node.elts))
    if isinstance(node, ast.Dict):
        return bool(node.values) and all(map(is_number, node.values))
    return isinstance(node, ast.Call) and bool(node.args) and all(map(is_number, node.args))


def constants() -> list[tuple[Path, ast.stmt]]:
    """Numeric constants of all modules."""
    found = []
    for path, tree in FILES.items():
        for node in tree.body:
            target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
            value = getattr(node, "value", None)
            named = isinstance(target, ast.Name) and target.id.lstrip("_").isupper()
            if named and value is not None and is_number(value):
                found.append((path, node))
    return found


def has_reason(path: Path, node: ast.stmt) -> bool:
    lines = LINES[path]
    return lines[node.lineno - 2].lstrip().startswith("#") or "#" in lines[(node.end_lineno or 0) - 1]


def test_no_file_is_long():
    counts = {str(path): len(lines) for path, lines in LINES.items()}
    assert {path: count for path, count in counts.items() if count > MAX_FILE_LINES} == {}


def test_modules_import_each_other_in_no_circle():
    left = {module: set(imports) for module, imports in IMPORTS.items()}
    while free := [module for module, imports in left.items() if not imports & left.keys()]:
        for module in free:
            del left[module]
    assert sorted(left) == []


def test_a_name_means_one_thing():
    classes, modules = defaultdict(set), defaultdict(set)
    for path, tree in FILES.items():
        if path.stem not in SHARED_NAMES:
            modules[path.stem].add(module_of(path))
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                classes[node.name].add(module_of(path))
    assert twice(classes) == {}
    assert twice(modules) == {}


def test_constants_have_a_reason():
    found = constants()
    bare = [f"{module_of(path)}:{node.lineno}" for path, node in found if not has_reason(path, node)]
    assert bare == []


def test_each_option_is_set_somewhere():
    fields = [
        field.target.id
        for tree in FILES.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and node.name.endswith("Params")
        for field in node.body
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
    ]
    roots = ("src", "tests", "benchmarks", "synthetic")
    trees = [
        ast.parse(path.read_text("utf-8")) for root in roots for path in (REPOSITORY / root).rglob("*.py")
    ]
    passed = {
        keyword.arg
        for tree in trees
        for call in ast.walk(tree)
        if isinstance(call, ast.Call)
        for keyword in call.keywords
    }
    assert sorted(set(fields) - passed) == []


def test_poses_in_fields_name_their_frames():
    """`T_a_b` and `Ts_a_b` are poses, `S_a_b` similarities: two frames each."""
    wrong = []
    for path, tree in FILES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                name = node.target.id
                if re.match(r"(T|Ts|S)_", name) and not re.fullmatch(r"(T|Ts|S)_[a-z0-9]+_[a-z0-9_]+", name):
                    wrong.append(f"{module_of(path)}: {name}")
    assert wrong == []
