"""Point caches: positions of every frame, to be played on a mesh that lies beside them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from facediff.animation import Animation
from facediff.export.format import ExportOptions, Format, Space, write_wav
from facediff.export.obj import rest_mesh


def write_pc2(path: Path, takes: Sequence[Animation], options: ExportOptions, sound: str | None) -> None:
    """PC2, little endian: one sample a frame from frame 0 on; the format has no place for the frame rate."""
    (animation,) = takes
    frames, vertices, _ = animation.vertices.shape
    space = Space.of(animation, options)
    with path.open("wb") as stream:
        stream.write(struct.pack("<12siiffi", b"POINTCACHE2\0", 1, vertices, 0.0, 1.0, frames))
        for points in space.frames(animation):
            stream.write(np.ascontiguousarray(points, "<f4").tobytes())
    write_beside(path, animation, space, sound)


def write_mdd(path: Path, takes: Sequence[Animation], options: ExportOptions, sound: str | None) -> None:
    """MDD, big endian: the time of every frame in seconds, then the positions."""
    (animation,) = takes
    frames, vertices, _ = animation.vertices.shape
    space = Space.of(animation, options)
    with path.open("wb") as stream:
        stream.write(struct.pack(">ii", frames, vertices))
        stream.write((np.arange(frames) / animation.frame_rate).astype(">f4").tobytes())
        for points in space.frames(animation):
            stream.write(points.astype(">f4").tobytes())
    write_beside(path, animation, space, sound)


def write_beside(path: Path, animation: Animation, space: Space, sound: str | None) -> None:
    """The mesh at rest, where there are triangles, and the speech."""
    if animation.faces is not None and len(animation.faces):
        path.with_suffix(".obj").write_bytes(rest_mesh(animation, space))
    if sound is not None:
        write_wav(path.with_name(sound), animation)


PC2 = Format(
    help="point cache for Blender, 3ds Max; the mesh beside it as .obj",
    write=write_pc2,
    then="Blender: import the .obj, add the modifier Mesh Cache and choose this file: docs/tools/blender.md",
    sound_beside=True,
    needs_mesh=False,
)
MDD = Format(
    help="point cache with times for Blender, LightWave, Houdini; the mesh beside it as .obj",
    write=write_mdd,
    then="Blender: import the .obj, add the modifier Mesh Cache and choose this file: docs/tools/blender.md",
    sound_beside=True,
    needs_mesh=False,
)
