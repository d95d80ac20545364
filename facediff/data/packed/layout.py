"""The format of a packed corpus, and the record in its ``zarr.json``.

A packed corpus is a Zarr (version 3) group. Its attribute ``facediff`` is the record below, its arrays are

- ``motion_<coding>``, (rows, 3V): the frames of all clips one after the other. A clip begins at the first row of a
  chunk, so that a window is read without any other clip. ``int16`` and ``int32`` hold offsets from the speaker's
  template in steps of twice the tolerance; ``float16``, ``float32`` and ``float64`` the bits of absolute vertices, for
  lossless packing. In each chunk the first row is stored as it is, and every further row as its difference from the
  row before, in whole numbers that wrap around.
- ``templates``, (identities, 3V): the neutral faces, float32.
- ``speech``, (bytes,): FLAC streams of at most ten seconds, so that a window of a long recording is decoded alone.
- ``files``, (bytes,): every other file of the corpus folder as it was.

All are sharded, and their chunks are compressed by Blosc (zstd after a bit shuffle; motion of 1.1 also by lz4) and end
in a CRC-32C: ordinary codecs of Zarr, so that any of its implementations reads them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np

from facediff.data.manifest import LONGEST
from facediff.errors import damaged
from facediff.spaces.space import metres_per_unit
from facediff.utils.limits import FRAME_RATES, SAMPLE_RATES, check_format, quoted
from facediff.utils.plain_files import parse_json
from facediff.utils.ranges import Range
from facediff.utils.records import Text, read_record

FORMAT = "facediff packed corpus 1"
RECORD = "facediff"
"""The attribute of the group that holds the record."""
METADATA = "zarr.json"
STATE = "pack.json"
"""Exists while packing runs or after it was interrupted; ``zarr.json`` of the group appears last."""

Type = np.dtype[np.signedinteger[Any]]
ExactCoding = Literal["float16", "float32", "float64"]
Coding = Literal["int16", "int32", "float16", "float32", "float64"]
QUANTISED: dict[str, Type] = {"int16": np.dtype("<i2"), "int32": np.dtype("<i4")}
EXACT: dict[str, Type] = {"float16": np.dtype("<i2"), "float32": np.dtype("<i4"), "float64": np.dtype("<i8")}
CODINGS: dict[str, Type] = {**QUANTISED, **EXACT}
"""Type of the stored whole numbers by the coding of a motion array."""
ROOM = 250.0
"""Offsets are stored in 16 bits if these can hold as many millimetres; else in 32."""
SHARD_BYTES = 64 << 20
"""Approximate bytes of a shard before compression: some twelve megabytes as an object in a store."""
BLOB_CHUNK = 1 << 16
"""Bytes of a chunk of speech and files."""
BLOB_SHARD = 1 << 25
CHUNK_SECONDS = 0.5
"""Length of the pieces in which motion is read."""
PIECE_SECONDS = 10
"""Seconds of a FLAC stream."""
MARGIN = 0.99
"""Share of the tolerance for quantisation; the rest is for the rounding of vertices to single precision."""

REMEDY = "get the packed corpus again, or pack it again"
DAMAGED = "the packed corpus is damaged, " + REMEDY

Whole = Annotated[int, Range(0, 2**53)]
Positive = Annotated[int, Range(1, 2**53)]
Number = Annotated[float, Range(0, 2**53)]
Name = Annotated[str, Text(r"[^\x00-\x1f\x7f]*", "printable characters", LONGEST)]
PLAIN_NAME = Text(r"[^./\\:\x00-\x1f\x7f][^/\\:\x00-\x1f\x7f]*", "a plain name", LONGEST)
"""Of a clip or an identity, which is the name of a file in any folder."""
PlainName = Annotated[str, PLAIN_NAME]


@dataclass(frozen=True)
class PackedSound:
    """The place and form of a clip's speech."""

    first: Whole  # its first byte in speech
    pieces: tuple[Positive, ...]  # bytes of each of its streams
    # flac, or wav for a recording that was kept as it was, since FLAC cannot hold its samples
    form: Literal["flac", "wav"]
    rate: Annotated[int, Range(*SAMPLE_RATES)]  # samples a second
    channels: Annotated[int, Range(1, 64)]  # number of channels
    samples: Positive  # samples of each channel
    bits: Literal[0, 16, 24]  # bits of a sample, 16 or 24; 0 for a recording kept as it was


