"""Frames of a live performance, the face that they animate, receivers and their addresses.

A receiver is registered under the kind ``receiver`` by the scheme of its address: ``vmc://127.0.0.1:39539`` is sent by
the class that is registered as ``vmc``. Its constructor takes the :class:`Address`, and options with defaults, which
the address gives as ``?option=value``.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, cast
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import numpy.typing as npt

from facediff.errors import damaged, located
from facediff.registry import receiver
from facediff.spaces.rotations import convert
from facediff.utils import SAMPLE_RATE
from facediff.utils.hints import checks_arguments

Array = npt.NDArray[np.float32]

OPTION = "--to"
"""The option of the commands that names a receiver."""


@dataclass(frozen=True)
class LiveFrame:
    """One frame of a performance, on its way out.

    Attributes:
        index: its number; numbers of dropped frames are missing.
        time: seconds of speech, from the start, at which the frame begins.
        heard: :func:`time.monotonic` when the last sample within the frame had arrived.
        vertices: offsets from the neutral face (V, 3), in the performance's unit.
        weights: of the performance's blendshapes (len(shapes),), from 0 to 1, and in radians what turns; None if no
            receiver needs them.
        dropped: frames that were dropped so far, before this one.
        head: how the head moves as a whole (6,), if controls or acting move it: a rotation about the origin, axis-angle
            in radians, and then a shift. The vertices have been moved by it; the weights leave the head out.
    """

    index: int
    time: float
    heard: float
    vertices: Array
    weights: Array | None = None
    dropped: int = 0
    head: npt.NDArray[np.float64] | None = None

    @property
    def lag(self) -> float:
        """Seconds since its speech arrived."""
        return monotonic() - self.heard

    @property
    def turned(self) -> npt.NDArray[np.float64]:
        """Yaw, pitch and roll of the head (3,) in radians, about a right-handed face's axes; 0 if nothing moves it."""
        return np.zeros(3) if self.head is None else convert(self.head[None, :3], "axis_angle", "euler")[0]


@dataclass(frozen=True)
class Performance:
    """Constants of a live session.

    Attributes:
        frame_rate: frames a second.
        neutral: the face at rest (V, 3).
        faces: its triangles (F, 3); empty if the model has none.
        unit: of length: ``m``, ``mm`` …
        subject: name of the face in the receiving program.
        shapes: names of the blendshapes, in the order of :attr:`LiveFrame.weights`; of a model of channels all of them.
        sample_rate: of speech, in Hz.
        colours: of the vertices (V, 3), bytes of sRGB; None if there are none.
        speech: whether receivers that can play speech shall do so.
        metadata: licence, model and corpus, for programs that show them.
    """

    frame_rate: float
    neutral: Array
    faces: npt.NDArray[np.int32]
    unit: str = "m"
    subject: str = "facediff"
    shapes: tuple[str, ...] = ()
    sample_rate: int = SAMPLE_RATE
    colours: npt.NDArray[np.uint8] | None = None
    speech: bool = False
    metadata: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Address:
    """Where a receiver is.

    Attributes:
        text: as typed.
        scheme: the receiver's name.
        host: of ``scheme://host:port``; None if not given.
        port: of ``scheme://host:port`` or ``scheme:port``; None if not given.
        path: what else follows the scheme: a file, or ``-``; empty if nothing does.
        options: after the question mark.
    """

    text: str
    scheme: str
    host: str | None = None
    port: int | None = None
    path: str = ""
    options: dict[str, str] = field(default_factory=dict)


class Receiver(ABC):
    """Sends frames to a program, a file or a page.

    Its methods but :meth:`status` are called from one thread.

    Args:
        address: where it is.

    Attributes:
        name: what reports call it; the text of its address.
        needs_weights: whether it sends blendshapes: :attr:`LiveFrame.weights` is there then.
    """

    needs_weights: bool = False

    def __init__(self, address: Address) -> None:
        self.address = address
        self.name = address.text

    def __init_subclass__(cls, **options: Any) -> None:  # noqa: ANN401
        """Let every constructor refuse options that are out of range."""
        super().__init_subclass__(**options)
        if "__init__" in vars(cls):
            cls.__init__ = checks_arguments(cls.__init__, "receiver")  # type: ignore[method-assign]

    @abstractmethod
    def open(self, performance: Performance) -> None:
        """Open the way to the receiver: a socket, a file, a server.

        A program that does not listen yet is no error: every frame is sent to it.
        """

    @abstractmethod
    def send(self, frame: LiveFrame) -> None:
        """Send a frame, within a few milliseconds.

        A failure of the other side is counted and tried again; it is no exception here.
        """

    def hear(self, speech: Array, start: float) -> None:  # noqa: B027 - most receivers play no audio
        """Take speech (n,) from 0 to 1 of full scale at the performance's rate, for receivers that play it.

        Called as soon as the speech has arrived: earlier than its frames.

        Args:
            speech: the samples.
            start: seconds from the start at which they begin, on the clock of :attr:`LiveFrame.time`.
        """

    @abstractmethod
    def close(self) -> None:
        """Close everything; may be called twice."""

    def status(self) -> str:
        """A few words for the report: clients, bytes, frames that were lost; empty if there is nothing to report."""
        return ""


def read_address(text: str) -> Address:
    """An address: ``scheme://host:port?option=value``, ``scheme:port``, ``scheme:file``, or the scheme alone.

    Example:
        >>> read_address("livelink://127.0.0.1:11111?subject=Ann").port
        11111
        >>> read_address("browser:8080").port, read_address("jsonl:-").path
        (8080, '-')
    """
    expected = "expected scheme://HOST:PORT, scheme:FILE or a scheme alone, and options as ?name=value&name=value"
    with damaged(f"{OPTION} {text}", expected):
        address, _, query = text.partition("?")
        scheme, _, rest = address.partition(":")
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query), max_num_fields=20)
        host, port, path = None, None, rest
        if rest.startswith("//"):
            parts = urlsplit(f"{scheme}:{rest}")
            host, port, path = parts.hostname, parts.port, parts.path.removeprefix("/")
            if parts.username is not None or parts.fragment or not host:
                raise ValueError("the host is wrong")
        elif rest.isdecimal():
            port, path = int(rest), ""
        if re.fullmatch(r"[a-z][a-z0-9_]*", scheme) is None or port not in (None, *range(1, 65_536)):
            raise ValueError("the scheme or the port does not exist")
        return Address(text, scheme, host, port, path, dict(pairs))


def open_receiver(text: str) -> Receiver:
    """The receiver at an address, which is not open yet."""
    address = read_address(text)
    with located(f"{OPTION} {text}"):
        implementation = receiver.get(address.scheme)
    options = receiver.options(address.scheme, list(address.options.items()), f"{OPTION} {text}")
    return cast(Receiver, implementation(address, **options))
