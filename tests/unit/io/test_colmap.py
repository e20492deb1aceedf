"""COLMAP folders: what pycolmap writes is read alike, and damaged or distorted models are refused."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aomgen.core.camera import Camera, look_at
from aomgen.core.transforms import matrix_from_quat
from aomgen.errors import (
    CalibrationError,
    InputError,
    MalformedFileError,
    MissingFileError,
    NonFiniteError,
    UnsafePathError,
)
from aomgen.io.colmap import read_colmap
from aomgen.io.images import write_image

SIZE = (40, 30)


def camera(index: int) -> Camera:
    eye = (np.cos(index), np.sin(index), 0.5 + 0.1 * index)
    return Camera(
        fx=50, fy=52, cx=19, cy=16, width=SIZE[0], height=SIZE[1], T_world_cam=look_at(eye, (0, 0, 0))
    )


def points(count: int = 7) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3))


def quat_of(R: np.ndarray) -> np.ndarray:
    w = np.sqrt(max(1e-12, 1 + np.trace(R))) / 2
    return np.array([w, *(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w))])


def write_model(folder: Path, names=("b.png", "a.png", "sub/c.png"), model: int = 1) -> Path:
    """The binary format from its description, with observations that the reader has to step over."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    params = {0: (50, 19, 16), 1: (50, 52, 19, 16), 4: (50, 52, 19, 16, 0.1, 0, 0, 0)}[model]
    data = struct.pack(f"<QiiQQ{len(params)}d", 1, 3, model, *SIZE, *params)
    (sparse / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(names))
    for index, name in enumerate(names):
        T = camera(index).T_cam_world
        quat = -2 * quat_of(T[:3, :3])  # neither normalised nor of the usual sign
        data += struct.pack("<i7di", 10 + index, *quat, *T[:3, 3], 3) + name.encode() + b"\0"
        data += struct.pack("<Q", index) + struct.pack("<ddq", 1, 2, -1) * index
        if ".." not in name:
            write_image(folder / "images" / name, np.full((SIZE[1], SIZE[0], 3), 50 * index, np.uint8))
    (sparse / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points()))
    for index, point in enumerate(points()):
        data += struct.pack("<Q3d3BdQ", 5 * index, *point, index, 2, 3, 0.5, min(index % 3, len(names)))
        data += b"".join(struct.pack("<ii", 10 + seen, 2) for seen in range(min(index % 3, len(names))))
    (sparse / "points3D.bin").write_bytes(data)
    return folder


def test_read(tmp_path: Path) -> None:
    have = read_colmap(write_model(tmp_path))
    assert list(have.views) == ["a.png", "b.png", "sub/c.png"]
    np.testing.assert_array_equal(have.points_recon, points())
    np.testing.assert_array_equal(have.colors_srgb, [[i, 2, 3] for i in range(7)])
    # Images 10 and 11 are b.png and a.png, which come second and first by name.
    np.testing.assert_array_equal(have.observations, [[1, 1], [2, 1], [2, 0], [4, 1], [5, 1], [5, 0]])
    for index, name in enumerate(("b.png", "a.png", "sub/c.png")):
        view, want = have.views[name], camera(index)
        np.testing.assert_allclose(view.camera_recon.T_world_cam, want.T_world_cam, atol=1e-9)
        np.testing.assert_allclose(view.camera_recon.K, want.K)
        assert view.path == (tmp_path / "images" / name).resolve()


def test_points_of_an_unknown_image_are_refused(tmp_path: Path) -> None:
    file = write_model(tmp_path) / "sparse" / "0" / "points3D.bin"
    data = file.read_bytes()
    assert data.endswith(struct.pack("<Q", 0))  # the last point is seen by nobody
    file.write_bytes(data[:-8] + struct.pack("<Qii", 1, 77, 0))
    with pytest.raises(MalformedFileError, match="unknown image 77"):
        read_colmap(tmp_path)


def test_simple_pinhole_without_a_number(tmp_path: Path) -> None:
    """One focal length, and a model that lies in `sparse` itself."""
    folder = write_model(tmp_path, model=0)
    for file in (folder / "sparse" / "0").iterdir():
        file.rename(folder / "sparse" / file.name)
    (folder / "sparse" / "0").rmdir()
    view = read_colmap(folder).views["a.png"]
    assert (view.camera_recon.fx, view.camera_recon.fy) == (50, 50)


