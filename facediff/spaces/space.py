"""The space of a motion: vertices of a mesh, or the channels of a parametric face.

Motion is ``(frames, points, dims)`` in every space. For vertices the points are vertices and each has three
coordinates; for parameters the points are channels, one number each. Units of length stand at the end.
"""

from __future__ import annotations

import math
import re
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

from facediff.errors import FaceDiffError, damaged
from facediff.utils.hints import is_name
from facediff.utils.limits import brief, quoted

Kind = Literal["vertices", "arkit", "flame", "linear"]
Joint = Literal["head", "neck", "jaw", "left_eye", "right_eye"]
Form = Literal["axis_angle", "axis_angle_x", "six_d", "quaternion", "euler"]

WIDTHS: dict[str, int] = {"axis_angle": 3, "axis_angle_x": 1, "six_d": 6, "quaternion": 4, "euler": 3}
"""Channels that a rotation takes, by its form."""

MOST_CHANNELS = 10_000

REGIONS: dict[str, tuple[str, ...]] = {
    "lips": ("mouth", "jaw", "tongue"),
    "upper_face": ("brow",),
    "eyes": ("eyeblink", "eyelook"),
}
"""How the names of a region's channels begin, in lower case."""


@dataclass(frozen=True)
class Rotation:
    """A run of channels that together are one rotation, in radians.

    Forms are ``axis_angle`` (3 channels), its x alone (1), the first two columns of the matrix (``six_d``, 6),
    ``quaternion`` (4), and ``euler`` angles (3).
    """

    joint: Joint
    start: int
    form: Form

    @property
    def channels(self) -> range:
        """The rotation's channels."""
        return range(self.start, self.start + WIDTHS[self.form])


