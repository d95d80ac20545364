"""Turn a .glb of `facediff export` into .fbx with Blender, the motion at its own frame rate.

Run `blender --background --python glb_to_fbx.py -- hello.glb hello.fbx`, or `python glb_to_fbx.py hello.glb hello.fbx`
where bpy is installed with pip.
"""

from __future__ import annotations

import argparse
import json
import sys

import bpy  # type: ignore[import-not-found]  # Blender runs this file


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


def convert(glb: str, fbx: str, rate: float, frames: int) -> None:
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
    bpy.ops.export_scene.fbx(
        filepath=fbx,
        # Pictures of a .glb have no files of their own, which Blender would refer to.
        path_mode="COPY",
        embed_textures=True,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_simplify_factor=0.0,
    )


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("glb")
    parser.add_argument("fbx")
    options = parser.parse_args(arguments)
    convert(options.glb, options.fbx, *facts_of(options.glb))
