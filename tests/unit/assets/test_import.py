"""Models of other formats become assets that stand closed, hold a handle and say who made them."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from aomgen.assets.asset_check import check_asset
from aomgen.assets.doctor import examine
from aomgen.assets.import_model import import_model
from aomgen.assets.mjcf_model import read_mjcf_model
from aomgen.assets.normalization import clear_path, close
from aomgen.assets.usd_read import read_usd
from aomgen.assets.usd_write import write_usd
from aomgen.cli.app import app
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import (
    AomgenError,
    AssetError,
    ConfigError,
    MalformedFileError,
    MissingFileError,
    SeveralJointsError,
    UnsafePathError,
)

SHARED = Path(__file__).parents[4] / "shared" / "data"

# A cupboard 40 cm wide with one door, drawn open by half a turn of its range, and a drawer below it.
MJCF = """<mujoco model="cupboard">
  <compiler angle="radian"/>
  <worldbody>
    <body name="body" pos="0 0 0.3">
      <geom type="box" size="0.2 0.01 0.3" pos="0 0.19 0"/>
      <geom type="box" size="0.01 0.18 0.3" pos="-0.19 0 0"/>
      <geom type="box" size="0.01 0.18 0.3" pos="0.19 0 0"/>
      <body name="door" pos="-0.2 -0.2 0.1">
        <joint name="hinge" type="hinge" axis="0 0 1" range="-1.8 0"/>
        <geom type="box" size="0.195 0.01 0.19" pos="0.2 0 0" mass="2"/>
        <geom name="handle" type="box" size="0.006 0.006 0.06" pos="0.36 -0.05 0" mass="0.1"/>
        <geom name="foot" type="box" size="0.006 0.02 0.006" pos="0.36 -0.03 0.05" mass="0.1"/>
      </body>
      <body name="drawer" pos="0 0 -0.2">
        <joint name="slide" type="slide" axis="0 -1 0" range="0 0.25"/>
        <geom type="box" size="0.17 0.15 0.06" mass="1"/>
        <geom name="knob" type="box" size="0.05 0.006 0.006" pos="0 -0.19 0" mass="0.1"/>
        <geom name="stem" type="box" size="0.006 0.02 0.006" pos="0.044 -0.17 0" mass="0.1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
URDF = """<robot name="chest">
  <link name="box"><inertial><mass value="3"/><origin xyz="0 0 0.1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 0.1"/><geometry><box size="0.4 0.3 0.2"/></geometry>
      <material name="red"><color rgba="0.8 0.1 0.1 1"/></material></visual>
    <collision><origin xyz="0 0 0.1"/><geometry><box size="0.4 0.3 0.2"/></geometry></collision></link>
  <link name="drawer"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual><geometry><box size="0.3 0.02 0.1"/></geometry></visual>
    <collision><geometry><box size="0.3 0.02 0.1"/></geometry></collision>
    <visual name="handle"><origin xyz="0 -0.05 0"/><geometry><box size="0.1 0.01 0.01"/></geometry></visual>
    <collision><origin xyz="0 -0.05 0"/><geometry><box size="0.1 0.01 0.01"/></geometry></collision></link>
  <joint name="rail" type="prismatic"><parent link="box"/><child link="drawer"/><origin xyz="0 -0.165 0.1"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
</robot>
"""


def box_obj(name: str, low: tuple[float, ...], high: tuple[float, ...], material: str, first: int) -> str:
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    lines = [f"o {name}", *(f"v {x} {y} {z}" for x, y, z in corners), f"usemtl {material}"]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return "\n".join(
        [*lines, *("f " + " ".join(f"{first + i}/{k % 4 + 1}" for k, i in enumerate(q)) for q in quads)]
    )


