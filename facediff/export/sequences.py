"""Meshes for every frame (.obj, .ply) and point caches that move a mesh (.pc2, .mdd)."""

from __future__ import annotations

import struct
from abc import abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.animation.options import ExportOptions
from facediff.export.format import FileSpace, Format, facts, folder_of
from facediff.registry import export_format
from facediff.utils.plain_files import json_text

RECORD = "sequence.json"  # The file that tells a folder of frames from any other folder


class MeshSequence(Format):
    """A folder with a mesh for every frame, the speech, and a JSON file that describes them."""

    next_step = "any program reads the frames; sequence.json in the folder says the frame rate"
    speech = "next to it"
    is_folder = True

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write ``hello_obj/hello_0000.obj`` … and ``hello_obj/sequence.json`` for ``hello.obj``."""
        (animation,) = animations
        space = FileSpace.of(animation, options)
        folder = folder_of(path)
        folder.mkdir()
        frame_bytes = self.encoder(animation, space)
        digits = max(4, len(str(len(animation.vertices) - 1)))
        for index, points in enumerate(space.frames(animation)):
            (folder / f"{path.stem}_{index:0{digits}d}{path.suffix}").write_bytes(frame_bytes(points))
        record = {"format": "facediff sequence 1", **facts(animation, space)}
        record["files"] = f"{path.stem}_{'#' * digits}{path.suffix}"
        if options.speech_file is not None:
            record["speech"] = options.speech_file
        (folder / RECORD).write_bytes(json_text(path, record).encode())

    @abstractmethod
    def encoder(self, animation: Animation, space: FileSpace) -> Callable[[npt.NDArray[np.float32]], bytes]:
        """A function that gives a file's bytes from a frame's positions (V, 3)."""


@export_format.register("obj")
class ObjSequence(MeshSequence):
    """A folder with an .obj mesh for every frame."""

    def encoder(self, animation: Animation, space: FileSpace) -> Callable[[npt.NDArray[np.float32]], bytes]:
        """Vertices with nine digits, which give back every float32; colours follow them as sRGB from 0 to 1."""
        comment = f"# {_comment(animation, space)}\n"
        # Triangles are counted from 1 and keep the animation's order and winding.
        faces = "".join(f"f {a} {b} {c}\n" for a, b, c in (animation.triangles + 1).tolist()).encode()

        def encode(points: npt.NDArray[np.float32]) -> bytes:
            if animation.colours is None:
                rows = "v %.9g %.9g %.9g\n" * len(points) % tuple(points.ravel().tolist())
            else:
                table = np.concatenate([points.astype(np.float64), animation.colours / 255], axis=1)
                rows = "v %.9g %.9g %.9g %.4f %.4f %.4f\n" * len(points) % tuple(table.ravel().tolist())
            return f"{comment}{rows}".encode() + faces

        return encode


@export_format.register("ply")
class PlySequence(MeshSequence):
    """A folder with a binary .ply mesh for every frame."""

    def encoder(self, animation: Animation, space: FileSpace) -> Callable[[npt.NDArray[np.float32]], bytes]:
        """A header, little-endian vertices with sRGB bytes, and triangles."""
        colours = animation.colours
        names = () if colours is None else ("red", "green", "blue")
        properties = "".join(f"property uchar {name}\n" for name in names)
        header = (
            f"ply\nformat binary_little_endian 1.0\ncomment {_comment(animation, space)}\n"
            f"element vertex {len(animation.template)}\nproperty float x\nproperty float y\nproperty float z\n"
            f"{properties}element face {len(animation.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
        ).encode()
        faces = np.empty(len(animation.triangles), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, animation.triangles

        def encode(points: npt.NDArray[np.float32]) -> bytes:
            rows = np.empty(len(points), [("position", "<f4", 3), *([] if colours is None else [("colour", "u1", 3)])])
            rows["position"] = points
            if colours is not None:
                rows["colour"] = colours
            return header + rows.tobytes() + faces.tobytes()

        return encode


def _comment(animation: Animation, space: FileSpace) -> str:
    """One line with the program that wrote the file, the unit and the axes."""
    name, unit = " ".join(animation.name.split()), " ".join(space.unit.split())
    return (
        f"facediff: {name}, unit {unit} ({space.metres:g} m), {space.up} up, {animation.frame_rate:g} frames a second"
    )


class PointCache(Format):
    """Positions of every frame, and next to them the mesh at rest on which they are played."""

    next_step = "Blender: import the .obj, add the modifier Mesh Cache and choose this file: docs/programs.md"
    speech = "next to it"
    needs_mesh = False
    dtype: str

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write the header and the positions, and the mesh at rest where there are triangles."""
        (animation,) = animations
        space = FileSpace.of(animation, options)
        with path.open("wb") as stream:
            stream.write(self.header(animation))
            for points in space.frames(animation):
                stream.write(points.astype(self.dtype).tobytes())
        for mesh in self.companions(path, animation):
            mesh.write_bytes(ObjSequence().encoder(animation, space)(space.place(animation.template)))

    @abstractmethod
    def header(self, animation: Animation) -> bytes:
        """The bytes before the positions."""

    def companions(self, path: Path, animation: Animation) -> list[Path]:
        """The mesh at rest."""
        return [path.with_suffix(".obj")] if animation.faces is not None and len(animation.faces) else []


@export_format.register("pc2")
class Pc2(PointCache):
    """Point cache for Blender, 3ds Max; the mesh next to it as .obj."""

    dtype = "<f4"

    def header(self, animation: Animation) -> bytes:
        """One sample a frame from frame 0 on; the format has no place for the frame rate."""
        frames, vertices, _ = animation.vertices.shape
        return struct.pack("<12siiffi", b"POINTCACHE2\0", 1, vertices, 0.0, 1.0, frames)


@export_format.register("mdd")
class Mdd(PointCache):
    """Point cache with times for Blender, LightWave, Houdini; the mesh next to it as .obj."""

    dtype = ">f4"

    def header(self, animation: Animation) -> bytes:
        """The counts, and the time of every frame in seconds."""
        frames, vertices, _ = animation.vertices.shape
        return struct.pack(">ii", frames, vertices) + (np.arange(frames) / animation.frame_rate).astype(">f4").tobytes()
