"""Files of TensorFlow from elsewhere, read without TensorFlow: tensors of a checkpoint, and constants of a graph.

A checkpoint of TensorFlow 1 and 2 is a *bundle*: ``NAME.index`` says where the bytes of every tensor lie in
``NAME.data-00000-of-00001``. The index is a sorted table as LevelDB writes one, whose values are messages of Protocol
Buffers. A frozen graph (``output_graph.pb``) is one such message, whose nodes of the type ``Const`` hold the weights.
From top to bottom: shapes, the checksum, the table, the bundle, the graph. Both formats are public; nothing of a file
is run, and every size and place that it states is compared with the file before it is believed.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.utils.limits import LIMITS, quoted
from facediff.utils.protobuf import (
    DamagedError,
    Message,
    bytes_field,
    decode_name,
    integer_field,
    parse_message,
    read_varint,
)

if TYPE_CHECKING:
    from torch import Tensor

BUNDLE = "expected the files NAME.index and NAME.data-00000-of-00001 of a TensorFlow checkpoint, whole and of one run"
GRAPH = "expected a frozen graph of TensorFlow such as output_graph.pb, as it was unpacked"

INDEX_BYTES = 64 * 2**20
"""Most bytes of an index, and of one of its blocks: names and places of tensors, not their values."""

FILLED = 1 << 20
"""Most numbers of a tensor that a file states by fewer numbers than it has."""

NAME_BYTES = 4096
"""Most bytes of a tensor's name."""

RANK = 32
"""Most dimensions of a tensor."""

TYPES = {1: "<f4", 2: "<f8", 3: "<i4", 4: "u1", 5: "<i2", 6: "i1", 9: "<i8", 10: "?", 19: "<f2"}
"""Types of numbers by TensorFlow's codes, as NumPy writes them; others (texts, resources) are no weights."""

FLOATS = {1: "<f4", 2: "<f8", 19: "<f2"}
"""Those of them that weights have."""


def parse_shape(view: memoryview) -> tuple[int, ...]:
    """A tensor's shape.

    Raises:
        DamagedError: if it has an unknown size, or too many dimensions.
    """
    fields = parse_message(view)
    dims = fields.get(2, [])
    if len(dims) > RANK or integer_field(fields, 3):
        raise DamagedError("a tensor in it has no shape")
    sizes = [integer_field(parse_message(dim), 1) if isinstance(dim, memoryview) else -1 for dim in dims]
    if any(size < 0 for size in sizes):
        raise DamagedError("a tensor in it has no shape")
    return tuple(sizes)


# The checksum of both files: CRC-32C (Castagnoli), which zlib does not have.


@cache
def crc_table() -> list[int]:
    """The CRC of every single byte, by the reversed polynomial 0x82F63B78."""
    table = list(range(256))
    for _ in range(8):
        table = [entry >> 1 ^ (entry & 1) * 0x82F63B78 for entry in table]
    return table


def crc32c(data: bytes | memoryview) -> int:
    """The CRC-32C of some bytes; about five megabytes a second, two seconds for VOCA's released weights.

    >>> hex(crc32c(b"123456789"))
    '0xe3069283'
    """
    table, state = crc_table(), 0xFFFFFFFF
    for byte in bytes(data):
        state = table[(state ^ byte) & 255] ^ (state >> 8)
    return state ^ 0xFFFFFFFF


def masked_crc(checksum: int) -> int:
    """A checksum as the files store it, turned and shifted, so that a text with its own checksum has no special one."""
    return ((checksum >> 15 | checksum << 17) + 0xA282EAD8) & 0xFFFFFFFF


# The table.

FOOTER, MAGIC = 48, bytes.fromhex("57fb808b247547db")
"""Bytes at the end of a table, and the last of them."""


