"""Export of an episode as MJCF: one model, its meshes and textures, and the controls that open the object.

```
scene.xml            python -m mujoco.viewer --mjcf=scene.xml; its keyframe "start" is the begin of the episode
scene_meshes/        OBJ and PNG files that it names, and aomgen.json, which marks the folder as one that may be replaced
scene_controls.csv   time_s and a column for each actuator, at every control tick
```
"""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.core.camera import Camera
from aomgen.core.transforms import matrix_from_quat, quat_from_matrix
from aomgen.core.values import Array
from aomgen.datasets.selection import MARK, require_replaceable
from aomgen.exports.scene_motion import SceneMotion
from aomgen.exports.simulated_scene import describe_nominal, simulate_motion_scene
from aomgen.io.atomic import stage_folder, write_bytes, write_json, write_text
from aomgen.io.images import encode_png
from aomgen.results import Results
from aomgen.simulation.controls import (
    SETTLE_S,
    Commands,
    divide_frame,
    ignore_hand_on_hand,
    ramp,
    servo_controls,
)
from aomgen.simulation.scene import Scene, describe_scene
from aomgen.simulation.scene_spec import TABLE

KEYFRAME: Final = "start"
# Brightness of the directional light above the scene and of the viewer's headlight.
DIFFUSE, AMBIENT = 0.5, 0.4
# Colors of the sky at the zenith and at the horizon.
SKY: Final = ((0.55, 0.65, 0.75), (0.9, 0.92, 0.95))
# Pixel size for MuJoCo's cameras, whose optics are lengths on a sensor, [m]; only ratios matter.
PIXEL_M: Final = 1e-5


def write_mjcf(results: Results, motion: SceneMotion, path: Path) -> None:
    """Write the model of a motion's scene, the folder of its meshes and its controls.

    Joint resistance, servos, contact exclusions and time step are those of the verification in the nominal setting.

    Raises:
        ConfigError: The folder of the meshes has other content.
        StorageError: Writing to the disk failed.
    """
    meshes = path.with_name(f"{path.stem}_meshes")
    table = path.with_name(f"{path.stem}_controls.csv")
    require_replaceable(meshes)
    scene = simulate_motion_scene(results, motion)
    spec = describe_nominal(results, scene, motion)
    ticks, _, spec.option.timestep = divide_frame(motion.fps, scene.model.opt.timestep)
    shown = describe_scene(spec.compile(), scene.robot, scene.asset, scene.names, bolted=scene.bolted)
    model = shown.model
    ignore_hand_on_hand(shown, model)
    _take_over(spec, model)
    _add_surroundings(spec, motion.cameras)
    controls = list_controls(scene, motion.commands, motion.fps, ticks)
    first = motion.commands[:1]
    start = scene.qpos(first[:, :-1], first[:, -1], motion.trajectory.thetas[:1])[0]
    spec.add_key(name=KEYFRAME, qpos=start, ctrl=controls[0])
    spec.modelname = path.stem
    files = _export_meshes(spec, model) | _export_textures(spec, model)
    spec.meshdir = spec.texturedir = meshes.name
    spec.assets = {f"{meshes.name}/{name}": content for name, content in files.items()}
    text = spec.to_xml()
    names = [model.actuator(number).name for number in range(model.nu)]
    times = np.arange(len(controls)) / (motion.fps * ticks)
    with stage_folder(meshes) as folder:
        for name, content in files.items():
            write_bytes(folder / name, content)
        write_json(folder / MARK, {"model": path.name})
    write_text(table, _format_csv(["time_s", *names], times, controls))
    write_text(path, text)


def list_controls(scene: Scene, commands: Array, fps: float, ticks: int) -> Array:
    """Compute controls (N, nu) at every control tick: first the initial configuration, then commands (T + 1, J + 1)."""
    still = np.repeat(commands[:1], round(SETTLE_S * fps * ticks), 0)
    resting = Commands(still[:, :-1], np.zeros_like(still[:, :-1]), still[:, -1])
    moving = [ramp(now, after, fps, ticks) for now, after in pairwise(commands)]
    return np.concatenate([servo_controls(scene, part) for part in (resting, *moving)])


