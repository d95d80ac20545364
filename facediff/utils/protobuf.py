"""Protocol buffers, read as far as needed: the base install has no library for them."""

from __future__ import annotations

import mmap
from collections.abc import Iterator

Content = bytes | mmap.mmap


def parts(message: bytes) -> Iterator[tuple[int, bytes]]:
    """Number and content of each field in their order; :func:`whole_number` reads numbers of variable length."""
    return ((number, message[start:end]) for number, start, end in fields(message, 0, len(message)))


def whole_number(content: bytes) -> int:
    """The number that a field of variable length holds."""
    return varint(content, 0)[0]


def fields(content: Content, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """The fields of a message: their numbers, and where their values lie."""
    while start < end:
        key, start = varint(content, start)
        kind = key & 7
        if kind == 0:
            value, (_, start) = start, varint(content, start)
        elif kind == 2:
            length, value = varint(content, start)
            start = value + length
        else:
            value, start = start, start + {1: 8, 5: 4}[kind]
        if start > end:
            raise ValueError("cut short")
        yield key >> 3, value, start


def varint(content: Content, start: int) -> tuple[int, int]:
    """A whole number of variable length, 7 bits a byte from the lowest on, and where it ends.

    >>> varint(bytes([0xAC, 0x02]), 0)
    (300, 2)
    """
    value = shift = 0
    while shift < 64:
        byte = content[start]
        value |= (byte & 127) << shift
        start, shift = start + 1, shift + 7
        if byte < 128:
            return value, start
    raise ValueError("a number of more than 64 bits")
