"""Messages of Protocol Buffers, read without their definitions: the fields by their numbers.

Every length that a message states is compared with its bytes before it is believed.
"""

from __future__ import annotations

from facediff.utils.limits import LIMITS


class DamagedError(ValueError):
    """What is wrong with a file, for the sentence that names it."""


Message = dict[int, list["int | memoryview"]]
"""The values of a message by the number of their field, in their order: whole numbers, or bytes."""


def read_varint(view: memoryview, at: int) -> tuple[int, int]:
    """A whole number of variable length, 7 bits a byte from the lowest on, and where it ends.

    >>> read_varint(memoryview(bytes([0xAC, 0x02])), 0)
    (300, 2)

    Raises:
        DamagedError: if it has no end within the bytes, or takes more than 64 bits.
    """
    if at < len(view) and view[at] < 128:
        return view[at], at + 1
    value = 0
    for number in range(10):
        if at >= len(view):
            raise DamagedError("a number in it is cut short")
        byte = view[at]
        value |= (byte & 127) << (7 * number)
        at += 1
        if byte < 128:
            if value >> 64:
                break
            return value, at
    raise DamagedError("a number in it takes more than 64 bits")


def parse_message(view: memoryview) -> Message:
    """The fields of a message, which may have been written by any version of its definition.

    Raises:
        DamagedError: if it is cut short, or is no message.
        FaceDiffError: if it has more fields than the budget allows.
    """
    fields: Message = {}
    at = count = 0
    end = len(view)
    while at < end:
        key = view[at]
        at += 1
        if key > 127:
            key, at = read_varint(view, at - 1)
        field, wire = key >> 3, key & 7
        value: int | memoryview
        # Other readers cut larger keys off after 32 bits, and would see another field.
        if not 0 < field < 1 << 29 or wire not in (0, 1, 2, 5):
            raise DamagedError("it holds something else than messages")
        if wire == 0:
            value, at = read_varint(view, at)
        else:
            if wire != 2:
                size = 8 if wire == 1 else 4
            elif at < end and view[at] < 128:  # as most are: read here, since calls take longer
                size, at = view[at], at + 1
            else:
                size, at = read_varint(view, at)
            if size > end - at:
                raise DamagedError("a message in it is cut short")
            value = view[at : at + size]
            at += size
        fields.setdefault(field, []).append(value)
        count += 1
        if count > LIMITS.entries:
            raise DamagedError("a message in it has more fields than the budget allows")
    return fields


def integer_field(fields: Message, number: int, default: int = 0) -> int:
    """The whole number of a field; the last one counts if there are several, as the format says.

    Raises:
        DamagedError: if it is of another type.
    """
    value = fields.get(number, [default])[-1]
    if isinstance(value, memoryview):
        raise DamagedError("a number in it has another type than expected")
    return value - (1 << 64) if value >> 63 else value


def bytes_field(fields: Message, number: int) -> memoryview:
    """The bytes of a field, of which the last counts; none if it is absent.

    Raises:
        DamagedError: if it is of another type.
    """
    value = fields.get(number, [memoryview(b"")])[-1]
    if not isinstance(value, memoryview):
        raise DamagedError("a message in it has another type than expected")
    return value


def decode_name(view: memoryview) -> str:
    """The text of a field.

    Raises:
        DamagedError: if it is no UTF-8.
    """
    try:
        return bytes(view).decode()
    except UnicodeDecodeError as error:
        raise DamagedError("a name in it is no text") from error