def _take_over(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Copy changes of a compiled model to its description: contact bits and largest forces of the drives."""
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = (
            int(bits[geom.id]) for bits in (model.geom_contype, model.geom_conaffinity)
        )
    for actuator in spec.actuators:
        if model.actuator_forcelimited[actuator.id]:
            actuator.forcerange = model.actuator_forcerange[actuator.id]
    for joint in spec.joints:
        if model.jnt_actfrclimited[joint.id]:
            joint.actfrcrange = model.jnt_actfrcrange[joint.id]


def _add_surroundings(spec: mujoco.MjSpec, cameras: Mapping[str, Camera]) -> None:
    """Add light, a sky, a visible table and the cameras of the motion."""
    spec.geom(TABLE).group = VISUAL_GROUP
    light = spec.worldbody.add_light(pos=[0, 0, 3], dir=[0, 0, -1])
    light.type, light.diffuse = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, [DIFFUSE] * 3
    spec.visual.headlight.ambient = spec.visual.headlight.diffuse = [AMBIENT] * 3
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=256, height=1536)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, SKY[0], SKY[1]
    for name, camera in cameras.items():
        # MuJoCo's cameras look along -z with y up.
        item = spec.worldbody.add_camera(
            name=f"camera_{name}",
            pos=camera.center,
            quat=quat_from_matrix(camera.T_world_cam[:3, :3] @ np.diag([1.0, -1.0, -1.0])),
            resolution=[camera.width, camera.height],
        )
        item.focal_pixel = [camera.fx, camera.fy]
        item.principal_pixel = [camera.width / 2 - camera.cx, camera.height / 2 - camera.cy]
        item.sensor_size = [camera.width * PIXEL_M, camera.height * PIXEL_M]


def _export_meshes(spec: mujoco.MjSpec, model: mujoco.MjModel) -> dict[str, bytes]:
    """Return OBJ files of all meshes in their frames, by their new names in the description."""
    files = {}
    for mesh in spec.meshes:
        # The scale is set explicitly, because class defaults contain scales.
        name, mesh.scale = f"{mesh.name}.obj", np.ones(3)
        files[name] = _format_obj(model, mesh.id).encode()
        mesh.file, mesh.content_type = name, "model/obj"
        mesh.uservert, mesh.userface, mesh.usertexcoord = [], [], []
        mesh.usernormal, mesh.userfacetexcoord = [], []
    return files


def _format_obj(model: mujoco.MjModel, mesh: int) -> str:
    """Format a mesh as OBJ; MuJoCo stores its vertices relative to the center of mass."""

    def part(values: NDArray[Any], first: NDArray[Any], count: NDArray[Any]) -> NDArray[Any]:
        return values[first[mesh] : first[mesh] + count[mesh]]

    vertices = part(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum).astype(np.float64)
    vertices = vertices @ matrix_from_quat(model.mesh_quat[mesh]).T + model.mesh_pos[mesh]
    corners = part(model.mesh_face, model.mesh_faceadr, model.mesh_facenum) + 1
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    if model.mesh_texcoordadr[mesh] >= 0:
        points = part(model.mesh_texcoord, model.mesh_texcoordadr, model.mesh_texcoordnum)
        # MuJoCo counts image rows from the top, OBJ from the bottom.
        lines += [f"vt {u:.9g} {1 - v:.9g}" for u, v in points]
        textured = part(model.mesh_facetexcoord, model.mesh_faceadr, model.mesh_facenum) + 1
        lines += [
            "f " + " ".join(f"{a}/{b}" for a, b in zip(face, texture, strict=True))
            for face, texture in zip(corners, textured, strict=True)
        ]
    else:
        lines += [f"f {a} {b} {c}" for a, b, c in corners]
    return "\n".join(lines) + "\n"


def _export_textures(spec: mujoco.MjSpec, model: mujoco.MjModel) -> dict[str, bytes]:
    """Return PNG files of all image textures, by their new names in the description."""
    files = {}
    for texture in spec.textures:
        if texture.builtin != mujoco.mjtBuiltin.mjBUILTIN_NONE:
            continue
        height, width, channels = (
            int(size[texture.id]) for size in (model.tex_height, model.tex_width, model.tex_nchannel)
        )
        start = int(model.tex_adr[texture.id])
        image = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
        texture.file, texture.data = f"{texture.name}.png", b""
        files[texture.file] = encode_png(image)
    return files


def _format_csv(names: list[str], times_s: Array, controls: Array) -> str:
    rows = [",".join(f"{value:.9g}" for value in row) for row in np.column_stack([times_s, controls])]
    return "\n".join([",".join(names), *rows]) + "\n"
