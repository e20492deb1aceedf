"""Script inside Blender that reads a scene, then renders one image for every line of standard input.

No other module imports it: Blender's Python has its own packages.
"""

import json
import os
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np
from mathutils import Matrix  # pyright: ignore[reportMissingImports]

# Angle between faces beyond which an edge is sharp, [rad].
SHARP = 0.5
# Blender's camera looks along -z with y up.
OPENCV_TO_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])
SENSOR_MM = 36.0


def make_material(index: int, row: dict, folder: Path) -> bpy.types.Material:
    """Make a principled surface of one color or texture."""
    material = bpy.data.materials.new(f"material_{index}")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = row["roughness"]
    shader.inputs["Metallic"].default_value = row["metallic"]
    if row["texture"]:
        image = nodes.new("ShaderNodeTexImage")
        image.image = bpy.data.images.load(str(folder / row["texture"]))
        links.new(image.outputs["Color"], shader.inputs["Base Color"])
    else:
        srgb = np.array(row["color_srgb"])
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        shader.inputs["Base Color"].default_value = (*linear, 1.0)
    return material


def make_object(name: str, mesh: dict, material: bpy.types.Material) -> bpy.types.Object:
    """Make triangles with texture coordinates of their corners."""
    data = bpy.data.meshes.new(name)
    data.from_pydata(mesh["vertices"], [], mesh["faces"])
    if len(mesh["uvs"]):
        data.uv_layers.new().uv.foreach_set("vector", mesh["uvs"].astype(np.float32).ravel())
    data.shade_smooth()
    data.set_sharp_from_angle(angle=SHARP)
    data.materials.append(material)
    item = bpy.data.objects.new(name, data)
    bpy.context.collection.objects.link(item)
    return item


def make_light(light: dict) -> None:
    """Make an environment from Blender's own files, and an area light."""
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    image, turn = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
    coordinates = nodes.new("ShaderNodeTexCoord")
    path = Path(bpy.utils.system_resource("DATAFILES")) / "studiolights" / "world" / light["environment"]
    image.image = bpy.data.images.load(str(path))
    turn.inputs["Rotation"].default_value = (0.0, 0.0, light["turn"])
    links.new(coordinates.outputs["Generated"], turn.inputs["Vector"])
    links.new(turn.outputs["Vector"], image.inputs["Vector"])
    links.new(image.outputs["Color"], nodes["Background"].inputs["Color"])
    nodes["Background"].inputs["Strength"].default_value = light["strength"]
    if not light["lamp_w"]:
        return
    lamp = bpy.data.lights.new("lamp", "AREA")
    lamp.energy, lamp.size, lamp.color = light["lamp_w"], light["lamp_m"], light["lamp_color"]
    item = bpy.data.objects.new("lamp", lamp)
    item.matrix_world = Matrix(light["T_world_lamp"])
    bpy.context.collection.objects.link(item)


def read_scene(folder: Path) -> list[bpy.types.Object]:
    """Read the scene's objects, in the order of its meshes."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = json.loads((folder / "scene.json").read_text())
    arrays = np.load(folder / "meshes.npz")
    materials = [make_material(k, row, folder) for k, row in enumerate(scene["materials"])]
    objects = []
    for number, material in enumerate(scene["mesh_materials"]):
        mesh = {name: arrays[f"{name}_{number}"] for name in ("vertices", "faces", "uvs")}
        objects.append(make_object(f"mesh_{number}", mesh, materials[material]))
    make_light(scene["light"])
    render = bpy.context.scene.render
    render.engine, render.use_persistent_data = "CYCLES", True
    render.image_settings.file_format = "PNG"
    render.threads_mode, render.threads = "FIXED", len(os.sched_getaffinity(0))
    cycles, view = bpy.context.scene.cycles, bpy.context.scene.view_settings
    cycles.device, cycles.samples, cycles.use_denoising = "CPU", scene["samples"], True
    view.view_transform, view.exposure = scene["view_transform"], scene["exposure"]
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return objects


def draw(job: dict, objects: list[bpy.types.Object]) -> None:
    """Render one image of one state."""
    for item, T, hidden in zip(objects, job["Ts_world_mesh"], job["hidden"], strict=True):
        item.matrix_world, item.hide_render = Matrix(T), hidden
    camera, render = bpy.context.scene.camera, bpy.context.scene.render
    width, height = job["size"]
    render.resolution_x, render.resolution_y, render.filepath = width, height, job["file"]
    lens = camera.data
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", SENSOR_MM
    lens.lens = job["focal_px"] * SENSOR_MM / width
    lens.shift_x = (width / 2 - job["center_px"][0]) / width
    lens.shift_y = (job["center_px"][1] - height / 2) / width
    camera.matrix_world = Matrix(np.array(job["T_world_cam"]) @ OPENCV_TO_BLENDER)
    bpy.ops.render.render(write_still=True)


def main() -> None:
    """Reply to every job with a line that begins with DONE."""
    objects = read_scene(Path(sys.argv[1]))
    for line in sys.stdin:
        job = json.loads(line)
        draw(job, objects)
        print(f"\nDONE {job['file']}", flush=True)


if __name__ == "__main__":
    main()
