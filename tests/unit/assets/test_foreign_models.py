"""What makers leave out or write otherwise: paths, names, units, masses, handles, shapes; each is read or named."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from aomgen.assets.asset_check import check_asset, held_at_rim, outward_normal
from aomgen.assets.box_cover import box_cover
from aomgen.assets.doctor import examine
from aomgen.assets.handle_search import state_handle
from aomgen.assets.import_model import import_model
from aomgen.assets.usd_read import read_usd
from aomgen.cli.app import app
from aomgen.core.mesh import Mesh
from aomgen.errors import AssetError, MalformedFileError, UnsafePathError

# A door of 40 x 40 cm in a body, with a bar 4 cm in front of it; braces are filled by each test.
DOOR = """<mujoco model="locker">
  <compiler {compiler}/>
  <worldbody>
    <body name="body">
      <geom type="box" size="0.2 0.01 0.2" pos="0 0.39 0.2" {mass}/>
      <geom type="box" size="0.01 0.19 0.2" pos="-0.19 0.2 0.2" {mass}/>
      <body name="door" pos="-0.2 0 0.2">
        <joint {joint} type="hinge" axis="0 0 -1" range="{limits}"/>
        <geom type="box" size="0.2 0.01 0.2" pos="0.2 0 0" {mass}/>
        {handle}
      </body>
    </body>
  </worldbody>
