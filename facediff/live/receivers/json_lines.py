"""JSON lines: one object a line, on standard output, in a file, or for clients of a TCP port.

The first line describes the performance and the last one its end; between them, each frame has a line:

- ``{"type": "performance", "format": "facediff live 1", "subject", "frame_rate", "unit", "shapes", "metadata"}``, with
  ``neutral`` (V, 3) and ``faces`` (F, 3) where frames have vertices;
- ``{"type": "frame", "index", "time", "lag", "dropped", "weights": {name: weight}}``, with ``vertices`` (V, 3), offsets
  from the neutral face, where they are asked for, and with ``head``, its yaw, pitch and roll in radians, where
  controls or acting move it. Seconds, and as :class:`~facediff.live.frames.LiveFrame` means them;
- ``{"type": "end", "frames", "dropped"}``: lines with frames that were sent, and frames that never reached this client.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from facediff.errors import FaceDiffError, counted
from facediff.live.frames import OPTION, Address, LiveFrame, Performance, Receiver
from facediff.live.receivers.sending import Outbox, endpoint, listen, log
from facediff.registry import receiver
from facediff.utils.files import atomic, check_writable

FORMAT = "facediff live 1"
PORT = 9_009
MOST_CLIENTS = 16
WAITING = 8
"""Frames that wait for one slow client, a disk or a pipe before the oldest is dropped."""
PAUSE = 0.1
"""Seconds until a client is accepted again after one could not be."""


@receiver.register("jsonl")
class JsonLines(Receiver):
    """JSON lines on standard output, in a file, or for the clients of a TCP port.

    A client that reads too slowly misses frames; the others do not.

    Args:
        address: ``jsonl:-`` for standard output, ``jsonl:FILE.jsonl``, ``jsonl:PORT`` or ``jsonl://HOST:PORT`` for a
            port that several clients may connect to.
        weights: whether lines have weights.
        vertices: whether lines have vertices, rounded to a millionth of the unit of length.
    """

    def __init__(self, address: Address, *, weights: bool = True, vertices: bool = False) -> None:
        super().__init__(address)
        self.needs_weights, self.with_vertices = weights, vertices
        self._served = address.host is not None or address.port is not None
        if self._served:
            self.host, self.port = endpoint(address, PORT, listens=True)
        elif address.path not in ("", "-") and Path(address.path).suffix.lower() not in (".jsonl", ".ndjson"):
            raise FaceDiffError(
                f"{OPTION} {self.name}: unknown suffix; expected FILE.jsonl, - for standard output, or a port"
            )
        self._sink: _Clients | _Stream | None = None
        self._outbox: Outbox[LiveFrame] | None = None
        self._words = ""
        self._warned = False

    def open(self, performance: Performance) -> None:
        """Open the file or the port and describe the performance."""
        self._shapes = performance.shapes
        about: dict[str, object] = {
            "type": "performance",
            "format": FORMAT,
            "subject": performance.subject,
            "frame_rate": performance.frame_rate,
            "unit": performance.unit,
            "shapes": list(performance.shapes) if self.needs_weights else [],
            "metadata": dict(performance.metadata),
        }
        if self.with_vertices:
            about["neutral"] = _rounded(performance.neutral)
            about["faces"] = performance.faces.tolist()
        if self._served:
            self._sink = _Clients(self.address, self.host, self.port, line(about))
        else:
            self._sink = _Stream(self.address, line(about))
        self._outbox = Outbox(self._write, WAITING, f"frames of {self.name}")

    def send(self, frame: LiveFrame) -> None:
        """Hand a frame over to the thread that writes."""
        if self._outbox is not None:
            self._outbox.put(frame)

    def _write(self, frame: LiveFrame) -> None:
        sink, outbox = self._sink, self._outbox
        if sink is None or outbox is None or not sink.wanted:
            return
        content: dict[str, object] = {
            "type": "frame",
            "index": frame.index,
            "time": round(frame.time, 6),
            "lag": round(frame.lag, 6),
            "dropped": frame.dropped,
        }
        if self.needs_weights and frame.weights is not None:
            weights = np.round(frame.weights.astype(np.float64), 6).tolist()
            content["weights"] = dict(zip(self._shapes, weights, strict=True))
        if frame.head is not None:
            content["head"] = [round(angle, 6) for angle in frame.turned.tolist()]
        if self.with_vertices:
            content["vertices"] = _rounded(frame.vertices)
        try:
            data = line(content)
        except ValueError:  # NaN, as of a model that computes in too few bits
            if not self._warned:
                log.warning("%s: frames with numbers that are not finite are left out", self.name)
            self._warned = True
            outbox.count_dropped()
            return
        sink.write(data)

    def close(self) -> None:
        """Write what waits and the last line, and let go."""
        if self._outbox is not None and self._sink is not None:
            self._outbox.close()
            self._words = self.status()
            self._sink.close(self._outbox.dropped)
            self._outbox = self._sink = None

    def status(self) -> str:
        """Lines or clients, and what slow ones missed."""
        if self._outbox is None or self._sink is None:
            return self._words
        return self._sink.status(self._outbox.given - self._outbox.dropped, self._outbox.dropped)


def line(content: dict[str, object]) -> bytes:
    """An object as one line of plain JSON, which has neither NaN nor infinity."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def _rounded(points: np.ndarray) -> list[list[float]]:
    rows: list[list[float]] = np.round(points.astype(np.float64), 6).tolist()
    return rows