@pytest.fixture
def obj(tmp_path: Path) -> Path:
    """A chest in centimetres, Y up, front +z, whose lid is drawn standing open."""
    body = box_obj("body", (-20, 0, -15), (20, 20, 15), "plain", 1)
    lid = box_obj("lid_top", (-20, 20, -16), (20, 50, -15), "wood", 9)
    bar = box_obj("lid_handle", (-5, 47, -20), (5, 48, -19), "plain", 17)
    uv = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1"
    (tmp_path / "chest.obj").write_text("\n".join(["mtllib chest.mtl", uv, body, lid, bar]) + "\n")
    (tmp_path / "chest.mtl").write_text(
        "newmtl plain\nKd 0.2 0.4 0.6\n\nnewmtl wood\nKd 1 1 1\nmap_Kd wood.png\n"
    )
    Image.new("RGB", (8, 8), (200, 100, 50)).save(tmp_path / "wood.png")
    hinge = {
        "name": "lid", "type": "revolute", "groups": ["lid_"], "axis": [1, 0, 0], "origin": [0, 20, -15],
        "lower_deg": -10, "upper_deg": 90,
    }  # fmt: skip
    entry = {
        "category": "toolbox",
        "creator": "A. Maker",
        "license": "CC0",
        "unit_to_m": 0.01,
        "joints": [hinge],
    }
    (tmp_path / "articulation.json").write_text(json.dumps(entry))
    return tmp_path / "chest.obj"


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def bounds(asset: ArticulatedAsset) -> np.ndarray:
    points = np.concatenate([m.vertices for link in (asset.static, asset.moving) for m in link.meshes])
    return np.stack([points.min(0), points.max(0)])


def test_an_obj_comes_closed_upright_in_metres_with_texture_and_credit(obj: Path, tmp_path: Path) -> None:
    asset = import_model(obj)
    assert asset.joint.upper == pytest.approx(np.radians(100))
    # The lid lies on the box: 20 cm high, the handle above it; it opens upwards about the back edge.
    np.testing.assert_allclose(bounds(asset)[1, 2], 0.25, atol=2e-3)
    np.testing.assert_allclose(bounds(asset)[0, 2], 0.0, atol=2e-3)
    tip = asset.joint.motion(0.1)[:3, :3] @ (asset.handle_point - asset.joint.origin) + asset.joint.origin
    assert tip[2] > asset.handle_point[2]
    assert asset.handle_point[1] < asset.joint.origin[1]
    lid = next(mesh for mesh in asset.moving.meshes if mesh.name.startswith("lid_top"))
    assert lid.texture_srgb.shape == (8, 8, 3)
    body = asset.static.meshes[0]
    np.testing.assert_allclose(body.color_srgb, [0.2, 0.4, 0.6], atol=0.01)
    assert asset.credit == "A. Maker, CC0"
    write_usd(asset, tmp_path / "made" / "chest.usda")
    assert read_usd(tmp_path / "made" / "chest.usda").credit == "A. Maker, CC0"


def test_an_obj_keeps_opacity_as_a_number_or_a_texture(obj: Path) -> None:
    library = obj.parent / "chest.mtl"
    library.write_text("newmtl plain\nTr 0.75\n\nnewmtl wood\nmap_Kd wood.png\n\tmap_d -clamp on cut.png\n")
    Image.new("LA", (8, 8), (255, 102)).save(obj.parent / "cut.png")
    asset = import_model(obj)
    lid = next(mesh for mesh in asset.moving.meshes if mesh.name.startswith("lid_top"))
    assert asset.static.meshes[0].opacity == pytest.approx(0.25)
    assert (lid.maps["opacity"].max(), lid.opacity) == (102, pytest.approx(0.4))
    library.write_text("newmtl plain\nd glass\n")
    with pytest.raises(MalformedFileError, match=r"d glass.*from 0 to 1"):
        import_model(obj)
    (obj.parent / "cut.png").unlink()
    library.write_text("newmtl wood\nmap_d cut.png\n")
    with pytest.raises(MissingFileError, match=r"cut\.png"):
        import_model(obj)


def test_an_mjcf_with_two_joints_opens_the_named_one(tmp_path: Path) -> None:
    file = written(tmp_path / "cupboard.xml", MJCF)
    with pytest.raises(SeveralJointsError) as caught:
        import_model(file)
    assert caught.value.joints == ["hinge", "slide"]
    door, drawer = import_model(file, joint="hinge"), import_model(file, joint="slide")
    assert (door.joint.type, drawer.joint.type) == ("revolute", "prismatic")
    assert drawer.joint.upper == pytest.approx(0.25)
    assert door.joint.upper == pytest.approx(1.8)
    # The drawer stays in the door's asset, and does not move there.
    assert sum(len(link.meshes) for link in (door.static, door.moving)) == 9
    assert len(door.moving.meshes) == 3
    assert check_asset(door) == check_asset(drawer) == []
    with pytest.raises(AssetError, match=r"no single joint 'lid'.*hinge, slide"):
        import_model(file, joint="lid")