</mujoco>"""
BAR = """<geom type="box" size="0.006 0.006 0.06" pos="0.36 -0.05 0" {mass}/>
         <geom type="box" size="0.006 0.02 0.006" pos="0.36 -0.03 0.05" {mass}/>"""
KNOB = '<geom type="cylinder" size="0.014 0.012" pos="0.36 -0.024 0" euler="90 0 0" {mass}/>'
PLAIN = {
    "compiler": 'angle="radian"',
    "joint": 'name="hinge"',
    "limits": "0 1.6",
    "mass": 'mass="1"',
    "handle": BAR,
}


def write(folder: Path, **changes: str) -> Path:
    values = PLAIN | changes
    values["handle"] = values["handle"].format(mass=values["mass"])
    path = folder / "locker.xml"
    path.write_text(DOOR.format(**values))
    return path


def test_the_plain_door_is_used_as_it_is(tmp_path: Path) -> None:
    asset = import_model(write(tmp_path))
    assert check_asset(asset) == []
    assert asset.notes == ()
    assert len(asset.moving.colliders) == 3
    np.testing.assert_allclose(outward_normal(asset), [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(np.abs(asset.handle_axis), [0, 0, 1], atol=1e-9)
    assert not held_at_rim(asset)


def test_a_joint_without_a_name_is_called_as_its_body(tmp_path: Path) -> None:
    file = write(tmp_path, joint="")
    assert check_asset(import_model(file, joint="door")) == []


def test_radians_read_as_degrees_are_named_with_the_option_that_mends_them(tmp_path: Path) -> None:
    file = write(tmp_path, compiler="", limits="0 1.2")
    (problem,) = check_asset(import_model(file))
    assert "radians read as degrees? Import it with --limits 0 1.2" in problem
    assert check_asset(import_model(file, limits=(0, 1.2))) == []


def test_degrees_read_as_radians_are_named(tmp_path: Path) -> None:
    problems = check_asset(import_model(write(tmp_path, limits="0 90")))
    assert "look like degrees; import it with --limits 0 1.57" in problems[0]


def test_a_joint_without_limits_gets_stated_ones(tmp_path: Path) -> None:
    file = tmp_path / "locker.xml"
    write(tmp_path)
    file.write_text(file.read_text().replace('range="0 1.6"', ""))
    with pytest.raises(AssetError, match=r"--limits 0 1\.57"):
        import_model(file)
    assert import_model(file, limits=(0, 1.5)).joint.upper == pytest.approx(1.5)


@pytest.mark.parametrize("kilograms", ["0.0001", "5000"])
def test_an_absurd_mass_is_replaced_and_said_so(tmp_path: Path, kilograms: str) -> None:
    asset = import_model(write(tmp_path, mass=f'mass="{kilograms}"'))
    for link in (asset.static, asset.moving):
        assert 20 <= link.mass / link.volume <= 4000
    assert len(asset.notes) == 2
    assert "are assumed" in asset.notes[0]
    assert [item.warning for item in examine(asset) if item.name == "assumed"] == list(asset.notes)


def test_a_knob_is_held_from_both_sides(tmp_path: Path) -> None:
    asset = import_model(
        write(tmp_path, compiler='angle="radian" eulerseq="xyz"', handle=KNOB.replace("90 0 0", "1.5708 0 0"))
    )
    assert check_asset(asset) == []
    assert held_at_rim(asset)
    assert asset.handle_point[0] == pytest.approx(0.16, abs=0.02)


def test_a_door_that_is_closed_between_its_limits_opens_to_the_farther_one(tmp_path: Path) -> None:
    file = write(tmp_path)
    shallow = file.read_text().replace('0.19 0.2" pos="-0.19 0.2', '0.09 0.2" pos="-0.19 0.1')
    file.write_text(shallow.replace('pos="0 0.39 0.2"', 'pos="0 0.19 0.2"'))
    expected, asset = import_model(file), import_model(file, limits=(-0.79, 1.6))
    assert check_asset(asset) == []
    assert asset.joint.upper == pytest.approx(1.6)
    np.testing.assert_allclose(asset.joint.axis, expected.joint.axis, atol=1e-9)
    np.testing.assert_allclose(asset.handle_point, expected.handle_point, atol=1e-9)
    with pytest.raises(AssetError, match=r"-1\.57 and 1\.57; state the limits of one direction"):
        import_model(file, limits=(-1.57, 1.57))


def test_a_door_without_a_handle_says_how_to_state_one(tmp_path: Path) -> None:
    file = write(tmp_path, handle="")
    thick = file.read_text().replace(
        'size="0.2 0.01 0.2" pos="0.2 0 0"', 'size="0.2 0.03 0.2" pos="0.2 -0.02 0"'
    )
    file.write_text(thick)
    with pytest.raises(AssetError, match="--handle X0 Y0 Z0 X1 Y1 Z1"):
        import_model(file)


def test_a_stated_handle_is_taken(tmp_path: Path) -> None:
    asset = import_model(write(tmp_path), handle=(0.1, -0.06, 0.1, 0.2, -0.04, 0.3))
    assert check_asset(asset) == []
    with pytest.raises(AssetError, match="no surface of the moving part"):
        import_model(write(tmp_path), handle=(1, 1, 1, 2, 2, 2))
    once = state_handle(asset.moving, np.array([-0.1, -1.0, 0.0]), np.array([0.0, 1.0, 0.4]))
    twice = state_handle(once, np.array([-0.15, -1.0, 0.3]), np.array([-0.1, 1.0, 0.4]))
    assert len(twice.colliders) == len({box.name for box in twice.colliders})


@pytest.mark.parametrize(("name", "handle"), [("bar", (0.1, -0.06, 0.1, 0.2, -0.04, 0.3)), ("handle", ())])
def test_a_pivot_door_opens_toward_its_handle(tmp_path: Path, name: str, handle: tuple[float, ...]) -> None:
    file = write(tmp_path, handle=BAR.replace("<geom", f'<geom name="{name}"', 1))
    text = (
        file.read_text().replace('pos="-0.2 0 0.2"', 'pos="0 0 0.2"').replace('pos="0.2 0 0"', 'pos="0 0 0"')
    )
    file.write_text(text.replace("0.36 ", "0.16 "))
    asset = import_model(file, handle=handle)
    np.testing.assert_allclose(asset.handle_point, [0.16, -0.05, 0.2], atol=0.06)
    np.testing.assert_allclose(outward_normal(asset), [0, -1, 0], atol=1e-9)
    assert check_asset(asset) == []


@pytest.mark.parametrize("scale", [0.01, 6.0])
@pytest.mark.parametrize("handle", [(), (0.1, -0.06, 0.1, 0.2, -0.04, 0.3)])
@pytest.mark.parametrize("slides", [False, True])
def test_a_scaled_file_gives_the_same_asset(
    tmp_path: Path, scale: float, handle: tuple[float, ...], slides: bool
) -> None:
    file = write(tmp_path)
    if slides:
        hinge = 'type="hinge" axis="0 0 -1" range="0 1.6"'
        file.write_text(file.read_text().replace(hinge, 'type="slide" axis="0 -1 0" range="0 0.3"'))
    limits = (0.0, 0.25) if slides else (0.0, 1.5)
    expected = import_model(file, limits=limits, handle=handle)

    def divide(found: re.Match[str]) -> str:
        return f'{found[1]}="{" ".join(repr(float(word) / scale) for word in found[2].split())}"'

    file.write_text(re.sub(r'(size|pos)="([^"]*)"', divide, file.read_text()))
    asset = import_model(
        file,
        scale=scale,
        limits=[value / scale for value in limits] if slides else limits,
        handle=[value / scale for value in handle],
    )
    assert check_asset(asset) == []
    assert asset.joint.upper == pytest.approx(expected.joint.upper)
    np.testing.assert_allclose(asset.joint.origin, expected.joint.origin, atol=1e-9)
    np.testing.assert_allclose(asset.handle_point, expected.handle_point, atol=1e-5 if handle else 1e-9)
    for box, other in zip(asset.moving.colliders, expected.moving.colliders, strict=True):
        assert box.name == other.name
        np.testing.assert_allclose(box.half_extents, other.half_extents, atol=1e-5 if handle else 1e-9)


def test_a_door_that_slides_sideways_faces_the_side_of_its_handle(tmp_path: Path) -> None:
    file = write(tmp_path)
    text = file.read_text().replace(
        'type="hinge" axis="0 0 -1" range="0 1.6"', 'type="slide" axis="1 0 0" range="0 0.3"'
    )
    file.write_text(text)
    asset = import_model(file)
    assert check_asset(asset) == []
    np.testing.assert_allclose(np.abs(asset.joint.axis), [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(outward_normal(asset), [0, -1, 0], atol=1e-9)


URDF = """<robot name="box">
  <link name="body"><visual name="shape"><geometry><mesh filename="{mesh}" scale="0.2 0.2 0.2"/></geometry></visual>
    <collision name="shape"><geometry><mesh filename="{mesh}" scale="0.2 0.2 0.2"/></geometry></collision></link>
  <link name="tray"><visual><geometry><box size="0.3 0.02 0.15"/></geometry></visual>
    <visual name="pull"><origin xyz="0 -0.05 0"/><geometry><box size="0.1 0.01 0.01"/></geometry></visual>
    <visual name="pull"><origin xyz="0.04 -0.03 0"/><geometry><box size="0.01 0.04 0.01"/></geometry></visual></link>
  <joint name="rail" type="prismatic"><parent link="body"/><child link="tray"/><origin xyz="0 -0.22 0.1"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
