"""Shared by receivers: hosts, UDP datagrams, listening sockets, and queues that never block a performance."""

from __future__ import annotations

import logging
import socket
import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import ClassVar, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, counted
from facediff.live.frames import OPTION, Address, LiveFrame, Performance, Receiver
from facediff.spaces.arkit import ARKIT
from facediff.utils.limits import brief
from facediff.utils.server import LOOPBACK

Item = TypeVar("Item")

log = logging.getLogger("facediff.live")
"""Failures that do not end a performance; without a handler, Python writes them to standard error."""


def endpoint(address: Address, default_port: int, *, listens: bool = False) -> tuple[str, int]:
    """Host and port of an address: this machine unless another one is named, which is reported."""
    if address.path:
        raise FaceDiffError(
            f"{OPTION} {address.text}: has no path; expected {address.scheme}://HOST:PORT with options as ?name=value"
        )
    host, port = address.host or LOOPBACK[0], address.port or default_port
    if host.lower() not in LOOPBACK:
        consequence = "other machines can read the frames there" if listens else "frames leave this machine"
        log.warning("%s: %s, unencrypted", address.text, consequence)
    return host, port


class UdpReceiver(Receiver):
    """Sends each frame's weights in datagrams, to this machine and the protocol's usual port by default.

    Frames that no program received are counted.
    """

    needs_weights = True
    default_port: ClassVar[int]

    def __init__(self, address: Address) -> None:
        super().__init__(address)
        self.host, self.port = endpoint(address, self.default_port)
        self.sent = self.refused = self.lost = 0
        self._warned = False
        self._socket: socket.socket | None = None

    def open(self, performance: Performance) -> None:
        """Open the socket; whether a program listens shows when frames are sent."""
        try:
            family, kind, protocol, _, destination = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
            self._socket.setblocking(False)
            # A connected UDP socket reports when the port is unreachable (ICMP).
            self._socket.connect(destination)
        except (OSError, UnicodeError) as error:
            self.close()
            raise FaceDiffError(
                f"{OPTION} {self.name}: cannot be reached ({brief(error)}); check the host and the network"
            ) from error

    @abstractmethod
    def datagrams(self, frame: LiveFrame) -> Sequence[bytes]:
        """The datagrams of a frame."""

    def send(self, frame: LiveFrame) -> None:
        """Send a frame; one that cannot be sent is counted."""
        if self._socket is None:
            return
        refused = warned = False
        for part in self.datagrams(frame):
            try:
                try:
                    self._socket.send(part)
                except ConnectionRefusedError:  # an earlier one's; this one has not been sent yet
                    refused = True
                    self._socket.send(part)
            except ConnectionRefusedError:
                refused = True
            except OSError:  # no way there now, or the queue is full
                warned = True
        self.refused += refused
        self.lost += warned
        self.sent += not (refused or warned)
        # Once: not every datagram is refused, so that each refusal would look like a program that left.
        if refused and not self._warned:
            self._warned = True
            log.warning("%s: no program listens there; frames are sent all the same", self.name)

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def status(self) -> str:
        """Numbers of frames that were sent, refused and lost."""
        parts = [f"{counted(self.sent, 'frame')} sent"]
        parts += [f"{self.refused} refused: no program listened"] if self.refused else []
        parts += [f"{self.lost} lost"] if self.lost else []
        return ", ".join(parts)


class Outbox(Generic[Item]):
    """A short queue that a thread of its own empties; where that is too slow, the oldest items are dropped.

    Args:
        take: called with each item, in the thread; an :class:`OSError` from it ends the thread.
        capacity: items that may wait.
        name: of the thread.
    """

    def __init__(self, take: Callable[[Item], object], capacity: int, name: str) -> None:
        self._take = take
        self._capacity = capacity
        self._waiting: deque[Item] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self.given = self.dropped = 0
        self.failure: OSError | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Queue an item without waiting."""
        with self._changed:
            self.given += 1
            if self._closed or self.failure is not None:
                self.dropped += 1
                return
            if len(self._waiting) >= self._capacity:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(item)
            self._changed.notify()

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._closed)
                    if not self._waiting:
                        return
                    item = self._waiting.popleft()
                self._take(item)
        except OSError as error:
            with self._changed:
                self.failure = error
                self.dropped += 1 + len(self._waiting)
                self._waiting.clear()

    def close(self, seconds: float = 1.0) -> None:
        """Empty the queue, for at most so many seconds."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread is not threading.current_thread():
            self._thread.join(seconds)


class ArkitWeights:
    """Weights of a frame under ARKit's names, in a protocol's order; 0 where the face has no such shape."""

    def __init__(self, performance: Performance, address: Address, order: Sequence[str] = ARKIT) -> None:
        columns = {name: index for index, name in enumerate(performance.shapes)}
        pairs = [(index, columns[name]) for index, name in enumerate(order) if name in columns]
        if not pairs:
            raise FaceDiffError(
                f"{OPTION} {address.text}: sends the weights of ARKit's 52 shapes, and the face has none; give shapes "
                f"under ARKit's names"
            )
        self._to, self._from = (np.array(column) for column in zip(*pairs, strict=True))
        self._count = len(order)

    def of(self, frame: LiveFrame) -> npt.NDArray[np.float32]:
        """The weights (len(order),); 0 for a frame without any."""
        weights = np.zeros(self._count, np.float32)
        if frame.weights is not None:
            weights[self._to] = frame.weights[self._from]
        return weights