@dataclass(frozen=True)
class PackedClip:
    """The place of a clip in the arrays."""

    name: PlainName  # the clip's name
    identity: PlainName  # who speaks
    coding: Coding  # names the motion array
    dtype: ExactCoding  # type of the vertices before they were packed
    first: Whole  # its first row in that array
    frames: Positive  # its number of frames
    sound: PackedSound  # its speech


@dataclass(frozen=True)
class PackedFile:
    """A file of the corpus folder in the array ``files``: path below the folder, first byte, size, SHA-256."""

    path: Name
    first: Whole
    bytes: Whole
    sha256: Name


@dataclass(frozen=True)
class ArrayInfo:
    """Shape and chunks of an array, which is divided along its first axis."""

    dtype: str  # type of its numbers
    rows: Whole  # length of the first axis
    width: Whole  # length of the second axis; 0 for an array of one axis
    chunk: Annotated[int, Range(1, 2**31)]  # rows of a chunk
    chunks: Annotated[int, Range(1, 2**20)]  # chunks of a shard
    shards: tuple[Whole, ...]  # bytes of each shard's file

    @property
    def chunk_bytes(self) -> int:
        """Bytes of a chunk once it is decoded."""
        return self.chunk * max(1, self.width) * np.dtype(self.dtype).itemsize


@dataclass(frozen=True)
class Record:
    """The record of a packed corpus."""

    made_by: Name  # version of facediff that packed it
    corpus: Name  # name of the corpus
    n_vertices: Positive  # vertices of its meshes
    frame_rate: Annotated[float, Range(*FRAME_RATES)]  # stored motion frames a second
    tolerance: Number  # millimetres by which a coordinate may differ from the original; 0 for lossless packing
    step: Number  # one step of the stored offsets in the corpus's unit; 0 for lossless packing
    unit: Name  # the corpus's unit of length; any text for lossless packing, which does not use it
    chunk_seconds: Number  # the requested length of a chunk
    identities: tuple[PlainName, ...]  # rows of templates
    clips: Mapping[str, PackedClip] = field(default_factory=dict)  # every clip, by name
    files: Mapping[str, PackedFile] = field(default_factory=dict)  # every other file, by path
    arrays: Mapping[str, ArrayInfo] = field(default_factory=dict)  # the arrays, by name
    sources: str = ""  # hash of size and time of the corpus's files; empty if packed by facediff 1

    @classmethod
    def read(cls, text: bytes, source: str) -> Record:
        """The record in a group's ``zarr.json``; every field is checked, since the file may be hostile."""
        name = f"{source}/{METADATA}"
        content = parse_json(text, name, remedy=REMEDY)
        with damaged(name, REMEDY):
            plain = content["attributes"][RECORD]
            check_format(name, plain.get("format"), FORMAT)
            parts = {"clips": _by(plain["clips"], "name"), "files": _by(plain["files"], "path")}
            record = read_record(cls, {**plain, **parts}, name, remedy=REMEDY, strict=False)
            if fault := next(contradictions(record), None):
                raise ValueError(fault)
        return record

    def state(self) -> dict[str, Any]:
        """Plain data for the attribute."""
        plain = {attribute.name: getattr(self, attribute.name) for attribute in fields(self)}
        for name in ("clips", "files"):
            plain[name] = [asdict(entry) for entry in plain[name].values()]
        plain["arrays"] = {name: asdict(array) for name, array in self.arrays.items()}
        return {"format": FORMAT, **plain}


def step_of(tolerance: float, unit: str) -> float:
    """The step in a corpus's unit: rounding, by half a step at most, keeps a tolerance in millimetres."""
    return 2 * MARGIN * tolerance / (1000.0 * metres_per_unit(unit)) if tolerance else 0.0


def chunk_frames(frame_rate: float, seconds: float) -> int:
    """Frames of a chunk of motion."""
    return max(1, round(frame_rate * seconds))


def _by(entries: Sequence[dict[str, Any]], field: str) -> dict[str, dict[str, Any]]:
    mapping = {entry[field]: entry for entry in entries}
    if len(mapping) < len(entries):
        raise ValueError(f"two entries have the same {field}")
    return dict(sorted(mapping.items()))


