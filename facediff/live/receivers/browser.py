"""A page that shows the face while it performs: served on this machine, with frames over a WebSocket.

The page asks for itself (``GET /``) and opens the WebSocket ``/live`` of the same address. What it is sent there:

1. a text, JSON: ``format``, ``subject``, ``frameRate``, ``step``, ``sampleRate``, ``speech``, ``mesh`` (a number that
   differs between meshes) and ``metadata``;
2. binary messages. Each begins with 24 bytes, little-endian: kind (1 byte), 3 zero bytes, then

   ====  =======  ===========================================================  ===================================
   kind  what     further fields                                               what follows
   ====  =======  ===========================================================  ===================================
   0     mesh     vertices V, triangles F, 1 if colours follow (uint32 each)   the face at rest in mm (3 V float32),
                                                                               triangles (3 F uint32), colours (3 V)
   1     frame    index, dropped frames (uint32), lag in s (float32), time in  offsets from the face at rest, int16
                  s (float64)                                                  in steps of ``step`` mm (3 V)
   2     speech   samples n, 0 (uint32), 0 (float32), time in s (float64)      samples (n int16)
   ====  =======  ===========================================================  ===================================

The page answers every frame with its index as a text. Once it has answered, no more than :data:`ON_THE_WAY` frames go
unanswered: a page that does not keep up is sent fewer. A program that never answers is sent what its connection takes.
Any other message ends the connection.
"""

from __future__ import annotations

import html
import http
import json
import logging
import socket
import struct
import sys
import threading
import zlib
from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from facediff.errors import FaceDiffError, counted
from facediff.live.frames import OPTION, Address, Array, LiveFrame, Performance, Receiver
from facediff.live.receivers.sending import Outbox, endpoint, log
from facediff.registry import receiver
from facediff.utils.limits import brief
from facediff.utils.server import HEADERS, is_own_page, listen, names_of, require_server

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.sync.server import Server, ServerConnection

FORMAT = "facediff live page 1"
PORT = 8_350
STEP = 0.01
"""Millimetres that one step of an offset is: offsets are off by half of it at most, and reach 327 mm."""
LARGEST_STEP = np.iinfo(np.int16).max
MESH, FRAME, SPEECH = range(3)
MOST_VIEWERS = 16
MOST_BYTES = 64
"""Of a page's message; the number of a frame has at most 10."""
ON_THE_WAY = 6
"""Frames that a page has not answered yet. A page of this machine answers within one."""
MOST_SPEECH = 64
"""Pieces of speech that wait for a page."""
SCRIPTS = ("surface", "camera", "scene", "stage", "dialogs", "report", "live")


