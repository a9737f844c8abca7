"""Imports an animation into Blender, compares it with what was computed, and renders a frame. Needs bpy.

    python in_blender.py ANIMATION.usdc KEPT.npz PICTURE.png

The last line of standard output is JSON: what was found, and what differs.
"""

import json
import sys

import bpy
import numpy as np
from mathutils import Vector

SIZE = (640, 480)
SAMPLES = 24


def vertices(mesh) -> np.ndarray:
    """Vertex positions (n, 3) float32 as Blender holds them."""
    values = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", values)
    return values.reshape(-1, 3)


def colors(mesh) -> np.ndarray:
    """The attribute displayColor (n, 3) float32, in linear light."""
    attribute = mesh.attributes["displayColor"]
    values = np.empty(4 * len(attribute.data), np.float32)
    attribute.data.foreach_get("color", values)
    return values.reshape(-1, 4)[:, :3]


def compare(kept) -> tuple[list[str], str]:
    """What differs from what was kept, and what is the same."""
    problems = []
    scene = bpy.context.scene
    names = [str(name) for name in kept["names"]]
    frames = len(kept[f"{names[0]}.points"])
    if (scene.frame_start, scene.frame_end) != (0, frames - 1):
        problems.append(f"the range of frames is {scene.frame_start} to {scene.frame_end}, not 0 to {frames - 1}")
    for name in names:
        surface = bpy.data.objects[f"{name}_surface"]
        (material,) = surface.data.materials
        sources = [node.attribute_name for node in material.node_tree.nodes if node.type == "ATTRIBUTE"]
        if sources != ["displayColor"]:
            problems.append(f"{name}: its material takes its colour from {sources}, not from displayColor")
        up = np.array(surface.matrix_world.to_3x3() @ Vector((0, 1, 0) if kept["up_axis"] == "Y" else (0, 0, 1)))
        if not np.allclose(up, (0, 0, 1), atol=1e-6):
            problems.append(f"{name}: its upward axis becomes {up}")
    count = 0
    for frame in range(frames):
        scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        for name in names:
            shown = bpy.data.objects[f"{name}_surface"].evaluated_get(graph)
            mesh = shown.to_mesh()
            x, color = vertices(mesh), colors(mesh)
            count += len(x)
            expected = kept[f"{name}.points"][frame]
            if x.shape != expected.shape or x.tobytes() != expected.tobytes():
                problems.append(f"frame {frame}: vertices of {name} differ")
            if not np.array_equal(color, kept[f"{name}.colors"][frame]):
                problems.append(f"frame {frame}: colours of {name} differ")
            shown.to_mesh_clear()
    return problems, f"{count} vertices in {frames} frames equal to the last bit in Blender {bpy.app.version_string}"


def render(path: str) -> None:
    """Renders the frame in the middle by Cycles, from a place that sees all bodies."""
    scene = bpy.context.scene
    scene.frame_set(scene.frame_end // 2)
    graph = bpy.context.evaluated_depsgraph_get()
    bodies = [o for o in bpy.data.objects if o.type == "MESH" and o.name.endswith("_surface")]
    corners = np.array([o.matrix_world @ v.co for o in bodies for v in o.evaluated_get(graph).data.vertices])
    middle, size = corners.mean(axis=0), float(np.ptp(corners, axis=0).max())
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = middle + size * np.array([1.6, -2.4, 0.9])
    camera.rotation_euler = Vector(middle - np.array(camera.location)).to_track_quat("-Z", "Y").to_euler()
    camera.data.clip_end = 100.0 * size
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy = 3.0
    sun.rotation_euler = (0.9, 0.0, 0.9)
    for thing in (camera, sun):
        scene.collection.objects.link(thing)
    world = bpy.data.worlds.new("World")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.7, 0.75, 0.8, 1.0)
    scene.world, scene.camera = world, camera
    scene.view_settings.view_transform = "Standard"  # colours as they are
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", SAMPLES, False
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.render.filepath = path
    scene.render.image_settings.file_format = "PNG"
    bpy.ops.render.render(write_still=True)


def colourfulness(path: str) -> float:
    """The greatest difference between red, green and blue of a pixel, 0 to 1."""
    pixels = np.array(bpy.data.images.load(path).pixels[:]).reshape(-1, 4)[:, :3]
    return float(np.ptp(pixels, axis=1).max())


def main() -> None:
    animation, kept, picture = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=animation)
    problems, summary = compare(np.load(kept))
    render(picture)
    if colourfulness(picture) < 0.3:
        problems.append("the rendered picture has no colours")
    print("\n" + json.dumps({"problems": problems, "summary": summary}))


main()
