"""What a format of files is, and how a take is laid into its space."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.errors import FaceDiffError
from facediff.render.rasteriser import face_outward, to_linear, vertex_normals

# How takes are written, whatever the format.

Up = Literal["y", "z"]


@dataclass(frozen=True)
class ExportOptions:
    """Choices of a user; a format looks at those that concern it.

    Attributes:
        unit: unit of length to convert to, as :func:`facediff.animation.metres_per_unit` takes it; None for what the
            format prescribes (metres in glTF), else the take's own.
        up: the axis that points up in the file; None for what the format prescribes, else y, which takes have up.
        speech: write the take's sound beside the animation, where the file cannot hold it.
        view: camera of a video: ``front``, ``three_quarter`` or ``side``.
        size: height and width of a video's panels in pixels.
        shapes: the set of shapes that weights are solved for: a folder of meshes, or a glb with named targets.
        tolerance_mm: how far a compressed mesh may lie from the vertices, in millimetres.
        footer: text under a video, such as "synthetic corpus".
        quiet: no progress bars.
    """

    unit: str | None = None
    up: Up | None = None
    speech: bool = True
    view: str = "front"
    size: int = 512
    shapes: Path | None = None
    tolerance_mm: float = 0.05
    footer: str = ""
    quiet: bool = True


Writer = Callable[[Path, Sequence[Animation], ExportOptions, str | None], None]
"""Writes takes to a file in a folder that nobody else sees; what else it puts into that folder comes along.

The last argument is the name of the .wav to write beside; None where there is to be none.
"""


@dataclass(frozen=True)
class Format:
    """One kind of file.

    Attributes:
        help: what it is and for whom, in a few words.
        write: the writer; it gets one take, or all where ``several``.
        then: what to do with the file, for people who wrote their first.
        several: one file shows several takes next to each other; else every take gets a file of its own.
        holds_sound: the speech is in the file itself.
        sound_beside: the speech is written beside the file as .wav.
        needs_mesh: a take without triangles cannot be written.
        folder: the takes become folders of files: ``-o hello.obj`` gives ``hello_obj/hello_0000.obj`` …
        unit: units of length that a user may choose: any, metres only, or none where the file has no lengths.
        ups: axes that may point up.
        package: what it needs beside NumPy: import name and the extra of facediff that brings it.
    """

    help: str
    write: Writer
    then: str
    several: bool = False
    holds_sound: bool = False
    sound_beside: bool = False
    needs_mesh: bool = True
    folder: bool = False
    unit: Literal["any", "m", "none"] = "any"
    ups: tuple[Up, ...] = ("y", "z")
    package: tuple[str, str] | None = None


@dataclass(frozen=True)
class Space:
    """The unit and the axes of a file.

    Attributes:
        unit: unit of length in words.
        metres: metres in one unit.
        up: the axis that points up.
        factor: what the take's numbers are multiplied by.
    """

    unit: str
    metres: float
    up: Up
    factor: float

    @classmethod
    def of(cls, animation: Animation, options: ExportOptions, prescribed: str | None = None) -> Space:
        """The space that a user chose, else the format's, else the take's own with y up."""
        unit = options.unit or prescribed or animation.unit
        metres = metres_per_unit(unit)
        return cls(unit, metres, options.up or "y", metres_per_unit(animation.unit) / metres)

    def place(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
        """Positions (…, 3) of a take in this space.

        z up is a turn by +90° about x: (x, y, z) becomes (x, −z, y), so that a face which looked along +z looks along
        −y, the front of programs with z up.
        """
        moved = points * self.factor if self.factor != 1 else points
        if self.up == "z":
            moved = np.stack([moved[..., 0], -moved[..., 2], moved[..., 1]], -1)
        return np.asarray(moved, np.float32)

    def frames(self, animation: Animation) -> Iterator[npt.NDArray[np.float32]]:
        """Frame after frame (V, 3), so that a memory map is never read as a whole."""
        return (self.place(np.asarray(frame)) for frame in animation.frames())


def facts(animation: Animation, space: Space) -> dict[str, object]:
    """What is written into every file that has a place for words."""
    return {
        "name": animation.name,
        "frame_rate": animation.frame_rate,
        "frames": len(animation.vertices),
        "unit": space.unit,
        "metres_per_unit": space.metres,
        "up": space.up,
        "metadata": dict(animation.metadata),
    }


# Where exported files go: names, what may be overwritten, and all of them at once or none.

MARK = b"facediff"
"""Stands near the start of every file that is written without having been named by the user."""

RECORD = "sequence.json"
"""The file that tells a folder of frames from any other folder."""


def numbered(path: Path, count: int) -> list[Path]:
    """One path per take: the path itself for one, ``NAME_take1.glb``, ``NAME_take2.glb`` … for several."""
    if count == 1:
        return [path]
    return [path.with_name(f"{path.stem}_take{index + 1}{path.suffix}") for index in range(count)]


def folder_of(path: Path) -> Path:
    """The folder of a sequence that was asked for as a file: ``hello.obj`` gives ``hello_obj``."""
    return path.with_name(f"{path.stem}_{path.suffix[1:]}")


def is_free(path: Path) -> bool:
    """Whether nothing lies there, or something that facediff wrote; of a folder, that nobody put anything else into.

    Raises:
        FaceDiffError: if what lies there cannot be read.
    """
    if not path.exists():
        return True
    try:
        if path.is_dir():
            files = list(path.iterdir())
            recorded = not files or (path / RECORD) in files
            return recorded and all(file.is_file() and is_free(file) for file in files)
        with path.open("rb") as stream:
            return MARK in stream.read(200)
    except OSError as error:
        raise FaceDiffError(
            f"{path}: is in the way and cannot be read ({error.strerror}); choose another -o"
        ) from error


def check_free(path: Path) -> None:
    """Refuse a file or folder that the user did not name, where something lies that facediff did not write.

    Raises:
        FaceDiffError: naming what lies there.
    """
    if not is_free(path):
        what = "is a folder with files" if path.is_dir() else "is a file"
        raise FaceDiffError(
            f"{path}: {what} that facediff did not write, and would be replaced; choose another -o, or move it"
        )


@contextmanager
def staged(path: Path) -> Iterator[Path]:
    """A hidden folder beside ``path``; whatever is in it at the end moves beside ``path``, all of it or nothing.

    Raises:
        FaceDiffError: if the place cannot be written, the disk is full, or a folder is in the way.
    """
    parent = path.parent
    made = [folder for folder in (parent, *parent.parents) if not folder.exists()]
    hidden = parent / f".{path.stem}.partial-{os.getpid()}-{secrets.token_hex(4)}"
    done = False
    try:
        parent.mkdir(parents=True, exist_ok=True)
        hidden.mkdir()
        yield hidden
        arrivals = sorted(hidden.iterdir())
        for arrival in arrivals:
            if (parent / arrival.name).is_dir() != arrival.is_dir() and (parent / arrival.name).exists():
                raise FaceDiffError(f"{parent / arrival.name}: is in the way; move it, or choose another -o")
        for arrival in arrivals:
            _move(arrival, parent / arrival.name)
        done = True
    except OSError as error:
        raise FaceDiffError(
            f"{path}: cannot be written ({error.strerror or error}); nothing was left there, so make room or choose "
            f"another folder"
        ) from error
    except FaceDiffError as error:
        # A writer that was handed the hidden folder names it; people know their own.
        if str(hidden) not in str(error):
            raise
        raise FaceDiffError(str(error).replace(str(hidden), str(parent))) from error
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
        for folder in [] if done else made:
            with suppress(OSError):
                folder.rmdir()


def _move(source: Path, target: Path) -> None:
    """Rename; a folder of an earlier export steps aside and is removed after."""
    if not target.is_dir():
        os.replace(source, target)
        return
    aside = source.with_name(f"{source.name}.old")
    os.rename(target, aside)
    try:
        os.rename(source, target)
    except OSError:
        os.rename(aside, target)
        raise


def record(facts: dict[str, object]) -> bytes:
    """The content of :data:`RECORD`."""
    return json.dumps({"format": "facediff sequence 1", **facts}, ensure_ascii=False, indent=1).encode()


# What the files say about a mesh beside its positions.


def outward(animation: Animation) -> npt.NDArray[np.int32]:
    """The triangles, counter-clockwise seen from outside.

    Raises:
        FaceDiffError: if the take has none.
    """
    return face_outward(animation.triangles.astype(np.int32, copy=False), animation.template.astype(np.float64))


def normals_of(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
    """Unit normals (V, 3)."""
    return vertex_normals(vertices.astype(np.float64), faces).astype(np.float32)


def linear_colours(colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Linear light within 0 and 1 of sRGB bytes (V, 3)."""
    return np.asarray(to_linear(colours / 255), np.float32)


