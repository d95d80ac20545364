"""Imports exported files into Blender and measures how far their vertices are from the animation's.

Needs Blender as a module, in an environment of its own (tried with 5.0.1 on Python 3.11; 940 MB)::

    python -m venv blender && blender/bin/pip install bpy==5.0.1
    blender/bin/python tools/blender_check.py hello.npz hello.glb hello.usdc hello.pc2 hello.mdd hello_obj hello_ply

Prints the largest distance of a vertex over all frames, in millimetres, of an animation in metres. A .glb is also
converted to .fbx and .abc, and measured there. ``--picture FILE`` renders frames of the first file with Cycles on the
CPU.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import mathutils
import numpy as np

IMPORTERS: dict[str, Callable[[Path], Any]] = {
    ".glb": lambda path: bpy.ops.import_scene.gltf(filepath=str(path)),
    ".usdc": lambda path: bpy.ops.wm.usd_import(filepath=str(path)),
    ".usda": lambda path: bpy.ops.wm.usd_import(filepath=str(path)),
    ".fbx": lambda path: bpy.ops.wm.fbx_import(filepath=str(path)),
    ".abc": lambda path: bpy.ops.wm.alembic_import(filepath=str(path)),
    ".obj": lambda path: bpy.ops.wm.obj_import(filepath=str(path)),
    ".ply": lambda path: bpy.ops.wm.ply_import(filepath=str(path)),
}


def load(path: Path, frame_rate: float) -> bpy.types.Object:
    """Import into an empty scene and return the mesh."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = round(frame_rate), round(frame_rate) / frame_rate
    cache = path.suffix in (".pc2", ".mdd")
    file = path.with_suffix(".obj") if cache else path
    IMPORTERS[file.suffix](file)
    mesh = next(thing for thing in scene.objects if thing.type == "MESH")
    if cache:
        modifier = mesh.modifiers.new("cache", "MESH_CACHE")
        modifier.cache_format, modifier.filepath = path.suffix[1:].upper(), str(path)
    return mesh


def positions(thing: bpy.types.Object) -> np.ndarray[Any, Any]:
    """Vertices (V, 3) of the scene's current frame in world coordinates, z up."""
    mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    world = np.array(thing.matrix_world)
    return flat.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]


def worst(path: Path, truth: np.ndarray[Any, Any], frame_rate: float, first: int = 0) -> float:
    """Largest distance over all frames, of a file whose frame 0 is the scene's frame ``first``."""
    distances = []
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in (".obj", ".ply"))
        for file, frame in zip(files, truth, strict=True):
            made = positions(load(file, frame_rate))
            # .ply does not define axes: its numbers stay as they are.
            turned = made if file.suffix == ".obj" else made @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
            distances.append(np.linalg.norm(turned - frame, axis=-1).max())
        return float(max(distances))
    mesh = load(path, frame_rate)
    for index, frame in enumerate(truth):
        bpy.context.scene.frame_set(index + first)
        distances.append(np.linalg.norm(positions(mesh) - frame, axis=-1).max())
    return float(max(distances))


def convert(glb: Path, folder: Path, frames: int, frame_rate: float) -> dict[str, Path]:
    """Convert a .glb to .fbx and .abc."""
    load(glb, frame_rate)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 0, frames - 1
    fbx, alembic = folder / "a.fbx", folder / "a.abc"
    # With its defaults the exporter writes the shapes without their animation.
    bpy.ops.export_scene.fbx(
        filepath=str(fbx),
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_simplify_factor=0.0,
    )
    bpy.ops.wm.alembic_export(filepath=str(alembic), start=0, end=frames - 1)
    return {"fbx": fbx, "abc": alembic}


def picture(path: Path, frame_rate: float, frames: list[int], png: Path) -> None:
    """Render frames next to each other."""
    mesh, scene = load(path, frame_rate), bpy.context.scene
    corners = [mesh.matrix_world @ mathutils.Vector(corner) for corner in mesh.bound_box]
    middle = sum(corners, mathutils.Vector()) / 8
    height = max(corner.z for corner in corners) - min(corner.z for corner in corners)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.angle = math.radians(18)
    camera.location = middle + mathutils.Vector((-1.2, -3.2, 0)) * height
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "AREA"))
    lamp.data.energy, lamp.data.size = 160 * height**2, 2 * height
    lamp.location = middle + mathutils.Vector((-2.5, -4, 2.5)) * height
    for thing in (camera, lamp):
        thing.rotation_euler = (middle - thing.location).to_track_quat("-Z", "Y").to_euler()
        scene.collection.objects.link(thing)
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (0.6, 0.62, 0.66, 1)
    scene.camera, scene.render.engine, scene.cycles.samples = camera, "CYCLES", 64
    scene.cycles.use_denoising, scene.view_settings.view_transform = False, "Standard"
    scene.render.resolution_x = scene.render.resolution_y = 180
    panels = []
    with tempfile.TemporaryDirectory() as folder:
        for frame in frames:
            scene.frame_set(frame)
            scene.render.filepath = f"{folder}/{frame}.png"
            bpy.ops.render.render(write_still=True)
            image = bpy.data.images.load(scene.render.filepath)
            panels.append(np.array(image.pixels[:]).reshape(180, 180, 4))
    sheet = bpy.data.images.new("sheet", 180 * len(panels), 180)
    sheet.pixels = np.concatenate(panels, axis=1).ravel()
    sheet.filepath_raw, sheet.file_format = str(png.resolve()), "PNG"
    sheet.save()


def main() -> None:
    """Measure and render."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("animation", type=Path, help=".npz that the files were exported from")
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", default=[0, 15, 23, 31], help="of the picture")
    args = parser.parse_args()
    with np.load(args.animation, allow_pickle=False) as archive:
        about = json.loads(str(archive["about"]))
        vertices = archive["vertices"]
    truth = np.stack([vertices[..., 0], -vertices[..., 2], vertices[..., 1]], -1)  # z up
    rate = float(about["frame_rate"])
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        for file in args.files:
            lines.append(f"{file.name}: {1000 * worst(file, truth, rate):.5f} mm")
            for name, made in convert(file, Path(folder), len(truth), rate).items() if file.suffix == ".glb" else ():
                first = 1 if name == "fbx" else 0  # Blender's frames of an .fbx start at 1
                lines.append(f"{file.name} through {name}: {1000 * worst(made, truth, rate, first):.5f} mm")
    if args.picture is not None:
        picture(args.files[0], rate, args.frames, args.picture)
    print(f"Blender {bpy.app.version_string}, {len(truth)} frames of {truth.shape[1]} vertices", *lines, sep="\n")


if __name__ == "__main__":
    main()
