"""Turn a .glb of `facediff export` into .fbx with Blender, the motion at its own frame rate.

    blender --background --python glb_to_fbx.py -- hello.glb hello.fbx
    python glb_to_fbx.py hello.glb hello.fbx            # where bpy is installed with pip

``--key-tolerance 0.01`` leaves out the keys of each curve that a straight line replaces to within so much of a weight.
The sound next to the .glb is a strip of the scene, which ``--blend hello.blend`` keeps; .fbx has no place for it.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import bpy  # type: ignore[import-not-found]  # Blender runs this file


def thin(curve: bpy.types.FCurve, tolerance: float) -> None:
    """Keep the keys of a curve between which no key is further than the tolerance from the straight line."""
    points = [(key.co[0], key.co[1]) for key in curve.keyframe_points]
    keys, spans = {0, len(points) - 1}, [(0, len(points) - 1)]
    while spans:
        first, last = spans.pop()
        (t0, v0), (t1, v1) = points[first], points[last]
        apart = [
            (abs(v - v0 - (t - t0) / (t1 - t0) * (v1 - v0)), index)
            for index, (t, v) in enumerate(points[first + 1 : last], first + 1)
        ]
        if apart and max(apart)[0] > tolerance:
            keys.add(max(apart)[1])
            spans += [(first, max(apart)[1]), (max(apart)[1], last)]
    for index in reversed(range(len(points))):
        if index not in keys:
            curve.keyframe_points.remove(curve.keyframe_points[index], fast=True)
    curve.update()
    for key in curve.keyframe_points:
        key.interpolation = "LINEAR"


def curves_of(action: bpy.types.Action) -> list[bpy.types.FCurve]:
    """All curves of an action, which lie in layers since Blender 4.4."""
    if hasattr(action, "fcurves"):
        return list(action.fcurves)
    bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    return [curve for bag in bags for curve in bag.fcurves]


def facts_of(glb: str) -> tuple[float, int]:
    """Frame rate and number of frames, as a .glb of facediff has them, or by the times of its first animation."""
    with open(glb, "rb") as file:
        content = json.loads(file.read(int.from_bytes(file.read(20)[12:16], "little")))
    facts = next((node["extras"] for node in content["nodes"] if "frame_rate" in node.get("extras", {})), None)
    if facts is not None:
        return float(facts["frame_rate"]), int(facts["frames"])
    if not content.get("animations"):
        sys.exit(f"{glb}: has no animation; write it with `facediff export` or `facediff retarget`")
    times = content["accessors"][content["animations"][0]["samplers"][0]["input"]]
    last = times["max"][0]
    return round((times["count"] - 1) / last, 3) if last > 0 else 25.0, times["count"]


def add_sound(scene: bpy.types.Scene, wav: Path) -> None:
    """Let a scene play a sound from its first frame on."""
    editor = scene.sequence_editor_create()
    strips = editor.strips if hasattr(editor, "strips") else editor.sequences  # renamed in Blender 4.4
    strips.new_sound("speech", str(wav), 1, 0)


def convert(glb: str, fbx: str, tolerance: float, rate: float, frames: int, blend: str | None) -> None:
    """Import the .glb into an empty scene and write its mesh, shapes and curves."""
    # Blender keeps its own frame rate on import, and would put the keys between whole frames.
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = scene.render.fps / rate
    scene.frame_start, scene.frame_end = 0, frames - 1
    bpy.ops.import_scene.gltf(filepath=glb)
    helpers = bpy.data.collections.get("glTF_not_exported")  # the ball by which the importer draws bones
    for ball in [] if helpers is None else list(helpers.objects):
        bpy.data.objects.remove(ball)
    if tolerance > 0:
        for action in bpy.data.actions:
            for curve in curves_of(action):
                thin(curve, tolerance)
    wav = Path(glb).resolve().with_suffix(".wav")
    if wav.is_file():
        add_sound(scene, wav)
    if blend is not None:
        bpy.ops.wm.save_as_mainfile(filepath=str(Path(blend).resolve()))
    bpy.ops.export_scene.fbx(
        filepath=fbx,
        # Pictures of a .glb have no files of their own, which Blender would refer to.
        path_mode="COPY",
        embed_textures=True,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        # The exporter samples every frame; above 0 it leaves out what lies on a straight line: the thinned curves.
        bake_anim_simplify_factor=1.0 if tolerance > 0 else 0.0,
    )


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("glb")
    parser.add_argument("fbx")
    parser.add_argument("--key-tolerance", type=float, default=0.0)
    parser.add_argument("--blend")
    options = parser.parse_args(arguments)
    convert(options.glb, options.fbx, options.key_tolerance, *facts_of(options.glb), options.blend)
