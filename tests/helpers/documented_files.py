"""The files that commands of the documentation name and that a user has: a capture, a project, models of other programs."""

import shutil
from pathlib import Path

from aomgen.assets.choice import make_asset
from aomgen.assets.usd_write import write_usd
from aomgen.cli.run import sample_capture
from small_robot import urdf_text

# A cupboard 40 cm wide: a door with a bar, and below it a drawer with a bar. Braces are filled for each file.
CUPBOARD = """<mujoco model="cupboard">
  <compiler angle="radian"/>
  <worldbody>
    <body name="body" pos="0 0 0.3">
      <geom type="box" size="0.2 0.01 0.3" pos="0 0.19 0"/>
      <geom type="box" size="0.01 0.18 0.3" pos="-0.19 0 0"/>
      <body name="door" pos="-0.2 -0.2 0.1">
        <joint name="hinge" type="hinge" axis="0 0 -1" {limits}/>
        <geom type="box" size="0.195 0.01 0.19" pos="0.2 0 0" mass="2"/>
        <geom name="handle" type="box" size="0.006 0.006 0.06" pos="0.36 -0.05 0" mass="0.1"/>
        <geom name="foot" type="box" size="0.006 0.02 0.006" pos="0.36 -0.03 0.05" mass="0.1"/>
      </body>
      {drawer}
    </body>
  </worldbody>
</mujoco>
"""
DRAWER = """<body name="drawer" pos="0 0 -0.2">
        <joint name="top_level" type="slide" axis="0 -1 0" range="0 0.25"/>
        <geom type="box" size="0.17 0.15 0.06" mass="1"/>
        <geom name="knob" type="box" size="0.05 0.006 0.006" pos="0 -0.19 0" mass="0.1"/>
        <geom name="stem" type="box" size="0.006 0.02 0.006" pos="0.044 -0.17 0" mass="0.1"/>
      </body>"""
# A chest of 50 cm with one drawer, whose bar has no name that identifies it.
DESK = """<robot name="desk">
  <link name="body"><inertial><mass value="9"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    {shape_body}</link>
  <link name="front"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    {shape_front}</link>
  <joint name="drawer" type="prismatic"><parent link="body"/><child link="front"/><origin xyz="0 -0.26 0.45"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
</robot>
"""
# Number of photos of a scan, which is the smallest that a capture may have.
PHOTOS = 12
BOX = '<{kind}><origin xyz="{xyz}"/><geometry><box size="{size}"/></geometry></{kind}>'


def write_files(folder: Path) -> None:
    """Write the files; the project is that of the finished run in `out`."""
    (folder / "my_capture").symlink_to(sample_capture())
    project = (folder / "out" / "project.toml").read_text("utf-8")
    (folder / "project.toml").write_text(project.replace('\nout = "."', '\nout = "out"'), "utf-8")
    (folder / "photos").mkdir()
    for photo in sorted((sample_capture() / "scan").glob("*.jpg"))[:PHOTOS]:
        shutil.copy(photo, folder / "photos")
    (folder / "robot").mkdir()
    (folder / "robot" / "arm.urdf").write_text(urdf_text(), "utf-8")
    write_usd(make_asset("microwave", 22), folder / "other.usda")
    # A file of any USD format may have the suffix .usd.
    shutil.copy(folder / "other.usda", folder / "my_microwave.usd")
    limits = 'range="0 1.6"'
    (folder / "cabinet.xml").write_text(CUPBOARD.format(limits=limits, drawer=DRAWER), "utf-8")
    (folder / "fridge.xml").write_text(CUPBOARD.format(limits=limits, drawer=""), "utf-8")
    (folder / "door.xml").write_text(CUPBOARD.format(limits="", drawer=""), "utf-8")
    body = _shape(("0 0 0.25", "0.5 0.5 0.5"))
    front = _shape(
        ("0 0 0", "0.4 0.02 0.08"), ("0 -0.05 0", "0.12 0.012 0.012"), ("0.05 -0.025 0", "0.01 0.05 0.01")
    )
    (folder / "desk.urdf").write_text(DESK.format(shape_body=body, shape_front=front), "utf-8")


def _shape(*boxes: tuple[str, str]) -> str:
    """Describe boxes, each given by its center and its size, as visual and collision shapes."""
    return "".join(
        BOX.format(kind=kind, xyz=xyz, size=size) for xyz, size in boxes for kind in ("visual", "collision")
    )
