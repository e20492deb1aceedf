"""Names say what they stand for: poses name their frames."""

import ast
import re
from pathlib import Path

import aomgen

ROOT = Path(aomgen.__file__).parent


def test_poses_in_fields_name_their_frames() -> None:
    """`T_a_b` and `Ts_a_b` are poses, `S_a_b` similarities: two frames each."""
    wrong = []
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                name = node.target.id
                if re.match(r"(T|Ts|S)_", name) and not re.fullmatch(r"(T|Ts|S)_[a-z0-9]+_[a-z0-9_]+", name):
                    wrong.append(f"{path.name}: {name}")
    assert wrong == []
