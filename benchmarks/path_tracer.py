"""Path-traced images of a MuJoCo scene by Blender, an external program that shares no code with our own rendering."""

import hashlib
import json
import os
import subprocess
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.core.camera import Camera, look_at
from aomgen.core.values import Array
from aomgen.errors import BackendError
from aomgen.io.atomic import write_bytes, write_json
from aomgen.io.images import encode_png, read_image
from aomgen.simulation.scene import Scene
from aomgen.simulation.scene_renderer import SceneRenderer

# A Python that has the package bpy.
INTERPRETER: Final = Path(__file__).parents[1] / ".venv-blender" / "bin" / "python"
WORKER: Final = Path(__file__).with_name("blender_tracer.py")
# Paths per pixel; the remaining noise is removed by Blender's denoiser.
SAMPLES: Final = 24
# Surfaces with a color and no material: between paint and plastic.
PLAIN_ROUGHNESS: Final = 0.5
# MuJoCo's shininess s, where it has no roughness, becomes a roughness of 1 - s / this.
SHININESS: Final = 0.6


def blender_python() -> Path:
    """Return the Python that has Blender, which may not be installed."""
    return Path(os.environ.get("AOMGEN_BLENDER_PYTHON", INTERPRETER))


@dataclass(frozen=True, slots=True, kw_only=True)
class RoomLight:
    """Light and camera of a room.

    Attributes:
        environment: File among Blender's studio lights.
        strength: Strength of the environment.
        turn: Rotation of the environment about z, [rad].
        lamp_w, lamp_m: Power and side of a square light source; none at 0 W.
        lamp_color: Linear color of the light source.
        lamp_from, lamp_at: Position of the light source, and its target point, world frame, [m].
        view_transform: Tone curve of all cameras.
        exposure: Exposure of all cameras, stops.
    """

    environment: str
    strength: float = 1.0
    turn: float = 0.0
    lamp_w: float = 0.0
    lamp_m: float = 0.6
    lamp_color: tuple[float, float, float] = (1.0, 0.9, 0.75)
    lamp_from: tuple[float, float, float] = (0.0, 0.0, 2.0)
    lamp_at: tuple[float, float, float] = (0.0, 0.6, 0.0)
    view_transform: str = "AgX"
    exposure: float = 0.0


