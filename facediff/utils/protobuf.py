"""Protocol buffers without their library: the fields of a message by number."""

from __future__ import annotations

import struct
from collections.abc import Iterator


def fields(message: bytes) -> Iterator[tuple[int, bytes]]:
    """Number and content of each field in their order; whole numbers come as 8 bytes, little end first.

    Example:
        >>> [(number, len(content)) for number, content in fields(bytes([8, 1, 18, 2, 104, 105]))]
        [(1, 8), (2, 2)]
    """
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at, value, shift = at + 1, value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value

    while at < len(message):
        key = varint()
        if key & 7 == 0:
            yield key >> 3, struct.pack("<Q", varint() & 0xFFFF_FFFF_FFFF_FFFF)
            continue
        size = {1: 8, 5: 4}.get(key & 7) or varint()
        yield key >> 3, message[at : at + size]
        at += size