def test_a_urdf_keeps_colors_and_masses(tmp_path: Path) -> None:
    asset = import_model(written(tmp_path / "chest.urdf", URDF.replace("0.1 0.1 1", "0.1 0.1 0.4")))
    np.testing.assert_allclose(asset.static.meshes[0].color_srgb, [0.8, 0.1, 0.1], atol=1e-6)
    assert asset.static.meshes[0].opacity == pytest.approx(0.4)
    assert (asset.static.mass, asset.moving.mass) == (pytest.approx(3), pytest.approx(1))
    assert check_asset(asset) == []
    larger = import_model(tmp_path / "chest.urdf", scale=2.0, category="drawer")
    assert larger.joint.upper == pytest.approx(0.4)
    assert larger.category == "drawer"


@pytest.mark.parametrize(("kind", "height"), [("2d", 8), ("cube", 4)])
def test_an_mjcf_keeps_a_texture_that_is_higher_than_wide(tmp_path: Path, kind: str, height: int) -> None:
    Image.new("RGB", (4, 8 if kind == "2d" else 24), (200, 100, 50)).save(tmp_path / "paint.png")
    layout = 'gridsize="6 1" gridlayout="RLUDFB"' if kind == "cube" else ""
    paint = f'''<asset><texture name="paint" type="{kind}" file="paint.png" {layout}/>
      <material name="paint" texture="paint"/>
      <mesh name="sheet" vertex="0 0 0 .1 0 0 .1 0 .1 0 0 .1" texcoord="0 0 1 0 1 1 0 1" face="0 1 2 0 2 3"/>
      </asset><worldbody>'''
    sheet = '<geom type="mesh" mesh="sheet" material="paint" contype="0" conaffinity="0"/><geom name="knob"'
    text = MJCF.replace("<worldbody>", paint).replace('<geom name="knob"', sheet)
    drawn = read_mjcf_model(written(tmp_path / "cupboard.xml", text), "slide")
    (mesh,) = [item for item in drawn.moving.meshes if item.name.endswith("sheet")]
    assert mesh.texture_srgb.shape == (height, 4, 3)


def test_a_usd_with_two_joints_opens_the_named_one(tmp_path: Path) -> None:
    pxr = pytest.importorskip("pxr")
    assert pxr
    from pxr import Usd, UsdPhysics

    path = tmp_path / "chest.usda"
    write_usd(import_model(written(tmp_path / "chest.urdf", URDF)), path)
    stage = Usd.Stage.Open(str(path))
    root = str(stage.GetDefaultPrim().GetPath())
    second = UsdPhysics.RevoluteJoint.Define(stage, f"{root}/lock")
    second.CreateBody0Rel().SetTargets([f"{root}/moving"])
    second.CreateBody1Rel().SetTargets([f"{root}/moving"])
    stage.Save()
    with pytest.raises(AssetError, match=r"2 joints: .*joint, .*lock"):
        read_usd(path)
    assert read_usd(path, "joint").joint.upper == pytest.approx(0.2)


def test_closing_takes_the_smaller_box_and_nothing_where_it_is_closed(tmp_path: Path) -> None:
    asset = import_model(written(tmp_path / "chest.urdf", URDF))
    again = close(asset)
    np.testing.assert_allclose(bounds(again), bounds(asset))
    assert again.joint.upper == asset.joint.upper