class PathTracedRenderer(SceneRenderer):
    """Renderer of one compiled scene with Blender's Cycles; labels and depths stay those of the rasterizer.

    Args:
        scene: Compiled scene.
        size: See `SceneRenderer`.
        folder: Folder of the scene's files and of every image, so that none is rendered twice.
        light: Light of the room.
    """

    def __init__(self, scene: Scene, size: tuple[int, int], folder: Path, light: RoomLight) -> None:
        super().__init__(scene, size)
        self.scene = scene
        self._names = [
            mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_BODY, k) for k in range(self.model.nbody)
        ]
        self._geoms = np.flatnonzero(self.model.geom_group == VISUAL_GROUP)
        described = _describe(self.model, self._geoms, light)
        self.folder = folder / described.digest
        self._described, self._blender = described, None

    def draw(self, camera: Camera, qpos: Array, without: tuple[str, ...] = ()) -> NDArray[np.uint8]:
        """Render an image (H, W, 3) of a state, without bodies whose names begin with one of `without`."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        Ts = np.tile(np.eye(4), (len(self._geoms), 1, 1))
        Ts[:, :3, :3] = self.data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        Ts[:, :3, 3] = self.data.geom_xpos[self._geoms]
        owners = [self._names[body] for body in self.model.geom_bodyid[self._geoms]]
        job = {
            "Ts_world_mesh": Ts.round(7).tolist(),
            "hidden": [bool(without) and name.startswith(without) for name in owners],
            "size": [camera.width, camera.height],
            "focal_px": camera.fx,
            "center_px": [camera.cx, camera.cy],
            "T_world_cam": camera.T_world_cam.round(7).tolist(),
        }
        name = hashlib.sha256(json.dumps(job).encode()).hexdigest()[:24]
        file = self.folder / "pictures" / f"{name}.png"
        if not file.is_file():
            # A process that dies while it writes leaves an incomplete image.
            partial = file.with_suffix(".part.png")
            self._ask({**job, "file": str(partial)})
            partial.replace(file)
        return read_image(file)

    def close(self) -> None:
        """End Blender and free the OpenGL context."""
        if self._blender is not None:
            self._blender.communicate()
            self._blender = None
        super().close()

    def _ask(self, job: dict[str, Any]) -> None:
        if self._blender is None:
            self._blender = self._start()
        blender = self._blender
        if blender.stdin is None or blender.stdout is None:
            raise ValueError("Blender was started without pipes")
        # A process that has died does not read; its exit code is reported below.
        with suppress(BrokenPipeError):
            blender.stdin.write(json.dumps(job) + "\n")
            blender.stdin.flush()
        for line in blender.stdout:
            if line.startswith("DONE"):
                return
        self._blender = None
        raise BackendError(
            "Blender", f"ended with exit code {blender.wait()}", f"see {self.folder / 'blender.log'}"
        )

    def _start(self) -> subprocess.Popen[str]:
        interpreter = blender_python()
        if not interpreter.is_file():
            raise BackendError("Blender", f"{interpreter} does not exist", "make blender-env")
        self._described.write(self.folder)
        command = [str(interpreter), str(WORKER), str(self.folder)]
        pipe = subprocess.PIPE
        with (self.folder / "blender.log").open("wb") as log:
            return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=log, text=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class _DescribedScene:
    """Input of Blender: `scene.json`, arrays of all meshes, textures (H, W, 3) by file name."""

    scene: dict[str, Any]
    arrays: dict[str, NDArray]
    textures: dict[str, NDArray[np.uint8]]

    @property
    def digest(self) -> str:
        found = hashlib.sha256(json.dumps(self.scene, sort_keys=True).encode())
        for values in (*self.arrays.values(), *self.textures.values()):
            found.update(np.ascontiguousarray(values).tobytes())
        return found.hexdigest()[:24]

    def write(self, folder: Path) -> None:
        for name, pixels in self.textures.items():
            # The folder is named by the digest of its content, so that an existing file is the same.
            if not (folder / name).is_file():
                write_bytes(folder / name, encode_png(pixels))
        write_json(folder / "scene.json", self.scene)
        np.savez(folder / "meshes.npz", allow_pickle=False, **self.arrays)


def _describe(model: mujoco.MjModel, geoms: NDArray[np.int64], light: RoomLight) -> _DescribedScene:
    arrays: dict[str, NDArray] = {}
    for number, geom in enumerate(geoms):
        if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
            raise ValueError(f"geom {geom} is no mesh")
        for name, values in _mesh_arrays(model, int(model.geom_dataid[geom])).items():
            arrays[f"{name}_{number}"] = values
    materials, textures = [], {}
    for index in range(model.nmat):
        texture = int(model.mat_texid[index, mujoco.mjtTextureRole.mjTEXROLE_RGB])
        name = f"texture_{texture}.png" if texture >= 0 else ""
        if name:
            textures[name] = _texture(model, texture)
        materials.append({
            "color_srgb": model.mat_rgba[index, :3].round(6).tolist(),
            "texture": name,
            "roughness": _roughness(model, index),
            "metallic": float(max(model.mat_metallic[index], 0.0)),
        })  # fmt: skip
    mesh_materials = model.geom_matid[geoms].tolist()
    for number, geom in enumerate(geoms):
        if mesh_materials[number] < 0:
            plain = {"texture": "", "roughness": PLAIN_ROUGHNESS, "metallic": 0.0}
            materials.append({"color_srgb": model.geom_rgba[geom, :3].round(6).tolist(), **plain})
            mesh_materials[number] = len(materials) - 1
    T_world_lamp = look_at(np.asarray(light.lamp_from), np.asarray(light.lamp_at)) @ np.diag(
        [1.0, -1.0, -1.0, 1.0]
    )
    scene = {
        "materials": materials,
        "mesh_materials": mesh_materials,
        "light": {**asdict(light), "T_world_lamp": T_world_lamp.round(6).tolist()},
        "samples": SAMPLES,
        "view_transform": light.view_transform,
        "exposure": light.exposure,
    }
    return _DescribedScene(scene=scene, arrays=arrays, textures=textures)


def _mesh_arrays(model: mujoco.MjModel, mesh: int) -> dict[str, NDArray]:
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    begin, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    corners = np.zeros((0, 2))
    if (start := model.mesh_texcoordadr[mesh]) >= 0:
        corners = model.mesh_texcoord[start + model.mesh_facetexcoord[begin : begin + faces]].reshape(-1, 2)
        # The v axis of MuJoCo points down.
        corners = corners * [1, -1] + [0, 1]
    return {
        "vertices": model.mesh_vert[first : first + count],
        "faces": model.mesh_face[begin : begin + faces],
        "uvs": corners,
    }


def _texture(model: mujoco.MjModel, texture: int) -> NDArray[np.uint8]:
    height, width, channels = model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture]
    start = model.tex_adr[texture]
    pixels = model.tex_data[start : start + height * width * channels]
    return pixels.reshape(height, width, channels)[..., :3]


def _roughness(model: mujoco.MjModel, material: int) -> float:
    if (stated := float(model.mat_roughness[material])) >= 0:
        return stated
    return float(np.clip(1 - model.mat_shininess[material] / SHININESS, 0.0, 1.0))
