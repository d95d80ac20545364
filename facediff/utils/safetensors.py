"""Tensors in ``.safetensors`` files: a header in JSON that says where each tensor lies, then their bytes.

The format holds no code, but a file from elsewhere may declare anything. The header is therefore checked against the
file's true length and the budget of :mod:`facediff.utils.limits` before a tensor is made, by our own reader: sizes must
be known before they are believed. Writing is left to the library.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from facediff.errors import FaceDiffError
from facediff.utils.limits import LIMITS, quoted
from facediff.utils.plain_files import parse_json

if TYPE_CHECKING:
    import torch

HEADER_BYTES = 64 * 2**20
"""Longest header: names, types and sizes of two hundred thousand tensors or more."""

TYPES = {
    "F64": ("float64", 8),
    "F32": ("float32", 4),
    "F16": ("float16", 2),
    "BF16": ("bfloat16", 2),
    "I64": ("int64", 8),
    "I32": ("int32", 4),
    "I16": ("int16", 2),
    "I8": ("int8", 1),
    "U8": ("uint8", 1),
    "BOOL": ("bool", 1),
}
"""PyTorch's name of each type of numbers, and its bytes."""

DAMAGED = "the file is damaged, copy or download it again, in a git clone by `git lfs pull`"


def write_safetensors(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    """Write tensors; not atomic."""
    from safetensors.torch import save

    # Through our own hands, since the library gives its files to their owner alone.
    path.write_bytes(
        save({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, {"format": "pt"})
    )


def read_safetensors(path: Path) -> dict[str, torch.Tensor]:
    """The tensors of a file, on the CPU."""
    import torch

    try:
        with path.open("rb") as stream:
            size = path.stat().st_size
            LIMITS.check("bytes", size, path)
            places, start = _header(path, stream.read(8), stream.read, size)
            data = bytearray(size - start)
            if stream.readinto(data) != len(data):
                raise FaceDiffError(f"{path}: is cut short; {DAMAGED}")
    except OSError as error:
        raise FaceDiffError(
            f"{path}: cannot be read ({error.strerror or error}); expected the weights of a model that `facediff "
            f"publish` has written"
        ) from error
    tensors: dict[str, torch.Tensor] = {}
    for name, (kind, shape, begin) in places.items():
        dtype, count = getattr(torch, TYPES[kind][0]), math.prod(shape)
        if not count:
            tensors[name] = torch.empty(shape, dtype=dtype)
        elif kind == "BOOL":  # a byte that is neither 0 nor 1 is no truth value
            tensors[name] = torch.frombuffer(data, dtype=torch.uint8, count=count, offset=begin).reshape(shape) != 0
        elif begin % TYPES[kind][1]:
            own = bytearray(data[begin : begin + count * TYPES[kind][1]])
            tensors[name] = torch.frombuffer(own, dtype=dtype, count=count).reshape(shape)
        else:
            tensors[name] = torch.frombuffer(data, dtype=dtype, count=count, offset=begin).reshape(shape)
    return tensors


def _header(path: Path, first: bytes, read: Any, size: int) -> tuple[dict[str, tuple[str, list[int], int]], int]:  # noqa: ANN401
    """Type, shape and first byte of each tensor by name, and where the tensors begin; all sizes agree."""
    length = int.from_bytes(first, "little")
    if len(first) < 8 or not 2 <= length <= min(HEADER_BYTES, size - 8):
        raise FaceDiffError(
            f"{path}: no safetensors file, or cut short (its header has {length} of {size} bytes); {DAMAGED}"
        )
    header = parse_json(read(length), path, remedy=DAMAGED)
    if not isinstance(header, dict):
        raise FaceDiffError(f"{path}: its header is {quoted(header)}; {DAMAGED}")
    header.pop("__metadata__", None)
    LIMITS.check("entries", len(header), path)
    places: dict[str, tuple[str, list[int], int]] = {}
    for name, entry in header.items():
        fields: dict[str, Any] = entry if isinstance(entry, dict) else {}
        kind, shape, span = (cast(Any, fields.get(key)) for key in ("dtype", "shape", "data_offsets"))
        if not isinstance(kind, str) or kind not in TYPES or not _sizes(shape) or not _sizes(span) or len(span) != 2:
            raise FaceDiffError(f"{path}: its tensor {quoted(name)} is declared as {quoted(entry)}; {DAMAGED}")
        if span[1] - span[0] != math.prod(shape) * TYPES[kind][1]:
            raise FaceDiffError(f"{path}: its tensor {quoted(name)} has other bytes than its shape needs; {DAMAGED}")
        places[name] = (kind, shape, span[0])
    end = 0
    for name, (kind, shape, begin) in sorted(places.items(), key=lambda item: (item[1][2], math.prod(item[1][1]))):
        if begin != end:
            raise FaceDiffError(f"{path}: its tensor {quoted(name)} begins at {begin} in place of {end}; {DAMAGED}")
        end += math.prod(shape) * TYPES[kind][1]
    if end != size - 8 - length:
        raise FaceDiffError(
            f"{path}: its tensors take {end} bytes, and the file has {size - 8 - length} for them; {DAMAGED}"
        )
    if sys.byteorder != "little":  # pragma: no cover - PyTorch has no such platform any more
        raise FaceDiffError(f"{path}: numbers are stored with the small end first, which this processor does not read")
    return places, 8 + length


def _sizes(value: object) -> bool:
    """Whether a value is a short list of sizes that fit into a file."""
    if not isinstance(value, list) or len(value) > 64:
        return False
    return all(isinstance(size, int) and not isinstance(size, bool) and 0 <= size < 1 << 48 for size in value)