</robot>"""


def write_package(folder: Path, mesh: str) -> Path:
    """A ROS package `chest` with `urdf/` and `meshes/`."""
    for name in ("urdf", "meshes"):
        (folder / "chest" / name).mkdir(parents=True)
    trimesh.creation.box((2, 2, 1)).export(folder / "chest" / "meshes" / "body.obj")
    path = folder / "chest" / "urdf" / "chest.urdf"
    path.write_text(URDF.format(mesh=mesh))
    return path


@pytest.mark.parametrize("mesh", ["../meshes/body.obj", "package://chest/meshes/body.obj"])
def test_meshes_of_a_package_are_found_above_the_model(tmp_path: Path, mesh: str) -> None:
    asset = import_model(write_package(tmp_path / "deep" / "er", mesh))
    assert check_asset(asset) == []
    # Shapes that share a name keep it: it says which one is the handle.
    assert len(asset.handle_boxes) == 2


def test_meshes_far_above_are_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.obj").write_text("v 0 0 0\n")
    file = write_package(tmp_path / "a" / "b" / "c", "../../../../../secret.obj")
    with pytest.raises(UnsafePathError):
        import_model(file)


def test_flat_collision_meshes_are_read(tmp_path: Path) -> None:
    file = write_package(tmp_path, "../meshes/flat.obj")
    (tmp_path / "chest" / "meshes" / "flat.obj").write_text(
        "v -1 1 0\nv 1 1 0\nv 1 1 1\nv -1 1 1\nf 1 2 3\nf 1 3 4\n"
    )
    assert import_model(file).static.colliders


def test_a_fragment_says_how_to_include_it(tmp_path: Path) -> None:
    file = tmp_path / "chain.xml"
    file.write_text("<mujocoinclude><body/></mujocoinclude>")
    with pytest.raises(MalformedFileError, match="write a file <mujoco> that includes it"):
        import_model(file)


def test_shapes_of_usd_are_seen_and_touched(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom, UsdPhysics

    path = tmp_path / "chest.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/chest")
    stage.SetDefaultPrim(root.GetPrim())

    def shape(kind, name: str, scale: tuple, place: tuple):
        item = kind.Define(stage, name)
        item.AddTranslateOp().Set(Gf.Vec3d(*place))
        item.AddScaleOp().Set(Gf.Vec3f(*scale))
        UsdPhysics.CollisionAPI.Apply(item.GetPrim())
        return item

    for link in ("body", "tray"):
        UsdPhysics.RigidBodyAPI.Apply(UsdGeom.Xform.Define(stage, f"/chest/{link}").GetPrim())
    shape(UsdGeom.Cube, "/chest/body/box", (0.2, 0.2, 0.1), (0, 0, 0.1))
    shape(UsdGeom.Cube, "/chest/tray/front", (0.19, 0.01, 0.09), (0, -0.215, 0.1))
    bar = shape(UsdGeom.Cylinder, "/chest/tray/bar", (1, 1, 1), (0, -0.26, 0.1))
    bar.GetAxisAttr().Set("X")
    bar.GetRadiusAttr().Set(0.006)
    bar.GetHeightAttr().Set(0.12)
    shape(UsdGeom.Cube, "/chest/tray/foot", (0.005, 0.02, 0.005), (0.05, -0.24, 0.1))
    joint = UsdPhysics.PrismaticJoint.Define(stage, "/chest/rail")
    joint.CreateBody0Rel().SetTargets(["/chest/body"])
    joint.CreateBody1Rel().SetTargets(["/chest/tray"])
    joint.CreateAxisAttr("Y")
    joint.CreateLowerLimitAttr(-0.2)
    joint.CreateUpperLimitAttr(0.0)
    stage.GetRootLayer().Save()
    asset = read_usd(path)
    assert check_asset(asset) == []
    assert len(asset.moving.meshes) == 3
    np.testing.assert_allclose(np.abs(asset.handle_axis), [1, 0, 0], atol=1e-6)
    assert asset.joint.upper == pytest.approx(0.2)


def test_several_joints_are_listed_with_size_and_handle(tmp_path: Path) -> None:
    file = write(tmp_path)
    second = (
        DOOR.format(**PLAIN).replace('name="hinge"', 'name="other"').replace('name="body"', 'name="body2"')
    )
    bodies = second.split("<worldbody>")[1].split("</worldbody>")[0].replace('name="door"', 'name="door2"')
    file.write_text(file.read_text().replace("</worldbody>", bodies.replace("{mass}", "") + "</worldbody>"))
    result = CliRunner().invoke(app, ["assets", "check", str(file)])
    lines = result.stdout.splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["hinge", "other"]
    assert "opens by 92 deg" in lines[0]
    assert "bar at" in lines[0]
    assert result.exit_code != 0


def bent(radius: float = 0.1, thickness: float = 0.012) -> Mesh:
    """A closed half ring, as curved handles are."""
    path = np.linspace(0, np.pi, 25)
    section = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * thickness / 2
    rings = [
        np.column_stack(
            [(radius + section[:, 0]) * np.cos(a), (radius + section[:, 0]) * np.sin(a), section[:, 1]]
        )
        for a in path
    ]
    vertices, faces = np.concatenate(rings), [[0, 2, 1], [0, 3, 2]]
    last = 4 * (len(path) - 1)
    faces += [[last, last + 1, last + 2], [last, last + 2, last + 3]]
    for k in range(len(path) - 1):
        for i in range(4):
            a, b = 4 * k + i, 4 * k + (i + 1) % 4
            faces += [[a, b, b + 4], [a, b + 4, a + 4]]
    return import_mesh(vertices, np.array(faces))


def import_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    from aomgen.assets.procedural.shapes import Material

    return Material(color_srgb=(0.5, 0.5, 0.5)).mesh("bow", vertices, faces, np.zeros((0, 3, 2)))


def test_a_curved_handle_leaves_room_for_fingers_and_takes_few_boxes() -> None:
    boxes = box_cover([bent()])
    assert 3 <= len(boxes) <= 20
    assert min(box.distance(np.zeros(3)) for box in boxes) > 0.06
    assert min(box.distance(np.array([0.0, 0.1, 0.0])) for box in boxes) == 0.0
