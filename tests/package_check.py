"""The built wheel: its files and size, and its commands in an environment without the checkout and without a compiler.

Run as `python tests/package_check.py FOLDER`, where FOLDER holds the wheel; `make package-test` builds it. The
environment sees the dependencies that the running Python has, but not the checkout.
"""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
SOURCE = REPOSITORY / "src"
# A wheel has 9 MB, most of them the bundled recording, [bytes].
MAX_BYTES = 12 << 20
NOT_PACKED = {"CMakeLists.txt", "__pycache__"}
IMPORT = """
import sys, aomgen
from pathlib import Path
assert Path(aomgen.__file__).is_relative_to(sys.prefix), aomgen.__file__
for name in aomgen.__all__: getattr(aomgen, name)
"""


def list_problems(wheel: Path) -> list[str]:
    """List files that are missing in a wheel, and files that do not belong there."""
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    source = {
        path.relative_to(SOURCE).as_posix()
        for path in (SOURCE / "aomgen").rglob("*")
        if path.is_file() and not NOT_PACKED & set(path.parts) and path.suffix not in (".so", ".new")
    }
    expected = source | {"aomgen/splatting/libaomgen_splatting.so"}
    problems = [f"{name} is missing" for name in sorted(expected - packed)]
    problems += [f"{name} does not belong there" for name in sorted(packed - expected)]
    if not wheel.stat().st_size <= MAX_BYTES:
        problems.append(f"{wheel.stat().st_size} bytes, limit {MAX_BYTES}")
    return problems


def install(wheel: Path, folder: Path) -> Path:
    """Install a wheel in a new environment that sees the packages of this one; return its folder of programs."""
    venv.create(folder, clear=True, with_pip=True)
    programs = folder / "bin"
    paths = {"base": str(folder), "platbase": str(folder)}
    shared = Path(sysconfig.get_path("purelib", vars=paths)) / "shared.pth"
    # The checkout is not seen: lines of a .pth file add folders, without reading the .pth files in these.
    shared.write_text(sysconfig.get_path("purelib") + "\n")
    subprocess.run(
        [programs / "pip", "install", "-q", "--no-deps", "--no-index", "--ignore-installed", wheel],
        check=True,
    )
    return programs


def main(folder: Path) -> None:
    wheels = list(folder.glob("aomgen-*.whl"))
    if len(wheels) != 1:
        sys.exit(f"{folder} holds {len(wheels)} wheels, expected 1")
    problems = list_problems(wheels[0])
    if problems:
        sys.exit("\n".join(f"{wheels[0].name}: {problem}" for problem in problems))
    programs = install(wheels[0].resolve(), folder.resolve() / "environment")
    elsewhere = folder.resolve() / "elsewhere"
    elsewhere.mkdir(exist_ok=True)
    environment = {"PATH": str(programs), "HOME": os.environ["HOME"]}
    for command in (
        ["aomgen", "--version"],
        ["aomgen", "doctor"],
        ["python", "-c", IMPORT],
        ["aomgen", "assets", "make", "microwave", "microwave.usda", "--seed", "1"],
        ["aomgen", "assets", "check", "microwave.usda"],
    ):
        program = programs / command[0]
        subprocess.run([program, *command[1:]], cwd=elsewhere, env=environment, check=True)
    print(f"{wheels[0].name}: {wheels[0].stat().st_size / 1e6:.1f} MB, ok")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