def test_like_pycolmap(tmp_path: Path) -> None:
    """Its own files of its current version, several cameras and rigs, and its own idea of a pose."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2,
        num_cameras_per_rig=1,
        num_frames_per_rig=3,
        num_points3D=50,
        camera_model_id=pycolmap.CameraModelId.PINHOLE,
        camera_width=64,
        camera_height=48,
        camera_params=[80.0, 81.0, 31.0, 25.0],
    )
    want = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    want.write_binary(tmp_path / "sparse" / "0")
    for image in want.images.values():
        write_image(tmp_path / "images" / image.name, np.zeros((48, 64, 3), np.uint8))
    have = read_colmap(tmp_path)
    assert set(have.views) == {image.name for image in want.images.values()}
    assert len(have.points_recon) == len(want.points3D)
    middle = np.mean([point.xyz for point in want.points3D.values()], 0)
    np.testing.assert_allclose(have.points_recon.mean(0), middle, atol=1e-9)
    for image in want.images.values():
        seen = next(p for p in image.points2D if p.has_point3D())
        pixels, depths = have.views[image.name].camera_recon.project(want.points3D[seen.point3D_id].xyz[None])
        np.testing.assert_allclose(
            pixels[0], image.project_point(want.points3D[seen.point3D_id].xyz), atol=1e-6
        )
        assert depths[0] > 0


def test_smaller_images(tmp_path: Path) -> None:
    folder = write_model(tmp_path, names=("a.png",))
    write_image(folder / "images_2" / "a.png", np.zeros((15, 20, 3), np.uint8))
    small = read_colmap(folder, images="images_2").views["a.png"].camera_recon
    assert (small.width, small.height, small.fx, small.cy) == (20, 15, 25, 8)


def test_images_of_another_shape(tmp_path: Path) -> None:
    folder = write_model(tmp_path)
    write_image(folder / "images" / "a.png", np.zeros((40, 30, 3), np.uint8))
    with pytest.raises(CalibrationError, match="is 30 x 40, its camera 40 x 30"):
        read_colmap(folder)


def test_distortion_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="OPENCV, expected PINHOLE; run `colmap image_undistorter`"):
        read_colmap(write_model(tmp_path, model=4))


def test_text_model(tmp_path: Path) -> None:
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "cameras.txt").write_text("# Camera list")
    with pytest.raises(MissingFileError, match="model_converter --output_type BIN"):
        read_colmap(tmp_path)


def test_missing_image(tmp_path: Path) -> None:
    folder = write_model(tmp_path)
    (folder / "images" / "a.png").unlink()
    with pytest.raises(MissingFileError, match=r"a\.png"):
        read_colmap(folder)


@pytest.mark.parametrize("name", ["../../secret.png", "/etc/hostname"])
def test_names_stay_inside(tmp_path: Path, name: str) -> None:
    folder = write_model(tmp_path / "x" / "y", names=("../x.png",))
    path = folder / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"../x.png", name.encode()))
    with pytest.raises(UnsafePathError):
        read_colmap(folder)


@pytest.mark.parametrize(
    ("file", "at", "value", "error", "sentence"),
    [
        ("cameras.bin", 0, struct.pack("<Q", 2**63), MalformedFileError, "promises 9223372036854775808"),
        ("cameras.bin", 16, struct.pack("<Q", 0), MalformedFileError, "0 x 30 pixels"),
        ("cameras.bin", 16, struct.pack("<Q", 1 << 40), MalformedFileError, "pixels"),
        ("cameras.bin", 32, struct.pack("<d", np.nan), NonFiniteError, "intrinsics nan"),
        ("cameras.bin", 32, struct.pack("<d", 0), NonFiniteError, "intrinsics 0"),
        ("cameras.bin", 8, struct.pack("<i", 4), MalformedFileError, "unknown camera"),
        ("images.bin", 12, struct.pack("<4d", 0, 0, 0, 0), NonFiniteError, "pose"),
        ("images.bin", 12, struct.pack("<d", np.inf), NonFiniteError, "pose"),
        ("images.bin", 72, b"\xff", MalformedFileError, "UTF-8"),
        ("images.bin", 72, b"a.png", MalformedFileError, "is listed twice"),
        ("points3D.bin", 16, struct.pack("<d", np.nan), NonFiniteError, "point"),
        ("points3D.bin", 51, struct.pack("<Q", 2**61), MalformedFileError, "promises"),
    ],
)
def test_damaged(
    tmp_path: Path, file: str, at: int, value: bytes, error: type[InputError], sentence: str
) -> None:
    folder = write_model(tmp_path)
    path = folder / "sparse" / "0" / file
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)
    with pytest.raises(error, match=sentence):
        read_colmap(folder)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_every_cut_is_refused(tmp_path: Path, file: str) -> None:
    folder = write_model(tmp_path)
    path = folder / "sparse" / "0" / file
    data = path.read_bytes()
    for changed in [data[:length] for length in range(len(data))] + [data + b"x"]:
        path.write_bytes(changed)
        with pytest.raises(InputError):
            read_colmap(folder)


@settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=200,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    file=st.sampled_from(["cameras.bin", "images.bin", "points3D.bin"]),
    changes=st.lists(st.tuples(st.floats(0, 1), st.binary(min_size=1, max_size=8)), min_size=1, max_size=4),
)
def test_any_bytes(tmp_path: Path, file: str, changes: list[tuple[float, bytes]]) -> None:
    """Refused with one of our errors, or a model with sound numbers."""
    folder = tmp_path if (tmp_path / "sparse").exists() else write_model(tmp_path)
    path = folder / "sparse" / "0" / file
    original = path.read_bytes()
    data = bytearray(original)
    for where, junk in changes:
        at = int(where * (len(data) - 1))
        data[at : at + len(junk)] = junk
    path.write_bytes(data)
    try:
        have = read_colmap(folder)
    except InputError:
        return
    finally:
        path.write_bytes(original)
    assert np.isfinite(have.points_recon).all()
    for view in have.views.values():
        R = view.camera_recon.T_world_cam[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)


def test_the_helper_turns_right() -> None:
    R = camera(2).T_cam_world[:3, :3]
    np.testing.assert_allclose(matrix_from_quat(quat_of(R)), R, atol=1e-9)