@receiver.register("browser")
class Browser(Receiver):
    """A page in a browser, at ``http://127.0.0.1:8350/``, that draws the face and plays the speech with it.

    Any number of pages up to 16 may be open; they come, go and come back as they like.

    Args:
        address: ``browser``, ``browser:PORT`` or ``browser://HOST:PORT``; only this machine reaches the page unless
            another host is named.
    """

    def __init__(self, address: Address) -> None:
        super().__init__(address)
        self.host, self.port = endpoint(address, PORT, listens=True)
        self._server: Server | None = None
        self._viewers: dict[int, _Viewer] = {}
        self._lock = threading.Lock()
        self._came = self._refused = self._missed = 0
        self._reported: set[str] = set()

    @property
    def url(self) -> str:
        """Where the page is."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/"

    def open(self, performance: Performance) -> None:
        """Serve the page."""
        require_server("the live page", ("websockets",), "live")
        from websockets.sync.server import serve

        if not len(performance.faces):
            raise FaceDiffError(f"{OPTION} {self.name}: the model has no triangles to draw; give another receiver")
        from facediff.animation import metres_per_unit

        self._scale = 1000.0 * metres_per_unit(performance.unit)
        self._speaks = performance.speech
        self._mesh = _mesh(performance, self._scale)
        self._about = json.dumps(
            {
                "format": FORMAT,
                "subject": performance.subject,
                "frameRate": performance.frame_rate,
                "step": STEP,
                "sampleRate": performance.sample_rate,
                "speech": performance.speech,
                "mesh": zlib.crc32(self._mesh),
                "metadata": {str(key): str(value) for key, value in performance.metadata.items()},
            }
        )
        self._page = "".join(page(performance.subject)).encode()
        self._hosts = names_of(self.host)
        try:
            listening = listen(self.host, self.port)
        except (OSError, ValueError) as error:  # a name that is none, or an address in use
            raise FaceDiffError(
                f"{OPTION} {self.name}: port {self.port} of {self.host} cannot be listened at ({brief(error)}); give "
                f"another port as browser:PORT"
            ) from error
        # The library logs every connection that is closed in the middle of a message.
        quiet = logging.getLogger("facediff.live.browser")
        quiet.setLevel(logging.CRITICAL)
        self._server = serve(
            self._attend,
            sock=listening,
            process_request=self._answer,
            compression=None,  # frames are noise to a compressor, and it costs milliseconds
            max_size=MOST_BYTES,
            open_timeout=5,
            close_timeout=1,
            ping_interval=5,
            ping_timeout=10,  # a connection that has ended without a word
            server_header=None,
            logger=quiet,
        )
        self._thread = threading.Thread(target=self._server.serve_forever, name=f"page of {self.name}", daemon=True)
        self._thread.start()
        print(f"{self.name}: the face is at {self.url}", file=sys.stderr, flush=True)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request with the page, a refusal, or None where a WebSocket may be opened."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not is_own_page(hosts[0], ",".join(origins) if origins else None, self._hosts):
            self._refuse("a page from elsewhere asked for frames")
            return _response(http.HTTPStatus.FORBIDDEN, b"only the page that this server shows may ask it\n")
        path = request.path.partition("?")[0]
        if path == "/":
            return _response(http.HTTPStatus.OK, self._page, "text/html; charset=utf-8")
        if path != "/live":
            return _response(http.HTTPStatus.NOT_FOUND, b"there is one page, at /\n")
        if len(self._viewers) >= MOST_VIEWERS:
            self._refuse(f"{MOST_VIEWERS} pages are enough")
            return _response(http.HTTPStatus.SERVICE_UNAVAILABLE, b"too many pages are open\n")
        return None

    def _refuse(self, why: str) -> None:
        """Count a refusal; the first of each kind is reported."""
        with self._lock:
            self._refused += 1
            is_reported = why in self._reported
            self._reported.add(why)
        if not is_reported:
            log.warning("%s: refused, %s; the performance goes on", self.name, why)

    def _attend(self, connection: ServerConnection) -> None:
        """Serve one page until it leaves, in the thread of its connection."""
        from websockets.exceptions import ConnectionClosed

        number = id(connection)
        with suppress(ConnectionClosed):
            connection.send(self._about)
            connection.send(self._mesh)
            viewer = _Viewer(connection)
            with self._lock:
                self._viewers[number] = viewer
                self._came += 1
            try:
                while viewer.acknowledged(connection.recv()):
                    pass
                self._refuse("a page sent an unexpected message")
                connection.close(1008, "expected the index of a frame")
            except ConnectionClosed as error:
                if error.sent is not None and error.sent.code in (1002, 1007, 1009):
                    self._refuse("a page sent a message that is too long or malformed")
            finally:
                with self._lock:
                    del self._viewers[number]
                    self._missed += viewer.missed
                viewer.close()

    def send(self, frame: LiveFrame) -> None:
        """Send a frame to every page that keeps up."""
        viewers = self._present()
        if not viewers:
            return
        steps = np.rint(frame.vertices.astype(np.float32) * (self._scale / STEP))
        body = np.clip(steps, -LARGEST_STEP, LARGEST_STEP).astype("<i2").tobytes()
        data = _head(FRAME, frame.index, frame.dropped, frame.lag, frame.time) + body
        for viewer in viewers:
            viewer.show(data)

    def hear(self, speech: Array, start: float) -> None:
        """Send speech to every page, which plays it when its frames come."""
        if self._speaks:
            samples = np.rint(np.clip(speech, -1.0, 1.0) * 32767).astype("<i2").tobytes()
            for viewer in self._present():
                viewer.say(_head(SPEECH, len(speech), 0, 0.0, start) + samples)

    def _present(self) -> list[_Viewer]:
        with self._lock:
            return list(self._viewers.values())

    def close(self) -> None:
        """Close all connections and the port."""
        if self._server is None:
            return
        server, self._server = self._server, None
        server.shutdown()
        self._thread.join(2.0)
        leaving = [threading.Thread(target=viewer.leave, daemon=True) for viewer in self._present()]
        for thread in leaving:
            thread.start()
        for thread in leaving:
            thread.join(2.0)

    def status(self) -> str:
        """Pages that are open, and frames that slow ones missed."""
        with self._lock:
            viewers = list(self._viewers.values())
            missed = self._missed + sum(viewer.missed for viewer in viewers)
            parts = [f"{counted(len(viewers), 'page')} at {self.url}", f"{self._came} so far"]
            parts += [f"{counted(missed, 'frame')} missed by slow ones"] if missed else []
            parts += [f"{self._refused} refused"] if self._refused else []
        return ", ".join(parts)


class _Viewer:
    """One page: its queues, and how many frames it has not answered."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection
        self._lock = threading.Lock()
        self._on_the_way = self._skipped = 0
        self._answers = False
        # Small buffers: what waits in the system's is late when it arrives.
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2**17)
        self._frames: Outbox[bytes] = Outbox(self._send_frame, ON_THE_WAY, "frames of a page")
        self._speech: Outbox[bytes] = Outbox(self._send, MOST_SPEECH, "speech of a page")

    @property
    def missed(self) -> int:
        """Frames that were not sent, because the page did not keep up."""
        return self._skipped + self._frames.dropped

    def _send(self, data: bytes) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            self._connection.send(data)
        except ConnectionClosed as error:
            raise ConnectionError(str(error)) from error

    def _send_frame(self, data: bytes) -> None:
        with self._lock:
            self._on_the_way += 1
        self._send(data)

    def show(self, data: bytes) -> None:
        """Send a frame, unless too many are unanswered."""
        with self._lock:
            late = self._answers and self._on_the_way >= ON_THE_WAY
        if late:
            self._skipped += 1
        else:
            self._frames.put(data)

    def say(self, data: bytes) -> None:
        """Send speech."""
        self._speech.put(data)

    def acknowledged(self, answer: str | bytes) -> bool:
        """Count the answer of a page; whether it is the index of a frame, as it should be."""
        if not isinstance(answer, str) or not (answer.isascii() and answer.isdecimal()):
            return False
        with self._lock:
            self._answers = True
            self._on_the_way -= 1
            return self._on_the_way >= 0

    def leave(self) -> None:
        """Close the connection; the page connects again later."""
        with suppress(OSError):
            self._connection.close(1001, "the performance is over")

    def close(self) -> None:
        """End the threads."""
        for outbox in (self._frames, self._speech):
            outbox.close(0.2)


