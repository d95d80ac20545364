"""Reading what an offline run of Weights & Biases has recorded, straight from its ``.wandb`` file.

The file is a log in LevelDB's format with a header of seven bytes of its own: blocks of 32 KiB, in which every chunk
has a checksum (4 bytes), a length (2) and a kind (1 whole, 2 first, 3 middle, 4 last). Records are protocol buffers.
"""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

BLOCK = 32768


def records(data: bytes) -> Iterator[bytes]:
    """The records of a log."""
    place, whole = 7, b""
    while place + 7 <= len(data):
        left = BLOCK - place % BLOCK
        if left < 7:  # too little for a chunk's header: filled with zeros
            place += left
            continue
        length, kind = struct.unpack_from("<HB", data, place + 4)
        if place + 7 + length > len(data):  # still being written
            return
        whole += data[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):
            yield whole
            whole = b""


class OfflineRun:
    """What an offline run has recorded.

    Attributes:
        history: one dict per logged step; what is no number (a table, a video) is a dict itself.
        config: the run's config.
        files: the run's folder of files.
        media: where the files inside of tables lie, by their name in the table's artifact.
    """

    def __init__(self, folder: Path) -> None:
        from wandb.proto.wandb_internal_pb2 import Record

        self.files = folder / "files"
        self.history: list[dict[str, Any]] = []
        self.config: dict[str, Any] = {}
        self.media: dict[str, Path] = {}
        (file,) = folder.glob("*.wandb")
        found: list[Record] = []
        # wandb's own process writes the last records a moment after the run has finished.
        for _ in range(100):
            found = [Record.FromString(data) for data in records(file.read_bytes())]
            if found and found[-1].HasField("exit"):
                break
            time.sleep(0.1)
        for record in found:
            for config in (record.run.config, record.config):
                self.config |= {item.key: json.loads(item.value_json) for item in config.update}
            for entry in record.artifact.manifest.contents:
                self.media[entry.path] = Path(entry.local_path)
            if record.HasField("history"):
                self.history.append(unfolded(record.history.item))

    @property
    def names(self) -> set[str]:
        """Everything that was logged."""
        return {name for row in self.history for name in row}

    def column(self, name: str) -> list[Any]:
        """All values of a name, in the order of logging."""
        return [row[name] for row in self.history if name in row]

    def table(self, name: str) -> dict[str, Any]:
        """The last table of a name: ``columns``, and ``data`` with ``{"_type": …, "path": …}`` for media."""
        return json.loads(self.media[f"{name}.table.json"].read_text())


def unfolded(items: Iterable[Any]) -> dict[str, Any]:
    """The items of a history record as one dict."""
    row: dict[str, Any] = {}
    for item in items:
        name, *rest = item.nested_key or [item.key]
        value = json.loads(item.value_json)
        if rest:
            row.setdefault(name, {})["/".join(rest)] = value
        else:
            row[name] = value
    return row
