"""JSON lines: one object a line, on standard output or in a file.

The first line describes the performance and the last one its end; between them, each frame has a line:

- ``{"type": "performance", "format": "facediff live 1", "subject", "frame_rate", "unit", "shapes", "metadata"}``, with
  ``neutral`` (V, 3) and ``faces`` (F, 3) where frames have vertices;
- ``{"type": "frame", "index", "time", "lag", "dropped", "weights": {name: weight}}``, with ``vertices`` (V, 3), offsets
  from the neutral face, where they are asked for, and with ``head``, its yaw, pitch and roll in radians, where
  controls or acting move it. Seconds, and as :class:`~facediff.live.frames.LiveFrame` means them;
- ``{"type": "end", "frames", "dropped"}``: lines with frames, and frames that have no line.
"""

from __future__ import annotations

import json
import os
import sys
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from facediff.errors import FaceDiffError, counted
from facediff.live.frames import OPTION, Address, LiveFrame, Performance, Receiver
from facediff.live.receivers.sending import Outbox, log
from facediff.registry import receiver
from facediff.utils.files import atomic, check_writable

FORMAT = "facediff live 1"
WAITING = 8
"""Frames that wait for a slow disk or pipe before the oldest is dropped."""


@receiver.register("jsonl")
class JsonLines(Receiver):
    """JSON lines on standard output or in a file; a reader that is too slow misses frames.

    Args:
        address: ``jsonl:-`` for standard output, or ``jsonl:FILE.jsonl``.
        weights: whether lines have weights.
        vertices: whether lines have vertices, rounded to a millionth of the unit of length.
    """

    def __init__(self, address: Address, *, weights: bool = True, vertices: bool = False) -> None:
        super().__init__(address)
        self.needs_weights, self.with_vertices = weights, vertices
        self._path = None if address.path in ("", "-") else Path(address.path)
        if address.port is not None or (self._path and self._path.suffix.lower() not in (".jsonl", ".ndjson")):
            raise FaceDiffError(f"{OPTION} {self.name}: expected jsonl:FILE.jsonl, or jsonl:- for standard output")
        self._outbox: Outbox[LiveFrame] | None = None
        self._left_out = 0

    def open(self, performance: Performance) -> None:
        """Open the file and describe the performance."""
        self._shapes = performance.shapes
        self._open = ExitStack()
        self._file: BinaryIO | None = None
        if self._path is not None:
            check_writable(self._path)
            temporary = self._open.enter_context(atomic(self._path))
            self._file = self._open.enter_context(temporary.open("wb"))
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
        self._put(about)
        self._earlier_drops = 0  # dropped before they came here
        self._outbox = Outbox(self._write, WAITING, f"frames of {self.name}")

    def send(self, frame: LiveFrame) -> None:
        """Hand a frame over to the thread that writes."""
        if self._outbox is not None:
            self._earlier_drops = frame.dropped
            self._outbox.put(frame)

    def _write(self, frame: LiveFrame) -> None:
        content: dict[str, object] = {
            "type": "frame",
            "index": frame.index,
            "time": round(frame.time, 6),
            "lag": round(frame.lag, 6),
            "dropped": frame.dropped,
        }
        if self.needs_weights and frame.weights is not None:
            content["weights"] = dict(zip(self._shapes, _rounded(frame.weights), strict=True))
        if frame.head is not None:
            content["head"] = _rounded(frame.turned)
        if self.with_vertices:
            content["vertices"] = _rounded(frame.vertices)
        try:
            self._put(content)
        except ValueError:  # NaN, as of a model that computes in too few bits
            if not self._left_out:
                log.warning("%s: frames with numbers that are not finite are left out", self.name)
            self._left_out += 1
        except OSError as error:
            log.warning("%s: cannot be written any more (%s)", self.name, error.strerror)
            raise

    def _put(self, content: dict[str, object]) -> None:
        """Write an object as one line of plain JSON, which has neither NaN nor infinity."""
        data = json.dumps(content, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        if self._file is None:
            _to_stdout(data)
        else:
            self._file.write(data)

    @property
    def _dropped(self) -> int:
        return self._left_out + (0 if self._outbox is None else self._outbox.dropped)

    def close(self) -> None:
        """Write the frames that wait and the last line, and let go."""
        outbox = self._outbox
        if outbox is None:
            return
        outbox.close()
        with suppress(OSError), self._open:
            if outbox.failure is not None:
                raise outbox.failure  # leaves no half-written file behind
            lines = outbox.given - self._dropped
            self._put({"type": "end", "frames": lines, "dropped": self._dropped + self._earlier_drops})
        self._outbox = None

    def status(self) -> str:
        """Lines, and frames that have none."""
        if self._outbox is None:
            return ""
        frames = counted(self._outbox.given - self._dropped, "frame")
        return frames + (f", {self._dropped} dropped" if self._dropped else "")


def _rounded(numbers: np.ndarray) -> list[object]:
    rows: list[object] = np.round(numbers.astype(np.float64), 6).tolist()
    return rows


def _to_stdout(data: bytes) -> None:
    """Write past Python's buffer: a thread that waits for a full pipe must not hold its lock when the program ends."""
    sys.stdout.flush()
    view = memoryview(data)
    while view:
        view = view[os.write(sys.stdout.fileno(), view) :]