def read_table(content: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Keys and values of a sorted table, in their order.

    Raises:
        DamagedError: if it is damaged.
    """
    if len(content) < FOOTER or bytes(content[-8:]) != MAGIC:
        raise DamagedError("it is no index, or cut short")
    footer = content[-FOOTER:]
    _, at = block_handle(footer, 0)
    (offset, size), _ = block_handle(footer, at)
    last: bytes | None = None
    count = 0
    for _, place in read_block(checked_block(content, offset, size)):
        (offset, size), _ = block_handle(place, 0)
        for key, value in read_block(checked_block(content, offset, size)):
            # This also ends an index that names the same block again and again.
            if last is not None and key <= last:
                raise DamagedError("its names are not sorted")
            last, count = key, count + 1
            if count > LIMITS.entries:
                raise DamagedError("it has more entries than the budget allows")
            yield key, value


def block_handle(view: memoryview, at: int) -> tuple[tuple[int, int], int]:
    """Offset and size of a block, and where the two numbers end."""
    offset, at = read_varint(view, at)
    size, at = read_varint(view, at)
    return (offset, size), at


def checked_block(content: memoryview, offset: int, size: int) -> memoryview:
    """A block's content, whose checksum is right.

    Raises:
        DamagedError: if it lies outside of the table, or is damaged.
    """
    if offset + size + 5 > len(content) - FOOTER:
        raise DamagedError("a block of it lies outside of it")
    body = content[offset : offset + size + 1]
    if masked_crc(crc32c(body)) != int.from_bytes(content[offset + size + 1 : offset + size + 5], "little"):
        raise DamagedError("a block of it has another checksum than it states")
    if body[size] == 0:
        return body[:size]
    if body[size] == 1:
        return memoryview(decompress_snappy(body[:size]))
    raise DamagedError("it is compressed in an unknown way")


def read_block(view: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Keys and values of a block, where a key omits what it shares with the key before.

    Raises:
        DamagedError: if it is damaged.
    """
    restarts = int.from_bytes(view[-4:], "little")
    end = len(view) - 4 * (restarts + 1)
    if len(view) < 4 or end < 0:
        raise DamagedError("a block of it is cut short")
    at, key = 0, b""
    while at < end:
        shared, at = read_varint(view[:end], at)
        own, at = read_varint(view[:end], at)
        size, at = read_varint(view[:end], at)
        if shared > len(key) or shared + own > NAME_BYTES or own + size > end - at:
            raise DamagedError("an entry of it is cut short")
        key = key[:shared] + bytes(view[at : at + own])
        yield key, view[at + own : at + own + size]
        at += own + size


def decompress_snappy(view: memoryview) -> bytes:
    """Decompress Snappy: literal bytes, and copies of earlier output.

    >>> decompress_snappy(memoryview(bytes([6, 0b100]) + b"ab" + bytes([0b000_000_01, 2])))
    b'ababab'

    Raises:
        DamagedError: if it is damaged, or longer than a block may be.
    """
    size, at = read_varint(view, 0)
    if size > INDEX_BYTES:
        raise DamagedError("a block of it is too long")
    output = bytearray()
    while at < len(view):
        tag = view[at]
        at += 1
        kind, count = tag & 3, tag >> 2
        extra = (max(0, count - 59) if count >= 60 else 0) if kind == 0 else (0, 1, 2, 4)[kind]
        if extra > len(view) - at:
            raise DamagedError("a block of it is cut short")
        further = int.from_bytes(view[at : at + extra], "little")
        at += extra
        if kind == 0:
            length = (further if count >= 60 else count) + 1
            if length > len(view) - at:
                raise DamagedError("a block of it is cut short")
            output += view[at : at + length]
            at += length
        else:
            length = (count & 7) + 4 if kind == 1 else count + 1
            back = further | (count >> 3) << 8 if kind == 1 else further
            if not 0 < back <= len(output):
                raise DamagedError("a block of it is damaged")
            # What is copied may reach into the copy itself.
            pattern = output[-back:]
            output += (pattern * (length // back + 1))[:length]
        if len(output) > size:
            break
    if len(output) != size:
        raise DamagedError("a block of it is damaged")
    return bytes(output)


# The bundle.


def read_bundle(index: Path, shards: Sequence[Path] = ()) -> dict[str, Tensor]:
    """All tensors of a TensorFlow checkpoint by name; what are no numbers, such as texts, is left out.

    Args:
        index: the file ``NAME.index``.
        shards: files with the tensors' bytes, by their names; those that are not among them lie next to the index.
    """
    import torch

    with reading(index, BUNDLE):
        if index.stat().st_size > INDEX_BYTES:
            raise DamagedError("it is too long for an index")
        entries = dict(read_table(memoryview(index.read_bytes())))
        header = parse_message(entries.pop(b"", memoryview(b"")))
        count = integer_field(header, 1)
        if not 0 < count < 100_000 or integer_field(header, 2):
            raise DamagedError("it has no header of a checkpoint" if count <= 0 else "its byte order is unusual")
        tensors = [(decode_name(memoryview(key)), parse_message(value)) for key, value in entries.items()]
        LIMITS.check("bytes", sum(max(0, integer_field(entry, 5)) for _, entry in tensors), index)
    files: dict[int, Shard] = {}
    weights: dict[str, Tensor] = {}
    for name, entry in tensors:
        with reading(index, BUNDLE):
            kind, number, shape = (
                TYPES.get(integer_field(entry, 1)),
                integer_field(entry, 3),
                parse_shape(bytes_field(entry, 2)),
            )
            offset, size, checksum = integer_field(entry, 4), integer_field(entry, 5), bytes_field(entry, 6)
            if kind is None:
                continue
            if 7 in entry:
                raise DamagedError(f"its tensor {quoted(name)} is stored in slices")
            if math.prod(shape) * np.dtype(kind).itemsize != size:
                raise DamagedError(f"its tensor {quoted(name)} has another size than its shape")
            if not 0 <= number < count:
                raise DamagedError(f"its tensor {quoted(name)} lies in no file of it")
        if number not in files:
            file_name = f"{index.name.removesuffix('.index')}.data-{number:05d}-of-{count:05d}"
            files[number] = Shard(
                next((shard for shard in shards if shard.name == file_name), index.with_name(file_name))
            )
        content = files[number].read_tensor(name, offset, size, int.from_bytes(checksum, "little"))
        weights[name] = torch.from_numpy(np.frombuffer(bytearray(content), kind).reshape(shape))
    return weights


class Shard:
    """A file with the bytes of tensors.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FaceDiffError(f"{path}: no such file; {BUNDLE}")
        self.path, self.size = path, path.stat().st_size

    def read_tensor(self, name: str, offset: int, size: int, checksum: int) -> bytes:
        """The bytes of a tensor."""
        with reading(self.path, BUNDLE):
            if not 0 <= offset <= self.size - size:
                raise DamagedError(f"the tensor {quoted(name)} lies outside of it")
            with self.path.open("rb") as stream:
                stream.seek(offset)
                content = stream.read(size)
            if masked_crc(crc32c(content)) != checksum:
                raise DamagedError(f"the tensor {quoted(name)} has another checksum than the index states")
            return content


# The graph.


def map_file(path: Path) -> memoryview:
    """A file's bytes, read as they are looked at."""
    if not path.stat().st_size:
        return memoryview(b"")
    with path.open("rb") as stream:
        return memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))


def read_graph(path: Path) -> dict[str, Tensor]:
    """Weights of a frozen graph, by name: its floating-point constants of one dimension or more."""
    import torch

    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; {GRAPH}")
    weights: dict[str, Tensor] = {}
    with reading(path, GRAPH):
        LIMITS.check("bytes", path.stat().st_size, path)
        content = map_file(path)
        used = 0
        for node in parse_message(content.cast("B")).get(1, []):
            if not isinstance(node, memoryview):
                raise DamagedError("it holds no nodes")
            fields = parse_message(node)
            if bytes(bytes_field(fields, 2)) != b"Const":
                continue
            value = constant_value(fields)
            if value is None:
                continue
            name = decode_name(bytes_field(fields, 1))
            if name in weights:
                raise DamagedError(f"two of its nodes are called {quoted(name)}")
            used += value.nbytes
            LIMITS.check("bytes", used, path)
            weights[name] = torch.from_numpy(value)
        if not weights:
            raise DamagedError("it holds no weights")
    return weights


def constant_value(node: Message) -> npt.NDArray[np.floating] | None:
    """The value of a constant; None if it is a single number, or none of floating point.

    Raises:
        DamagedError: if it is damaged.
    """
    for entry in node.get(5, []):
        attribute = parse_message(entry) if isinstance(entry, memoryview) else {}
        if bytes(bytes_field(attribute, 1)) == b"value":
            tensor = parse_message(bytes_field(parse_message(bytes_field(attribute, 2)), 8))
            break
    else:
        return None
    kind, shape = FLOATS.get(integer_field(tensor, 1)), parse_shape(bytes_field(tensor, 2))
    if kind is None or not shape:
        return None
    count, content = math.prod(shape), bytes_field(tensor, 4)
    if not len(content):
        # Few numbers stand in a list of their own, where the last one is repeated as often as the shape needs.
        field, item = {"<f4": (5, 4), "<f8": (6, 8), "<f2": (13, 0)}[kind]
        pieces = [entry for entry in tensor.get(field, []) if isinstance(entry, memoryview)]
        stated = np.frombuffer(b"".join(pieces), kind) if item else np.zeros(0, kind)
        if not 0 < len(stated) <= count <= max(FILLED, len(stated)):
            raise DamagedError("a constant of it has another size than its shape")
        return np.concatenate([stated, np.repeat(stated[-1:], count - len(stated))]).reshape(shape)
    if len(content) != count * np.dtype(kind).itemsize:
        raise DamagedError("a constant of it has another size than its shape")
    return np.frombuffer(bytearray(content), kind).reshape(shape)


@contextmanager
def reading(path: Path, remedy: str) -> Iterator[None]:
    """A context in which whatever a damaged file makes its readers raise becomes one sentence that names the file."""
    try:
        yield
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror or error}); {remedy}") from error
    except (ValueError, IndexError, OverflowError, MemoryError) as error:
        reason = str(error) if isinstance(error, DamagedError) else "it is damaged"
        raise FaceDiffError(f"{path}: {reason}; {remedy}") from error
