"""Every example runs on a tiny scene and writes what it promises."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import aomgen
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.io.gaussian_files import read_gaussians, write_gaussians
from aomgen.io.images import read_image, write_image
from aomgen.splatting.rasterizer import render

EXAMPLES = Path(__file__).parents[3] / "examples"
TUTORIALS = EXAMPLES.parent / "docs" / "tutorials"


def run(name: str, *arguments: object) -> str:
    """What an example prints."""
    source = str(Path(aomgen.__file__).parents[1])
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": source}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def ball(count: int = 800) -> Gaussians:
    """A ball that is red on top (-y) and blue below."""
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colors = np.where(directions[:, 1:2] < 0, [[0.9, 0.1, 0.1]], [[0.1, 0.1, 0.9]])
    return gaussians_of(
        means=directions,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 0.12),
        opacities=np.full(count, 0.9),
        sh=((colors - 0.5) / SH_C0)[:, None],
    )


def write_colmap(folder: Path, gaussians: Gaussians, count: int = 10) -> None:
    """Pictures of Gaussians from around them, and the model that COLMAP would find."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    intrinsics = [60.0, 60.0, 24.0, 18.0]
    optics = pycolmap.Camera(camera_id=1, model="PINHOLE", width=48, height=36, params=intrinsics)
    model.add_camera_with_trivial_rig(optics)
    for index in range(count):
        angle = 2 * np.pi * index / count
        pose = look_at((4 * np.cos(angle), -1, 4 * np.sin(angle)), (0, 0, 0), (0, -1, 0))
        camera = Camera(fx=60, fy=60, cx=24, cy=18, width=48, height=36, T_world_cam=pose)
        image = np.round(255 * np.clip(render(gaussians, camera).rgb, 0, 1)).astype(np.uint8)
        write_image(folder / "images" / f"{index:02d}.png", image)
        named = pycolmap.Image(image_id=index + 1, camera_id=1, name=f"{index:02d}.png")
        pixels, _ = camera.project(gaussians.means.astype(float))
        named.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        model.add_image_with_trivial_frame(named, pycolmap.Rigid3d(camera.T_cam_world[:3]))
    colors = np.round(255 * (0.5 + SH_C0 * gaussians.sh[:, 0])).astype(np.uint8)
    for row, (point, color) in enumerate(zip(gaussians.means, colors, strict=True)):
        track = pycolmap.Track([pycolmap.TrackElement(index + 1, row) for index in range(count)])
        model.add_point3D(point.astype(float), track, color)
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")


@pytest.mark.parametrize("suffix", [".ply", ".splat"])
def test_render_ply(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"ball{suffix}"
    write_gaussians(file, ball())
    said = run("render_ply.py", file, "--out", tmp_path / "out", "--size", 60, 40, "--orbit", 2)
    assert "800 Gaussians of SH degree 0" in said
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *("depth.png", "orbit_000.png", "orbit_001.png", "rgb.png")
    ]
    rgb = read_image(tmp_path / "out" / "rgb.png").astype(int)
    assert rgb.shape == (40, 60, 3)
    assert (rgb[0, 0] == 255).all()  # the white background: the ball is in the picture as a whole
    assert rgb[10, 30, 0] > rgb[10, 30, 2] + 50  # -y is up
    assert rgb[34, 30, 2] > rgb[34, 30, 0] + 50
    depth = read_image(tmp_path / "out" / "depth.png")
    assert depth[20, 30, 0] > 200
    assert depth[0, 0, 0] == 0


def test_convert(tmp_path: Path) -> None:
    """-y becomes z: red lies above in the result."""
    write_gaussians(tmp_path / "a.splat", ball())
    assert "800 Gaussians" in run("convert.py", tmp_path / "a.splat", tmp_path / "b.ply", "--up=-y")
    turned = read_gaussians(tmp_path / "b.ply")
    red = turned.sh[:, 0, 0] > 0
    assert turned.means[red, 2].min() > turned.means[~red, 2].max()
    run("convert.py", tmp_path / "b.ply", tmp_path / "c.usdc")
    assert (tmp_path / "c.usdc").read_bytes()[:8] == b"PXR-USDC"


def test_train_colmap(tmp_path: Path) -> None:
    write_colmap(tmp_path, ball())
    effort = ["--iterations", 60, "--max-gaussians", 900]
    said = run("train_colmap.py", tmp_path, "--out", tmp_path / "a.ply", *effort)
    assert "8 images to learn from, 2 held out" in said
    psnr_db = float(said.split("held-out PSNR ")[1].split()[0])
    assert psnr_db > 12
    assert len(read_gaussians(tmp_path / "a.ply")) > 500


def test_fit_pose(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    spotted = ball().with_sh(rng.normal(0, 1, (800, 1, 3)))
    write_gaussians(tmp_path / "a.ply", spotted)
    said = run("fit_pose.py", tmp_path / "a.ply", "--size", 48, 36, "--off-deg", 3)
    last = said.strip().splitlines()[-1]
    assert float(last.split("rotation ")[1].split()[0]) < 0.2
    assert float(last.split("position ")[1].split("%")[0]) < 0.4


def test_recover_joint() -> None:
    assert "revolute: axis" in run("01_recover_joint.py")


def test_make_asset(tmp_path: Path) -> None:
    assert "revolute about" in run("02_make_asset.py", tmp_path / "microwave.usda")


def read_source(path: Path) -> str:
    """The Python source of a script, or of a notebook's cells without their magic commands."""
    text = path.read_text("utf-8")
    if path.suffix == ".py":
        return text
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    lines = [line for cell in cells for line in [*"".join(cell["source"]).splitlines(), ""]]
    return "\n".join(line for line in lines if not line.startswith("%"))


@pytest.mark.parametrize(
    "path", [*sorted(EXAMPLES.glob("*.py")), *sorted(TUTORIALS.glob("*.ipynb"))], ids=lambda path: path.stem
)
def test_examples_use_public_names_only(path: Path) -> None:
    for node in ast.walk(ast.parse(read_source(path))):
        if isinstance(node, ast.ImportFrom) and node.module == "aomgen":
            assert {alias.name for alias in node.names} <= {"splatting"}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("aomgen"):
            assert node.module == "aomgen.splatting"
        elif isinstance(node, ast.Import):
            assert {alias.name for alias in node.names if alias.name.startswith("aomgen")} <= {"aomgen"}


@pytest.mark.parametrize("path", sorted(TUTORIALS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_tutorials_are_short_and_executed(path: Path) -> None:
    cells = json.loads(path.read_text("utf-8"))["cells"]
    outputs = [output for cell in cells if cell["cell_type"] == "code" for output in cell["outputs"]]
    assert len(cells) <= 25
    assert all(cell["execution_count"] for cell in cells if cell["cell_type"] == "code")
    assert 0 < len(json.dumps(outputs)) < 150_000
    # Neither errors nor warnings, which name folders of the machine that executed the notebook.
    assert not [output for output in outputs if output.get("name") == "stderr" or "ename" in output]


def test_the_script_of_the_readme_is_short_and_the_example() -> None:
    lines = (EXAMPLES / "03_generate_episodes.py").read_text("utf-8").splitlines()
    assert sum(bool(line) for line in lines[1:]) <= 12