def contradictions(record: Record) -> Iterator[str]:
    """Contradictions between declarations of a record, which determine the meaning of the stored numbers."""
    arrays, identities = record.arrays, record.identities
    rows = {name: array.rows for name, array in arrays.items()}
    dtypes = {"templates": "float32", "speech": "uint8", "files": "uint8"}
    dtypes |= {f"motion_{coding}": dtype.name for coding, dtype in CODINGS.items()}
    for name, array in arrays.items():
        width = 0 if dtypes.get(name) == "uint8" else 3 * record.n_vertices
        if (array.dtype, array.width) != (dtypes.get(name), width):
            yield f"the array {quoted(name)} is {quoted(array.dtype)} of width {array.width}"
        if len(array.shards) != math.ceil(array.rows / (array.chunk * array.chunks)):
            yield f"{name} has {len(array.shards)} shards, which do not hold {array.rows} rows"
    for clip in record.clips.values():
        if clip.identity not in identities:
            yield f"clip {clip.name} is of {quoted(clip.identity)}, who is none of identities"
        if clip.coding in EXACT and clip.coding != clip.dtype:
            yield f"clip {clip.name} was {clip.dtype}, but is coded as {clip.coding}"
        motion, sound = arrays.get(f"motion_{clip.coding}"), clip.sound
        if motion is None or clip.first % motion.chunk or clip.first + clip.frames > motion.rows:
            yield f"clip {clip.name} lies beyond its array"
        if (sound.form == "flac") != (sound.bits > 0):
            yield f"clip {clip.name} has speech of form {sound.form} with {sound.bits} bits"
        pieces = math.ceil(sound.samples / (PIECE_SECONDS * sound.rate)) if sound.bits else 1
        if len(sound.pieces) != pieces or sound.first + sum(sound.pieces) > rows.get("speech", 0):
            yield f"clip {clip.name} has speech that lies beyond its array"
    for file in record.files.values():
        if not _is_relative(file.path) or file.first + file.bytes > rows.get("files", 0):
            yield f"its file {quoted(file.path)} is no plain path below the folder, or lies beyond its array"
    codings = {clip.coding for clip in record.clips.values()}
    step = step_of(record.tolerance, record.unit)
    if not math.isclose(record.step, step, rel_tol=1e-6) or not (step or codings.isdisjoint(QUANTISED)):
        expected = f"{step:.6g}" if step else "a tolerance above 0, since motion is quantised"
        yield f"step is {record.step:.6g} at a tolerance of {record.tolerance:g} mm; expected {expected}"
    frames = chunk_frames(record.frame_rate, record.chunk_seconds)
    if chunks := [arrays[f"motion_{coding}"].chunk for coding in codings if arrays[f"motion_{coding}"].chunk != frames]:
        yield f"motion has chunks of {chunks[0]} frames; expected {frames}"
    if not rows.get("templates", 0) == len(identities) == len(set(identities)):
        yield f"identities has {len(identities)} names; expected {rows.get('templates', 0)} different ones"


def _is_relative(path: str) -> bool:
    """Whether a path stays below the folder that it is unpacked into."""
    parts = PurePosixPath(path).parts
    odd = "\\" in path or ":" in path or not parts or path != "/".join(parts)
    return not odd and not PurePosixPath(path).is_absolute() and not any(part.startswith(".") for part in parts)


def check_array_metadata(text: bytes, name: str, array: ArrayInfo) -> None:
    """Refuse an array that its own ``zarr.json`` describes otherwise than the record, or with other codecs.

    Only the codecs that ``facediff data pack`` writes are ever run; Zarr knows others, some of which run code.
    """
    content = parse_json(text, name, remedy=REMEDY)
    width = (array.width,) if array.width else ()
    expected = {
        "shape": [array.rows, *width],
        "data_type": array.dtype,
        "chunk_grid": [array.chunk * array.chunks, *width],
        "chunk_shape": [array.chunk, *width],
        "index_location": "end",
        "codecs": ["sharding_indexed", "bytes", "blosc", "crc32c"],
        "index_codecs": ["bytes", "crc32c"],
    }
    with damaged(name, REMEDY):
        (codec,) = content["codecs"]
        inner = codec["configuration"]
        declared = {
            "shape": content["shape"],
            "data_type": content["data_type"],
            "chunk_grid": content["chunk_grid"]["configuration"]["chunk_shape"],
            "chunk_shape": inner["chunk_shape"],
            "index_location": inner.get("index_location", "end"),
            "codecs": [codec["name"], *(inner_codec["name"] for inner_codec in inner["codecs"])],
            "index_codecs": [inner_codec["name"] for inner_codec in inner["index_codecs"]],
        }
        if odd := next((part for part in expected if declared[part] != expected[part]), None):
            raise ValueError(f"{odd} is {quoted(declared[odd])}; expected {quoted(expected[odd])}")
