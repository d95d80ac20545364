"""Writers of TensorFlow's files, by their public definitions: bundles of tensors, and frozen graphs.

They share no code with facediff's readers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

Arrays = Mapping[str, np.ndarray]
CODES = {"float32": 1, "float64": 2, "int32": 3, "int64": 9, "float16": 19}


def checksum(data: bytes) -> int:
    """CRC-32C bit by bit, turned and shifted as both files store it."""
    state = 0xFFFFFFFF
    for byte in data:
        state ^= byte
        for _ in range(8):
            state = state >> 1 ^ (0x82F63B78 if state & 1 else 0)
    state ^= 0xFFFFFFFF
    return ((state >> 15 | state << 17 & 0xFFFFFFFF) + 0xA282EAD8) % 2**32


def number(value: int) -> bytes:
    value %= 2**64
    out = b""
    while value > 127:
        out += bytes([value % 128 + 128])
        value //= 128
    return out + bytes([value])


def field(place: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return number(place * 8) + number(value)
    return number(place * 8 + 2) + number(len(value)) + value


def fixed32(place: int, value: int) -> bytes:
    return number(place * 8 + 5) + struct.pack("<I", value)


def shape_message(shape: tuple[int, ...]) -> bytes:
    return b"".join(field(2, field(1, size)) for size in shape)


# The table.


def literal(data: bytes) -> bytes:
    """Snappy without any copy."""
    out = number(len(data))
    for start in range(0, len(data), 60):
        piece = data[start : start + 60]
        out += bytes([(len(piece) - 1) << 2]) + piece
    return out


def block(entries: list[tuple[bytes, bytes]], interval: int) -> bytes:
    """Entries with shared beginnings, which start again every ``interval`` entries."""
    out, restarts, last = b"", [], b""
    for i, (key, value) in enumerate(entries):
        shared = 0
        if i % interval == 0:
            restarts.append(len(out))
        else:
            while shared < min(len(last), len(key)) and last[shared] == key[shared]:
                shared += 1
        out += number(shared) + number(len(key) - shared) + number(len(value)) + key[shared:] + value
        last = key
    restarts = restarts or [0]
    return out + b"".join(struct.pack("<I", at) for at in restarts) + struct.pack("<I", len(restarts))


def table(entries: list[tuple[bytes, bytes]], *, per_block: int = 4, interval: int = 3, snappy: bool = False) -> bytes:
    """A sorted table of several blocks."""
    out = b""

    def add(content: bytes) -> bytes:
        nonlocal out
        content = literal(content) if snappy else content
        place = number(len(out)) + number(len(content))
        kind = bytes([int(snappy)])
        out += content + kind + struct.pack("<I", checksum(content + kind))
        return place

    entries = sorted(entries)
    parts = [entries[i : i + per_block] for i in range(0, len(entries), per_block)]
    index = [(part[-1][0] + b"\x00", add(block(part, interval))) for part in parts]
    footer = add(block([], 1)) + add(block(index, 1))
    return out + footer.ljust(40, b"\x00") + struct.pack("<Q", 0xDB4775248B80FB57)


# The bundle.


def write_bundle(
    prefix: Path,
    tensors: Arrays,
    *,
    shards: int = 1,
    change: Callable[[str, dict[int, bytes]], object] = lambda name, fields: None,
    **options: int,
) -> Path:
    """``prefix.index`` and ``prefix.data-…``, tensors in turn in each shard; ``change`` edits an entry's fields."""
    data = [b""] * shards
    entries = [(b"", field(1, shards) + field(3, field(1, 1)))]
    for i, name in enumerate(sorted(tensors)):
        value, shard = tensors[name], i % shards
        content = value.tobytes()
        fields = {
            1: field(1, CODES[str(value.dtype)]),
            2: field(2, shape_message(value.shape)),
            3: field(3, shard) if shard else b"",
            4: field(4, len(data[shard])) if data[shard] else b"",
            5: field(5, len(content)),
            6: fixed32(6, checksum(content)),
        }
        change(name, fields)
        entries.append((name.encode(), b"".join(fields.values())))
        data[shard] += content
    for i, content in enumerate(data):
        prefix.with_name(f"{prefix.name}.data-{i:05d}-of-{shards:05d}").write_bytes(content)
    index = prefix.with_name(f"{prefix.name}.index")
    index.write_bytes(table(entries, **options))
    return index


# The graph.


def constant(name: str, value: np.ndarray, *, as_list: bool = False) -> bytes:
    """A node ``Const``; the value as bytes, or as a list of numbers."""
    numbers = number(5 * 8 + 2) + number(4 * value.size) + value.astype("<f4").tobytes() if as_list else b""
    content = b"" if as_list else field(4, value.tobytes())
    tensor = field(1, CODES[str(value.dtype)]) + field(2, shape_message(value.shape)) + content + numbers
    return node(name, "Const", {"dtype": field(6, CODES[str(value.dtype)]), "value": field(8, tensor)})


def node(name: str, kind: str, attributes: Mapping[str, bytes] = {}, inputs: tuple[str, ...] = ()) -> bytes:
    out = field(1, name.encode()) + field(2, kind.encode()) + b"".join(field(3, each.encode()) for each in inputs)
    return out + b"".join(field(5, field(1, key.encode()) + field(2, value)) for key, value in attributes.items())


def write_graph(path: Path, constants: Arrays) -> Path:
    """A frozen graph: constants, the nodes that read them, and some of what computes."""
    nodes = [node("input_node", "Placeholder", {"dtype": field(6, 1)})]
    for name, value in constants.items():
        nodes += [constant(name, value), node(f"{name}/read", "Identity", {"T": field(6, 1)}, (name,))]
    nodes.append(constant("Reshape/shape", np.array([-1, 494], np.int32)))
    nodes.append(constant("Minimum/y", np.array(20.0, np.float32), as_list=True))
    nodes.append(node("logits", "Reshape", {}, ("Add_4", "Reshape_3/shape")))
    path.write_bytes(b"".join(field(1, each) for each in nodes) + field(4, field(1, 24)))
    return path