def _response(status: http.HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8") -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = Headers([*HEADERS.items(), ("Content-Type", kind), ("Content-Length", str(len(body)))])
    headers.update({"Cache-Control": "no-store", "Connection": "close"})
    return Response(status.value, status.phrase, headers, body)


def _head(kind: int, first: int, second: int, part: float, seconds: float) -> bytes:
    return struct.pack("<B3xIIfd", kind, first % 2**32, second % 2**32, part, seconds)


def _mesh(performance: Performance, scale: float) -> bytes:
    """The message with the face at rest in mm, its triangles counter-clockwise seen from outside."""
    from facediff.animation import Animation
    from facediff.export.format import outward

    neutral = performance.neutral.astype(np.float32)
    face = Animation(performance.subject, neutral[None], neutral, performance.frame_rate, faces=performance.faces)
    triangles = outward(face).astype("<u4")
    colours = b"" if performance.colours is None else performance.colours.astype(np.uint8).tobytes()
    head = struct.pack("<B3xIII8x", MESH, len(neutral), len(triangles), int(bool(colours)))
    return head + (neutral.astype(np.float64) * scale).astype("<f4").tobytes() + triangles.tobytes() + colours


def page(subject: str) -> Iterator[str]:
    """The text of the page in pieces, in order."""
    from facediff.export.viewer.packing import Blobs
    from facediff.export.viewer.page import assemble

    facts: dict[str, Any] = {"format": FORMAT}
    texts = {"title": html.escape(subject), "tab": html.escape(f"{subject}, live")}
    return assemble(
        "live.html",
        ("style.css", "live.css"),
        SCRIPTS,
        texts,
        facts,
        Blobs(),
        loads="img-src data:; connect-src 'self'",
    )