def test_colliders_give_way_to_what_moves(tmp_path: Path) -> None:
    text = MJCF.replace('size="0.2 0.01 0.3" pos="0 0.19 0"', 'size="0.2 0.03 0.3" pos="0 0.16 0"')
    asset = import_model(written(tmp_path / "cupboard.xml", text), joint="slide")
    assert check_asset(asset) == []
    np.testing.assert_allclose(bounds(clear_path(asset)), bounds(asset))


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        (lambda p: (p.parent / "wood.png").unlink(), MissingFileError, "wood.png"),
        (lambda p: (p.parent / "chest.mtl").unlink(), MissingFileError, "chest.mtl"),
        (
            lambda p: (p.parent / "chest.mtl").write_text("newmtl wood\nmap_Kd ../../secret.png\n"),
            UnsafePathError,
            "outside",
        ),
        (lambda p: p.write_text("no triangles\n"), MalformedFileError, "triangles"),
        (lambda p: (p.parent / "articulation.json").unlink(), ConfigError, "--joints"),
        (lambda p: (p.parent / "articulation.json").write_text("{}"), MalformedFileError, "joints"),
        (
            lambda p: (p.parent / "articulation.json").write_text('{"models": {"other": {"joints": []}}}'),
            AssetError,
            "does not describe chest.obj",
        ),
        (lambda p: p.rename(p.with_suffix(".fbx")), MalformedFileError, "suffix"),
    ],
)  # fmt: skip
def test_what_cannot_be_imported_is_refused(obj: Path, change, kind: type[AomgenError], words: str) -> None:
    change(obj)
    file = obj if obj.exists() else obj.with_suffix(".fbx")
    with pytest.raises(kind, match=words):
        import_model(file)


def test_a_joint_without_limits_or_groups_is_refused(obj: Path) -> None:
    file = obj.parent / "articulation.json"
    entry = json.loads(file.read_text())
    entry["joints"][0]["groups"] = ["door"]
    file.write_text(json.dumps(entry))
    with pytest.raises(AssetError, match="nothing moves"):
        import_model(obj)
    del entry["joints"][0]["upper_deg"]
    file.write_text(json.dumps(entry))
    with pytest.raises(AssetError, match="no limits"):
        import_model(obj)


def test_the_doctor_says_what_is_wrong(tmp_path: Path) -> None:
    good = import_model(written(tmp_path / "chest.urdf", URDF))
    assert [item.problem for item in examine(good) if item.problem] == []
    # From the back of the bar, at y = -0.21, to the front of the drawer, at y = -0.175.
    assert "35 mm" in next(item.state for item in examine(good) if item.name == "handle")
    runner = CliRunner()
    path = tmp_path / "chest.usda"
    imported = runner.invoke(app, ["assets", "import", str(tmp_path / "chest.urdf"), str(path)])
    assert imported.exit_code == 0, imported.output
    told = runner.invoke(app, ["assets", "check", str(path), "--json"])
    assert told.exit_code == 0
    assert {"use", "joint", "handle"} <= {item["name"] for item in json.loads(told.output)}
    runner.invoke(app, ["assets", "import", str(tmp_path / "chest.urdf"), str(path), "--scale", "50"])
    broken = runner.invoke(app, ["assets", "check", str(path)])
    assert isinstance(broken.exception, AssetError)
    assert "m large" in str(broken.exception)


def test_an_imported_asset_is_named_as_its_file(tmp_path: Path) -> None:
    """Two models of one name can be in one project."""
    model = written(tmp_path / "chest.urdf", URDF)
    for name in ("one", "two"):
        CliRunner().invoke(app, ["assets", "import", str(model), str(tmp_path / f"{name}.usda")])
        assert read_usd(tmp_path / f"{name}.usda").name == name


# Models that are imported within two seconds; the laptop's lid is too thick for the gripper.
FURNITURE = ("KatorLegaz/apple-ibook-2001", "BlendSwap-CC-BY/tvStand")


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the shared models")
def test_real_models_can_be_imported_and_most_can_be_used() -> None:
    furniture, libero = SHARED / "sweethome3d-furniture", SHARED / "libero-articulated"
    entries = json.loads((furniture / "articulation.json").read_text())["models"]
    assets = []
    for name in FURNITURE:
        item = entries[name]
        assets.append(import_model(furniture / name / item["obj"], joint=item["joints"][0]["name"]))
    named = {
        "microwave": "",
        "short_cabinet": "top_region",
        "white_cabinet": "top_level",
        "wooden_cabinet": "middle_level",
    }
    assets += [import_model(libero / f"{n}.xml", joint=joint, scale=2.0) for n, joint in named.items()]
    usable = [asset.name for asset in assets if not check_asset(asset)]
    assert len(usable) >= len(assets) - 1, usable
    assert all(asset.credit for asset in assets[:-4])
