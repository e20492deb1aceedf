"""Robot descriptions name files; none of them may lie outside, be missing, huge or hostile."""

import struct

import pytest

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError, UnsafePathError
from aomgen.io import mujoco_model
from aomgen.io.mujoco_model import read_robot_xml

URDF = '<robot name="r"><link name="a">{}</link></robot>'
MESH = '<visual><geometry><mesh filename="{}"/></geometry></visual>'


def stl(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = (0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0)
    path.write_bytes(b"\0" * 80 + struct.pack("<I", 1) + struct.pack("<12f", *corners) + b"\0\0")
    return path


def write(folder, text, name="robot.urdf"):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "name", ["../meshes/a.stl", "package://arm/meshes/a.stl", "package://other/arm/meshes/a.stl"]
)
def test_meshes_are_found_beside_the_file_and_in_packages(tmp_path, name):
    mesh = stl(tmp_path / "arm/meshes/a.stl")
    path = write(tmp_path / "arm/urdf", URDF.format(MESH.format(name)))
    assert read_robot_xml(path, tmp_path).references == (mesh.resolve(),)


def test_meshes_of_one_name_in_two_folders_stay_two(tmp_path):
    stl(tmp_path / "one/a.stl"), stl(tmp_path / "two/a.stl")
    text = URDF.format(MESH.format("one/a.stl") + MESH.format("two/a.stl") + MESH.format("one/a.stl"))
    assert len(read_robot_xml(write(tmp_path, text), tmp_path).meshes) == 2


def test_includes_and_their_meshes_are_found(tmp_path):
    stl(tmp_path / "assets/a.stl")
    write(tmp_path, '<mujoco><asset><mesh name="a" file="a.stl"/></asset></mujoco>', "parts.xml")
    text = '<mujoco><compiler meshdir="assets"/><include file="parts.xml"/></mujoco>'
    found = read_robot_xml(write(tmp_path, text, "robot.xml"), tmp_path).references
    assert {file.name for file in found} == {"parts.xml", "a.stl"}


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("../outside.stl", UnsafePathError),
        ("/etc/passwd", UnsafePathError),
        ("http://host/a.stl", UnsafePathError),
        ("package://../../outside.stl", UnsafePathError),
        ("absent.stl", MissingFileError),
    ],
)
def test_references_stay_inside(tmp_path, name, error):
    stl(tmp_path / "outside.stl")
    with pytest.raises(error):
        read_robot_xml(write(tmp_path / "capture", URDF.format(MESH.format(name))), tmp_path / "capture")


def test_links_do_not_lead_out(tmp_path):
    outside = stl(tmp_path / "outside.stl")
    folder = tmp_path / "capture"
    path = write(folder, URDF.format(MESH.format("a.stl")))
    (folder / "a.stl").symlink_to(outside)
    with pytest.raises(UnsafePathError):
        read_robot_xml(path, folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "not XML"),
        ("<sdf/>", "'sdf' file"),
        ('<!DOCTYPE r [<!ENTITY a "b">]><robot name="r">&a;</robot>', "document type"),
        ('<robot xmlns:xacro="x"><xacro:macro name="m"/></robot>', "xacro"),
        ('<mujoco><asset><model name="m" file="other.xml"/></asset></mujoco>', "attaches"),
        (URDF.format(MESH.format("a.dae")), "mesh format"),
    ],
)
def test_files_of_another_kind_are_refused(tmp_path, text, message):
    (tmp_path / "a.dae").write_text("")
    with pytest.raises(MalformedFileError, match=message):
        read_robot_xml(write(tmp_path, text), tmp_path)


def test_sizes_and_circles_of_includes_are_bounded(tmp_path, monkeypatch):
    circle = write(tmp_path, '<mujoco><include file="robot.xml"/></mujoco>', "robot.xml")
    assert read_robot_xml(circle, tmp_path).references == ()
    monkeypatch.setattr(mujoco_model, "MAX_INCLUDES", 2)
    for number in range(3):
        write(tmp_path, f'<mujoco><include file="part{number + 1}.xml"/></mujoco>', f"part{number}.xml")
    write(tmp_path, "<mujoco/>", "part3.xml")
    with pytest.raises(LimitExceededError):
        read_robot_xml(tmp_path / "part0.xml", tmp_path)
    monkeypatch.setattr(mujoco_model, "MAX_BYTES", 10)
    with pytest.raises(LimitExceededError):
        read_robot_xml(circle, tmp_path)


def test_an_absent_file_is_named(tmp_path):
    with pytest.raises(MissingFileError, match=r"robot\.urdf"):
        read_robot_xml(tmp_path / "robot.urdf", tmp_path)