# The speech beside an animation: 16-bit PCM in a RIFF WAVE file that says who wrote it.


def speech_name(path: Path) -> str:
    """The file beside ``path`` for the speech: ``hello.wav``, or ``hello_speech.wav`` where the former is the user's.

    Raises:
        FaceDiffError: if neither is free.
    """
    plain = path.with_suffix(".wav")
    if is_free(plain):
        return plain.name
    other = path.with_name(f"{path.stem}_speech.wav")
    check_free(other)
    return other.name


def write_wav(path: Path, animation: Animation) -> None:
    """Write the speech, exactly as long as the motion.

    The entry ISFT (software) comes before the samples, so that an export never overwrites a recording of the user's.

    Raises:
        FaceDiffError: if the speech is not finite.
    """
    sound = animation.sound()
    if sound is None:
        return
    if not np.isfinite(sound).all():
        raise FaceDiffError(f"{animation.name}: its speech holds NaN or infinity; read the recording anew")
    # Readers divide by 32768, so that a 16-bit recording comes back bit by bit.
    data = np.clip(np.rint(sound * 32768), -32768, 32767).astype("<i2").tobytes()
    rate = animation.sample_rate
    chunks = [
        (b"fmt ", struct.pack("<HHIIHH", 1, 1, rate, 2 * rate, 2, 16)),
        (b"LIST", b"INFOISFT" + struct.pack("<I", 10) + b"facediff\0\0"),
        (b"data", data),
    ]
    body = b"WAVE" + b"".join(name + struct.pack("<I", len(content)) + content for name, content in chunks)
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)


# A folder with a file for every frame, the speech and a record of what it is.


def write_folder(
    path: Path,
    animation: Animation,
    space: Space,
    sound: str | None,
    content: Callable[[npt.NDArray[np.float32]], bytes],
) -> None:
    """Write ``hello_obj/hello_0000.obj`` … for ``hello.obj``, with ``hello.wav`` and ``sequence.json``.

    Args:
        path: the name that was asked for.
        animation: the take.
        space: unit and axes.
        sound: name of the speech in the folder; None for none.
        content: a file's bytes from a frame's positions (V, 3).
    """
    folder = folder_of(path)
    folder.mkdir()
    digits = max(4, len(str(len(animation.vertices) - 1)))
    for index, points in enumerate(space.frames(animation)):
        (folder / f"{path.stem}_{index:0{digits}d}{path.suffix}").write_bytes(content(points))
    told = {**facts(animation, space), "files": f"{path.stem}_{'#' * digits}{path.suffix}"}
    if sound is not None:
        write_wav(folder / sound, animation)
        told["speech"] = sound
    (folder / RECORD).write_bytes(record(told))
