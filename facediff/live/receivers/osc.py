"""Open Sound Control by UDP: the VMC protocol of avatar programs, and plain addresses for everything else.

OSC 1.0 (Wright, "The Open Sound Control 1.0 specification", 2002): a message is an address, the types of its arguments
and the arguments, each filled up to whole words of 4 bytes; a bundle is messages that belong together. The VMC protocol
(https://protocol.vmc.info/english) says which messages a program sends that moves an avatar.
"""

from __future__ import annotations

import struct
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from facediff.live.frames import Address, LiveFrame, Performance
from facediff.live.receivers.sending import ArkitWeights, UdpReceiver
from facediff.registry import receiver
from facediff.spaces.arkit import ARKIT, ROTATIONS, live_link_name
from facediff.spaces.space import Space
from facediff.spaces.visemes import SETS, visemes

MOST_BYTES = 1400
"""Of a datagram: more would be split on the way, and lost where one of its parts is lost."""
BUNDLE = b"#bundle\0" + struct.pack(">Q", 1)  # the time tag 1 means immediately


def message(address: str, *arguments: int | float | str) -> bytes:
    r"""One OSC message; whole numbers and floats take 32 bits.

    Example:
        >>> message("/a", 1)
        b'/a\x00\x00,i\x00\x00\x00\x00\x00\x01'
    """
    types, body = ",", b""
    for argument in arguments:
        if isinstance(argument, str):
            types, body = types + "s", body + _text(argument)
        elif isinstance(argument, int):
            types, body = types + "i", body + struct.pack(">i", argument)
        else:
            types, body = types + "f", body + struct.pack(">f", argument)
    return _text(address) + _text(types) + body


def _text(text: str) -> bytes:
    """A text that ends with a zero byte and is filled up to a whole number of words."""
    data = text.encode("ascii")
    return data + b"\0" * (4 - len(data) % 4)


def bundles(messages: Sequence[bytes]) -> Iterator[bytes]:
    """Messages in as few bundles as hold them, in their order, each of at most :data:`MOST_BYTES`."""
    current = BUNDLE
    for packet in messages:
        if len(current) + 4 + len(packet) > MOST_BYTES and current != BUNDLE:
            yield current
            current = BUNDLE
        current += struct.pack(">i", len(packet)) + packet
    yield current


class _Osc(UdpReceiver):
    """Shared by both protocols: the messages of a frame, in bundles."""

    def open(self, performance: Performance) -> None:
        """Open the socket."""
        self._weights = ArkitWeights(performance, self.address)
        self._turns = [performance.shapes.index(name) for name in ROTATIONS[:3] if name in performance.shapes]
        super().open(performance)

    @abstractmethod
    def messages(self, frame: LiveFrame) -> list[bytes]:
        """The messages of a frame, in their order."""

    def datagrams(self, frame: LiveFrame) -> list[bytes]:
        """The bundles of a frame."""
        return list(bundles(self.messages(frame)))


_SPACE = Space("arkit", ARKIT)


@receiver.register("vmc")
class Vmc(_Osc):
    """Avatars by the VMC protocol: VSeeFace, Warudo, VMagicMirror and others; weights of "perfect sync" shapes.

    A frame is ``/VMC/Ext/OK 1``, ``/VMC/Ext/T seconds``, a ``/VMC/Ext/Blend/Val name weight`` for each of ARKit's 52
    shapes or each of VRM's vowels and blinks, and ``/VMC/Ext/Blend/Apply``, in bundles of at most 1 400 bytes.

    Args:
        address: ``vmc://HOST:PORT``; this machine's port 39539 by default.
        names: ``perfect_sync`` for JawOpen …, as avatars with perfect sync name their shapes, or ``vrm`` for A, I, U,
            E, O and blinks, which every VRM avatar has.
    """

    default_port = 39_539

    def __init__(self, address: Address, *, names: Literal["perfect_sync", "vrm"] = "perfect_sync") -> None:
        super().__init__(address)
        self._vrm = names == "vrm"
        labels = SETS["vrm"] if self._vrm else [live_link_name(name) for name in ARKIT]
        # All but the weight, which is the last word.
        self._parts = [message("/VMC/Ext/Blend/Val", name, 0.0)[:-4] for name in labels]
        self._ready, self._apply = message("/VMC/Ext/OK", 1), message("/VMC/Ext/Blend/Apply")

    def messages(self, frame: LiveFrame) -> list[bytes]:
        """The messages of a frame, in their order."""
        weights = self._weights.of(frame)
        if self._vrm:
            weights = np.asarray(visemes(weights[None], _SPACE, "vrm")[0][0], np.float32)
        values = [part + struct.pack(">f", weight) for part, weight in zip(self._parts, weights.tolist(), strict=True)]
        return [self._ready, message("/VMC/Ext/T", float(frame.time)), *values, self._apply]


@receiver.register("osc")
class Osc(_Osc):
    """Plain OSC addresses, for TouchDesigner, Max, Pure Data and programs of your own.

    A frame is ``/facediff/frame index seconds lag dropped`` (a whole number, two floats, a whole number),
    ``/facediff/head yaw pitch roll`` in radians, and a ``/facediff/weight/jawOpen weight`` for each of ARKit's 52
    shapes, in bundles of at most 1 400 bytes.

    Args:
        address: ``osc://HOST:PORT``; this machine's port 9000 by default.
    """

    default_port = 9_000

    def __init__(self, address: Address) -> None:
        super().__init__(address)
        self._parts = [message(f"/facediff/weight/{name}", 0.0)[:-4] for name in ARKIT]

    def messages(self, frame: LiveFrame) -> list[bytes]:
        """The messages of a frame, in their order."""
        weights = zip(self._parts, self._weights.of(frame).tolist(), strict=True)
        about = [message("/facediff/frame", frame.index, float(frame.time), float(frame.lag), frame.dropped)]
        # A model of channels turns the head by weights of its own.
        turned = frame.turned if frame.weights is None or not self._turns else frame.weights[self._turns]
        about.append(message("/facediff/head", *turned.tolist()))
        return [*about, *(part + struct.pack(">f", weight) for part, weight in weights)]
