"""Stand-ins for openpi and OpenVLA, which cannot be installed here: importable modules that only define their names.

`tests/unit/recipes/interfaces.json` says what their classes, functions and scripts take. A recipe that uses a name that is
not there fails as it would with the real library. Commands are recorded by programs that stand in for those they start.
"""

import json
import os
import subprocess
from pathlib import Path
from typing import Any, Final

REPOSITORY: Final = Path(__file__).parents[2]
RECIPES: Final = REPOSITORY / "recipes"
INTERFACES: Final = json.loads((REPOSITORY / "tests/unit/recipes/interfaces.json").read_text("utf-8"))
# Functions that are called while a recipe's configuration is created.
BODIES: Final = {
    "create_base_config": "return DataConfig(repo_id=self.repo_id)",
    "get_freeze_filter": "return ('all but LoRA of', self)",
    "__call__": "return ('model transforms of', model_config)",
    "make_bool_mask": "return tuple(dim > 0 for dim in dims for _ in range(abs(dim)))",
}


def write_stand_ins(folder: Path, library: str) -> None:
    """Write the modules of a library; all fields of its classes are optional."""
    for name, content in INTERFACES[library]["modules"].items():
        lines = ["from dataclasses import dataclass", "from enum import IntEnum", "from typing import Any"]
        for kind, fields in content.get("classes", {}).items():
            lines += ["@dataclass(frozen=True)", f"class {kind}:", "    pass"]
            lines += [f"    {field}: Any = None" for field in fields]
            for method, arguments in content.get("methods", {}).get(kind, {}).items():
                lines += _function(method, ["self", *arguments], indent=4)
        for function, arguments in content.get("functions", {}).items():
            lines += _function(function, arguments, indent=0)
        for kind, members in content.get("enums", {}).items():
            lines += [
                f"class {kind}(IntEnum):",
                *(f"    {member} = {value}" for member, value in members.items()),
            ]
        lines += [f"{constant} = {value!r}" for constant, value in content.get("constants", {}).items()]
        path = folder / f"{name.replace('.', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines), "utf-8")


def _function(name: str, arguments: list[str], indent: int) -> list[str]:
    pad = " " * indent
    return [f"{pad}def {name}({', '.join(arguments)}):", f"{pad}    {BODIES.get(name, 'return None')}"]


def record_commands(
    recipe: str, arguments: list[str], tool: str, folder: Path, **environment: str
) -> list[list[str]]:
    """Record the arguments of each program that a shell script starts."""
    stand_in, record = folder / "bin" / tool, folder / "record"
    stand_in.parent.mkdir(exist_ok=True)
    stand_in.write_text(f"#!/bin/sh\nprintf '%s\\n' \"$@\" '' >> '{record}'\n", "utf-8")
    stand_in.chmod(0o755)
    path = f"{stand_in.parent}{os.pathsep}{os.environ['PATH']}"
    command = ["sh", str(RECIPES / recipe), *arguments]
    subprocess.run(command, check=True, cwd=folder, env={**os.environ, "PATH": path, **environment})
    return [call.split("\n") for call in record.read_text("utf-8").removesuffix("\n\n").split("\n\n")]


def flags_of(words: list[str]) -> dict[str, str]:
    """Parse `--name value` and `--name=value` of a command."""
    result: dict[str, str] = {}
    for place, word in enumerate(words):
        if word.startswith("--"):
            name, equals, value = word.partition("=")
            result[name] = value if equals else words[place + 1]
    return result


def stated_commands(text: str, script: str) -> list[list[str]]:
    """List the commands of a document that run a script, with continued lines joined."""
    lines = text.replace("\\\n", " ").splitlines()
    return [line.split() for line in lines if script in line and "--" in line]


def constants_by_words(words: list[str]) -> dict[str, Any]:
    """Return the constants that OpenVLA-OFT selects for a command line."""
    platforms, line = INTERFACES["openvla_oft"]["platforms"], " ".join(words).lower()
    found = next((word for word in platforms["words"] if word in line), platforms["words"][0])
    return platforms[f"{found.upper()}_CONSTANTS"]
