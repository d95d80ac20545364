"""What a format of files is, and how a take is laid into its space."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from facediff.export.options import ExportOptions, Up
from facediff.takes import Take, metres_per_unit

Writer = Callable[[Path, Sequence[Take], ExportOptions, str | None], None]
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
    def of(cls, take: Take, options: ExportOptions, prescribed: str | None = None) -> Space:
        """The space that a user chose, else the format's, else the take's own with y up."""
        unit = options.unit or prescribed or take.unit
        metres = metres_per_unit(unit)
        return cls(unit, metres, options.up or "y", metres_per_unit(take.unit) / metres)

    def place(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
        """Positions (…, 3) of a take in this space.

        z up is a turn by +90° about x: (x, y, z) becomes (x, −z, y), so that a face which looked along +z looks along
        −y, the front of programs with z up.
        """
        moved = points * self.factor if self.factor != 1 else points
        if self.up == "z":
            moved = np.stack([moved[..., 0], -moved[..., 2], moved[..., 1]], -1)
        return np.asarray(moved, np.float32)

    def frames(self, take: Take) -> Iterator[npt.NDArray[np.float32]]:
        """Frame after frame (V, 3), so that a memory map is never read as a whole."""
        return (self.place(np.asarray(frame)) for frame in take.frames())


def facts(take: Take, space: Space) -> dict[str, object]:
    """What is written into every file that has a place for words."""
    return {
        "name": take.name,
        "frame_rate": take.frame_rate,
        "frames": len(take.vertices),
        "unit": space.unit,
        "metres_per_unit": space.metres,
        "up": space.up,
        "metadata": dict(take.metadata),
    }