def _end(frames: int, dropped: int) -> bytes:
    return line({"type": "end", "frames": frames, "dropped": dropped})


class _Stream:
    """Standard output or a file, which appears when it is whole."""

    def __init__(self, address: Address, first: bytes) -> None:
        self.address = address
        self.wanted = True
        self._frames = 0
        self._open = ExitStack()
        self._file: BinaryIO | None = None
        if address.path not in ("", "-"):
            path = Path(address.path)
            check_writable(path)
            temporary = self._open.enter_context(atomic(path))
            self._file = self._open.enter_context(temporary.open("wb"))
        self._put(first)

    def write(self, data: bytes) -> None:
        """Write a frame's line; a closed pipe or a full disk is reported once."""
        if self._put(data):
            self._frames += 1

    def _put(self, data: bytes) -> bool:
        if not self.wanted:
            return False
        try:
            if self._file is not None:
                self._file.write(data)
            else:
                _to_stdout(data)
        except OSError as error:
            self.wanted = False
            log.warning("%s: cannot be written any more (%s)", self.address.text, error.strerror)
        return self.wanted

    def close(self, dropped: int) -> None:
        self._put(_end(self._frames, dropped))
        failed = self._file is not None and not self.wanted
        # An exception leaves no half-written file behind.
        with suppress(OSError, _Unfinished), self._open:
            if failed:
                raise _Unfinished
        self.wanted = False

    def status(self, written: int, dropped: int) -> str:
        # What waits is written before the end, unless nothing can be written any more.
        frames = written if self.wanted else self._frames
        return counted(frames, "frame") + (f", {dropped} dropped" if dropped else "")


class _Unfinished(Exception):  # noqa: N818 - no error: it takes a half-written file away
    """Writing ended before the end."""


def _to_stdout(data: bytes) -> None:
    """Write past Python's buffer: a thread that waits for a full pipe must not hold its lock when the program ends."""
    try:
        number = sys.stdout.fileno()
    except (OSError, ValueError, AttributeError):  # not a real one, as in notebooks
        sys.stdout.write(data.decode())
        return
    sys.stdout.flush()
    view = memoryview(data)
    while view:
        view = view[os.write(number, view) :]


class _Clients:
    """The clients that are connected to a port."""

    def __init__(self, address: Address, host: str, port: int, first: bytes) -> None:
        self.address, self._first = address, first
        self._listening = listen(address, host, port)
        self._lock = threading.Lock()
        self._clients: dict[socket.socket, Outbox[bytes]] = {}
        self.connected = self._missed = 0
        self._full = False
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._accept, name=f"clients of {address.text}", daemon=True)
        self._thread.start()

    @property
    def wanted(self) -> bool:
        """Whether a client is connected."""
        return bool(self._clients)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:  # closed; or too many files are open, or the client has left already
                if self._closed.wait(PAUSE):
                    return
                continue
            with self._lock:
                if len(self._clients) >= MOST_CLIENTS:
                    client.close()
                    if not self._full:
                        log.warning("%s: %d clients are enough; more are refused", self.address.text, MOST_CLIENTS)
                    self._full = True
                    continue
                try:
                    # Small buffers: what waits in the system's is late when it arrives.
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2**16)
                    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                except OSError:  # the client has left already, as macOS says
                    client.close()
                    continue
                name = f"client of {self.address.text}"
                self._clients[client] = Outbox(client.sendall, WAITING, name, self._first)
                self.connected += 1

    def write(self, data: bytes) -> None:
        """Hand a line to every client, and forget those that are gone."""
        with self._lock:
            for client, outbox in list(self._clients.items()):
                if outbox.failure is not None:
                    self._forget(client)
                else:
                    outbox.put(data)

    def _forget(self, client: socket.socket) -> None:
        outbox = self._clients.pop(client)
        self._missed += outbox.dropped
        client.close()

    def close(self, dropped: int) -> None:
        """Send the last line to clients that take it within a second, and close the port."""
        self._closed.set()
        with suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)  # wakes the thread that accepts
        self._listening.close()
        self._thread.join(1.0)
        with self._lock:
            for client, outbox in list(self._clients.items()):
                self._missed += outbox.dropped
                outbox.put(_end(outbox.given - outbox.dropped, dropped + outbox.dropped))
                outbox.close(0.5)
                with suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)
                client.close()
            self._clients.clear()

    def status(self, frames: int, dropped: int) -> str:
        with self._lock:
            missed = dropped + self._missed + sum(outbox.dropped for outbox in self._clients.values())
            parts = [counted(frames, "frame"), counted(len(self._clients), "client"), f"{self.connected} so far"]
        return ", ".join(parts + ([f"{counted(missed, 'frame')} missed by slow ones"] if missed else []))
