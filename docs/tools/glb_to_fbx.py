"""Turn a .glb of `facediff export` into .fbx with Blender, the motion at its own frame rate.

    blender --background --python glb_to_fbx.py -- hello.glb hello.fbx
    python glb_to_fbx.py hello.glb hello.fbx            # where bpy is installed with pip

``--key-tolerance 0.01`` leaves out the keys of each curve that a straight line replaces to within so much of a weight.
"""

import argparse
import sys

import bpy


def thin(curve: bpy.types.FCurve, tolerance: float) -> None:
    """Keep the keys of a curve between which no key is further than the tolerance from the straight line."""
    points = [(key.co[0], key.co[1]) for key in curve.keyframe_points]
    kept, spans = {0, len(points) - 1}, [(0, len(points) - 1)]
    while spans:
        first, last = spans.pop()
        (t0, v0), (t1, v1) = points[first], points[last]
        apart = [
            (abs(v - v0 - (t - t0) / (t1 - t0) * (v1 - v0)), index)
            for index, (t, v) in enumerate(points[first + 1 : last], first + 1)
        ]
        if apart and max(apart)[0] > tolerance:
            kept.add(max(apart)[1])
            spans += [(first, max(apart)[1]), (max(apart)[1], last)]
    for index in reversed(range(len(points))):
        if index not in kept:
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


def convert(glb: str, fbx: str, tolerance: float) -> None:
    """Import the .glb into an empty scene and write its mesh, shapes and curves."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    # Blender keeps its own frame rate on import, and would put the keys between whole frames: ask the file first.
    bpy.ops.import_scene.gltf(filepath=glb)
    facts = next(dict(made.items()) for made in scene.objects if "frame_rate" in made)
    rate, frames = float(facts["frame_rate"]), int(facts["frames"])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = scene.render.fps / rate
    scene.frame_start, scene.frame_end = 0, frames - 1
    bpy.ops.import_scene.gltf(filepath=glb)
    if tolerance > 0:
        for action in bpy.data.actions:
            for curve in curves_of(action):
                thin(curve, tolerance)
    bpy.ops.export_scene.fbx(
        filepath=fbx,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        # The exporter samples every frame; above 0 it leaves out what lies on a straight line: the thinned curves.
        bake_anim_simplify_factor=1.0 if tolerance > 0 else 0.0,
    )


if __name__ == "__main__":
    own = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("glb")
    parser.add_argument("fbx")
    parser.add_argument("--key-tolerance", type=float, default=0.0)
    options = parser.parse_args(own)
    convert(options.glb, options.fbx, options.key_tolerance)