@dataclass(frozen=True)
class Space:
    """The space of a motion; by default the vertices of a mesh.

    Attributes:
        kind: which family of faces the channels belong to.
        channels: their names in order; empty for vertices.
        version: of the layout or the face model, such as FLAME's ``2020``; coefficients of two versions cannot be
            exchanged.
        rig: which displacements give the channels their meaning.
        rig_hash: the hash of these.
        rotations: the channels that are rotations.
        valid_range: smallest and largest value that a channel is defined for, rotations aside; None if there is none.
        absent: channels of the layout that the source did not have, which differs from zero.
        identity: a person's coefficients, kept apart from motion, such as ``shape 300``.

    Example:
        >>> space = Space("linear", ("jawOpen", "pitch", "yaw", "roll"), rotations=(Rotation("head", 1, "euler"),))
        >>> space.dims, space.face, space.head, space.index("yaw")
        (1, (0,), (1, 2, 3), 2)
        >>> Space.from_state(space.state()) == space
        True
    """

    kind: Kind = "vertices"
    channels: tuple[str, ...] = ()
    version: str = ""
    rig: str = ""
    rig_hash: str = ""
    rotations: tuple[Rotation, ...] = ()
    valid_range: tuple[float, float] | None = None
    absent: tuple[str, ...] = ()
    identity: str = ""

    def __post_init__(self) -> None:
        """Refuse fields that do not fit each other; records come from files."""
        count, turning = len(self.channels), [channel for turn in self.rotations for channel in turn.channels]
        texts = (*self.channels, *self.absent, *filter(None, (self.version, self.rig, self.rig_hash, self.identity)))
        low, high = self.valid_range or (0.0, 1.0)
        unfit = [
            name
            for name, fits in (
                ("kind", self.kind in get_args(Kind) and self.is_vertices == (not count)),
                ("channels", count <= MOST_CHANNELS and len({name.casefold() for name in self.channels}) == count),
                ("names", all(map(is_name, texts))),
                ("rotations", all(turn.start >= 0 and turn.joint in get_args(Joint) for turn in self.rotations)),
                ("rotations", len(set(turning)) == len(turning) and max(turning, default=-1) < count),
                ("valid_range", math.isfinite(low) and math.isfinite(high) and low < high),
            )
            if not fits
        ]
        if unfit:
            raise FaceDiffError(f"space: {' and '.join(unfit)} do not fit; expected a record of a motion's channels")

    @property
    def is_vertices(self) -> bool:
        """Whether the points are vertices of a mesh."""
        return self.kind == "vertices"

    @property
    def dims(self) -> int:
        """Numbers that each point has: 3 coordinates of a vertex, 1 value of a channel."""
        return 3 if self.is_vertices else 1

    @property
    def head(self) -> tuple[int, ...]:
        """Channels that turn the head or the neck."""
        return self._turning("head", "neck")

    @property
    def eyes(self) -> tuple[int, ...]:
        """Channels that turn the eyeballs as rotations; ARKit's ``eyeLook`` shapes are of the face."""
        return self._turning("left_eye", "right_eye")

    @property
    def face(self) -> tuple[int, ...]:
        """All other channels, a jaw's rotation among them."""
        apart = {*self.head, *self.eyes}
        return tuple(channel for channel in range(len(self.channels)) if channel not in apart)

    def _turning(self, *joints: Joint) -> tuple[int, ...]:
        return tuple(channel for turn in self.rotations if turn.joint in joints for channel in turn.channels)

    def index(self, name: str) -> int:
        """The channel of a name, without regard to case."""
        folded = [channel.casefold() for channel in self.channels]
        if name.casefold() not in folded:
            raise FaceDiffError(f'space: has no channel "{name}"; its channels are {quoted(list(self.channels))}')
        return folded.index(name.casefold())

    def region(self, name: str) -> tuple[int, ...]:
        """The channels of a region by their names: ``lips``, ``upper_face`` or ``eyes``; empty if none is named so."""
        return tuple(channel for channel, text in enumerate(self.channels) if text.casefold().startswith(REGIONS[name]))

    @property
    def groups(self) -> dict[str, tuple[int, ...]]:
        """Channels by what scores are taken of them: all, expression, jaw, head, eyes, and the regions.

        The jaw is its rotation, or the channels that are named so; the expression is the rest of the face. A region
        that no channel is named after, as with FLAME's expressions, is all channels; other groups may be empty.
        """
        jaw = self._turning("jaw") or tuple(c for c in self.face if self.channels[c].casefold().startswith("jaw"))
        everything = tuple(range(len(self.channels)))
        return {
            "all": everything,
            "expression": tuple(channel for channel in self.face if channel not in jaw),
            "jaw": jaw,
            "head": self.head,
            "eyes": self.eyes,
            **{name: self.region(name) or everything for name in ("lips", "upper_face")},
        }

    def state(self) -> dict[str, Any]:
        """The record as plain containers, fit for checkpoints and JSON."""
        return asdict(self, dict_factory=lambda pairs: {k: list(v) if isinstance(v, tuple) else v for k, v in pairs})

    @classmethod
    def from_state(cls, state: object) -> Space:
        """The inverse of :meth:`state`, for records from files."""
        with damaged("space", "expected the record of a motion's channels"):
            state = {name: state[name] for name in (attribute.name for attribute in fields(cls))}  # type: ignore[index]
            rotations = tuple(Rotation(turn["joint"], int(turn["start"]), turn["form"]) for turn in state["rotations"])
            low, high = state["valid_range"] or (0.0, 0.0)
            span = (float(low), float(high)) if state["valid_range"] else None
            lists = {name: tuple(state[name]) for name in ("channels", "absent")}
            return cls(**{**state, **lists, "rotations": rotations, "valid_range": span})


VERTICES = Space()
"""The space of a mesh's vertices."""


METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
UNITS = (1e-9, 1e9)
"""Metres that a unit of length may have."""
_ABOUT = re.compile(r"about ([0-9.]+) mm\b")


def metres_per_unit(unit: str) -> float:
    """Metres in one unit of length.

    Args:
        unit: ``m``, ``cm``, ``mm``, ``in``, a number of metres, or a description with "about … mm", as of a corpus
            with normalised faces.

    Example:
        >>> metres_per_unit("mm"), metres_per_unit("normalised (about 185 mm)")
        (0.001, 0.185)
    """
    about = _ABOUT.search(unit)
    try:
        value = float(about[1]) / 1000 if about else METRES.get(unit) or float(unit)
    except ValueError:
        value = 0.0
    if not UNITS[0] <= value <= UNITS[1]:
        raise FaceDiffError(
            f'unit "{brief(unit) if unit else ""}": expected one of {", ".join(METRES)}, or a number of metres from '
            f"{UNITS[0]:g} to {UNITS[1]:g}"
        )
    return value
