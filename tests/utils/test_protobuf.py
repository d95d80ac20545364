"""Messages of Protocol Buffers are read as Google's own library writes them, and damage is named."""

from __future__ import annotations

import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from facediff.utils.protobuf import (
    DamagedError,
    bytes_field,
    decode_name,
    integer_field,
    parse_message,
    read_varint,
)


@given(
    ints=st.lists(st.integers(-(2**63), 2**63 - 1), max_size=9),
    name=st.text(max_size=200),
    data=st.binary(max_size=300),
    number=st.floats(width=32, allow_nan=False),
)
def test_fields_are_what_was_written(ints: list[int], name: str, data: bytes, number: float) -> None:
    written = onnx.AttributeProto(name=name, s=data, i=ints[0] if ints else 0, ints=ints, f=number)
    fields = parse_message(memoryview(written.SerializeToString()))
    of = {field.name: field.number for field in onnx.AttributeProto.DESCRIPTOR.fields}
    assert decode_name(bytes_field(fields, of["name"])) == name
    assert bytes(bytes_field(fields, of["s"])) == data
    assert integer_field(fields, of["i"]) == (ints[0] if ints else 0)
    assert [value - (1 << 64) if value >> 63 else value for value in fields.get(of["ints"], [])] == ints  # type: ignore[operator]
    assert integer_field(fields, 99, default=7) == 7


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"\x0a\x05abc", "cut short"),
        (b"\x0a\xff\xff\xff\xff\x7fabc", "cut short"),  # four gigabytes are stated
        (b"\x08\x80", "cut short"),
        (b"\x08" + b"\xff" * 10 + b"\x01", "64 bits"),
        (b"\x08" + b"\xff" * 9 + b"\x02", "64 bits"),
        (b"\x0b", "something else"),  # groups, which nobody writes any more
        (b"\x00\x01", "something else"),
    ],
)
def test_damage_is_named(data: bytes, problem: str) -> None:
    with pytest.raises(DamagedError, match=problem):
        parse_message(memoryview(data))


def test_fields_of_another_type_are_refused() -> None:
    fields = parse_message(memoryview(b"\x08\x05\x12\x02\xff\xfe"))
    with pytest.raises(DamagedError, match="another type"):
        bytes_field(fields, 1)
    with pytest.raises(DamagedError, match="another type"):
        integer_field(fields, 2)
    with pytest.raises(DamagedError, match="no text"):
        decode_name(bytes_field(fields, 2))
    assert read_varint(memoryview(b"\xff" * 9 + b"\x01"), 0) == (2**64 - 1, 10)
