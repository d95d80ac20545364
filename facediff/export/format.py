"""What an export format is: its base class, the options that users choose, and what several formats share."""

from __future__ import annotations

import inspect
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.animation.options import ExportOptions, Up
from facediff.errors import FaceDiffError
from facediff.mesh import read_mesh
from facediff.mesh.textures import Textures, read_textures
from facediff.render.meshes import face_outward, vertex_normals
from facediff.utils.colours import to_linear

MARK = b"facediff"  # Stands near the start of every file that is written without having been named by the user

SOUND_PIECE = 1 << 20
"""Samples of the speech that are converted at a time."""


class Format(ABC):
    """A file format that animations are written in.

    A format is registered under its suffix without the dot, and the first line of its docstring describes it in
    ``facediff components export_format``. What all formats have in common, such as checking the animations and the
    options, naming files, writing the .wav and replacing old files only by complete new ones, is done by
    :func:`facediff.export.write_animations`. Another package adds a format with an entry point::

        [project.entry-points."facediff.export_format"]
        bounds = "my_package.bounds:Bounds"

    after which ``facediff export hello.npz -o hello.bounds`` writes it.

    Example:
        >>> class Bounds(Format):
        ...     '''Text: the box around the vertices of every frame.'''
        ...
        ...     def write(self, path, animations, options):
        ...         (animation,) = animations
        ...         space = FileSpace.of(animation, options)
        ...         path.write_text("".join(f"{v.min(0)} {v.max(0)}" for v in space.frames(animation)))
        >>> Bounds().help
        'Text: the box around the vertices of every frame'
    """

    next_step: ClassVar[str] = ""
    """What to do with the file, printed after it was written."""
    holds_several: ClassVar[bool] = False
    """Whether one file shows several animations next to each other; else every animation gets its own file."""
    speech: ClassVar[Literal["in the file", "next to it", "none"]] = "none"
    """Where the speech is written; "next to it" as a .wav file."""
    needs_mesh: ClassVar[bool] = True
    """Whether an animation without triangles is refused."""
    needs_shapes: ClassVar[bool] = False
    """Whether the option ``shapes`` is required."""
    is_folder: ClassVar[bool] = False
    """Whether an animation becomes a folder of files: ``-o hello.obj`` writes ``hello_obj/hello_0000.obj`` …"""
    units: ClassVar[Literal["any", "m", "none"]] = "any"
    """Units of length that a user may choose: any, metres only, or none where the file has no lengths."""
    up_axes: ClassVar[tuple[Up, ...]] = ("y", "z")
    """Axes that may point up."""
    uses: ClassVar[tuple[str, ...]] = ()
    """Which of the options ``view``, ``size``, ``video_rate``, ``tolerance``, ``shapes``, ``tracks``, ``key_tolerance``
    and ``surface`` it uses; the command line refuses others."""
    requires: ClassVar[tuple[str, str] | None] = None
    """An optional package that writing needs: its import name, and the extra of facediff that installs it."""

    @abstractmethod
    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write animations to a file.

        Args:
            path: the file, in a hidden folder; everything in that folder is moved to where the user wanted it. A format
                with ``is_folder`` makes :func:`folder_of` instead.
            animations: one animation, or all of them where the format ``holds_several``.
            options: what the user chose, checked.
        """

    def companions(self, path: Path, animation: Animation) -> list[Path]:
        """Files that are written next to ``path`` without having been named by the user, other than the speech."""
        return []

    @property
    def help(self) -> str:
        """The format in one line."""
        return (inspect.getdoc(self) or "").partition("\n")[0].rstrip(".")


@dataclass(frozen=True)
class FileSpace:
    """The unit of length and the axes of a file."""

    unit: str
    metres: float  # in one unit
    up: Up
    factor: float  # what the animation's coordinates are multiplied by

    @classmethod
    def of(cls, animation: Animation, options: ExportOptions, prescribed: str | None = None) -> FileSpace:
        """The space that the user chose, else the format's prescribed unit, else the animation's, with y up."""
        unit = options.output_unit or prescribed or animation.unit
        metres = metres_per_unit(unit)
        return cls(unit, metres, options.up or "y", metres_per_unit(animation.unit) / metres)

    def place(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
        """Convert an animation's positions (…, 3) to this space.

        z up is a rotation by +90° about x: (x, y, z) becomes (x, −z, y), so that a face which looked along +z looks
        along −y, which is the front in programs with z up.
        """
        moved = points * self.factor if self.factor != 1 else points
        if self.up == "z":
            moved = np.stack([moved[..., 0], -moved[..., 2], moved[..., 1]], -1)
        with np.errstate(over="ignore"):  # is refused
            placed = np.asarray(moved, np.float32)
        if not np.isfinite(placed).all():
            raise FaceDiffError(f"unit {self.unit}: single precision does not hold these coordinates; choose another")
        return placed

    def frames(self, animation: Animation) -> Iterator[npt.NDArray[np.float32]]:
        """Frame after frame (V, 3), so that a memory map is never read as a whole."""
        return (self.place(np.asarray(frame)) for frame in animation.frames())


def check_animation(animation: Animation, *, needs_mesh: bool = True) -> None:
    """Refuse an animation that would make a broken file."""
    animation.refuse_not_finite()
    if needs_mesh:
        _ = animation.triangles


def facts(animation: Animation, space: FileSpace) -> dict[str, object]:
    """The facts that are written into every file which has room for text."""
    return {
        "name": animation.name,
        "frame_rate": animation.frame_rate,
        "frames": len(animation.vertices),
        "unit": space.unit,
        "metres_per_unit": space.metres,
        "up": space.up,
        "metadata": dict(animation.metadata),
    }


def surface_of(animation: Animation, options: ExportOptions) -> Textures | None:
    """The texture coordinates and materials that the options ask for."""
    if options.surface is None:
        return None
    path = Path(options.surface)
    surface = read_textures(path, len(animation.triangles))
    if not np.array_equal(np.sort(read_mesh(path).faces), np.sort(animation.triangles)):
        raise FaceDiffError(
            f"{path}: its triangles are not the animation's, or in another order; give the file of that mesh, written "
            "with the order of its faces kept"
        )
    return surface


def outward(animation: Animation) -> npt.NDArray[np.int32]:
    """The triangles (F, 3), counter-clockwise seen from outside."""
    return face_outward(animation.triangles.astype(np.int32, copy=False), animation.template.astype(np.float64))


def normals_of(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
    """Unit normals (V, 3)."""
    return vertex_normals(vertices.astype(np.float64), faces).astype(np.float32)


def linear_colours(colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """SRGB bytes (V, 3) as linear light from 0 to 1."""
    return np.asarray(to_linear(colours / 255), np.float32)


def folder_of(path: Path) -> Path:
    """The folder of a sequence that was asked for as a file: ``hello.obj`` gives ``hello_obj``."""
    return path.with_name(f"{path.stem}_{path.suffix[1:]}")


def speech_wav(animation: Animation) -> Iterator[bytes] | None:
    """The speech as a .wav file of 16 bits in pieces, exactly as long as the motion; None for a silent animation."""
    sound = animation.sound()
    if sound is None:
        return None
    # Readers divide by 32768, so that a 16-bit recording comes back bit by bit.
    pieces = (sound[first : first + SOUND_PIECE] for first in range(0, len(sound), SOUND_PIECE))
    data = (np.clip(np.rint(piece * 32768), -32768, 32767).astype("<i2").tobytes() for piece in pieces)
    rate, size = animation.sample_rate, 2 * len(sound)
    # The standard library's module wave cannot write the entry ISFT (software). It comes before the samples, where it
    # is looked for before a file is replaced: an export replaces its own .wav but never a recording of the user's.
    chunks = [
        (b"fmt ", struct.pack("<HHIIHH", 1, 1, rate, 2 * rate, 2, 16)),
        (b"LIST", b"INFOISFT" + struct.pack("<I", 10) + MARK + b"\0\0"),
    ]
    head = b"WAVE" + b"".join(name + struct.pack("<I", len(content)) + content for name, content in chunks)
    head += b"data" + struct.pack("<I", size)
    return chain([b"RIFF" + struct.pack("<I", len(head) + size) + head], data)
