"""Report the size of the source against the last release, and refuse long files and import circles."""

import ast
import subprocess
import sys
import tarfile
from collections.abc import Collection, Mapping
from io import BytesIO
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = "src/aomgen"
# One idea a file: what is longer holds two.
MAX_FILE_LINES = 350


def main() -> None:
    files = {
        path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in (ROOT / PACKAGE).rglob("*.py")
    }
    release = read_release()
    before = measure(release) if release else {}
    for name, count in measure(files).items():
        change = f"  ({count - before[name]:+d} since the last release)" if before else ""
        print(f"{name:12} {count:6d}{change}")
    problems = [
        f"{name}: {text.count(chr(10))} lines, limit {MAX_FILE_LINES}"
        for name, text in files.items()
        if text.count("\n") > MAX_FILE_LINES
    ]
    circle = find_circle(files)
    if circle:
        problems.append(f"modules import each other in a circle: {', '.join(circle)}")
    sys.exit("\n".join(problems) or 0)


def measure(files: Mapping[str, str]) -> dict[str, int]:
    """Count lines, files, classes and functions."""
    nodes = [node for text in files.values() for node in ast.walk(ast.parse(text))]
    return {
        "lines": sum(text.count("\n") for text in files.values()),
        "files": len(files),
        "classes": sum(isinstance(node, ast.ClassDef) for node in nodes),
        "functions": sum(isinstance(node, ast.FunctionDef) for node in nodes),
    }


def read_release() -> dict[str, str]:
    """Read the source at the last tag; nothing before the first one."""
    tag = subprocess.run(
        ["git", "describe", "--tags", "--abbrev=0"], cwd=ROOT, capture_output=True, text=True
    )
    if tag.returncode != 0:
        return {}
    command = ["git", "archive", tag.stdout.strip(), PACKAGE]
    archive = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout
    with tarfile.open(fileobj=BytesIO(archive)) as tar:
        members = [member for member in tar.getmembers() if member.name.endswith(".py")]
        return {member.name: tar.extractfile(member).read().decode() for member in members}  # type: ignore[union-attr]


def find_circle(files: Mapping[str, str]) -> list[str]:
    """Find modules that import each other, also inside functions; empty when there are none."""
    trees = {
        name[len("src/") : -len(".py")].replace("/", ".").removesuffix(".__init__"): ast.parse(text)
        for name, text in files.items()
    }
    left = {name: find_imports(tree, trees.keys()) - {name} for name, tree in trees.items()}
    while free := [name for name, imports in left.items() if not imports & left.keys()]:
        for name in free:
            del left[name]
    return sorted(left)


def find_imports(tree: ast.Module, modules: Collection[str]) -> set[str]:
    """Find the modules that a module imports."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in modules else node.module for name in whole}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name in modules}


if __name__ == "__main__":
    main()
