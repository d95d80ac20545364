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

All are sharded, and their chunks are compressed by Blosc (zstd, or for motion lz4, after a bit shuffle) and end in a
CRC-32C: ordinary codecs of Zarr, so that any of its implementations reads them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import PurePosixPath
from typing import Any, Literal, cast, get_origin, get_type_hints

import numpy as np

from facediff.data.manifest import LONGEST
from facediff.errors import FaceDiffError
from facediff.spaces.space import metres_per_unit
from facediff.utils.limits import SAMPLE_RATES, check_format, quoted
from facediff.utils.plain_files import parse_json

FORMAT = "facediff packed corpus 1"
RECORD = "facediff"
"""The attribute of the group that holds the record."""
METADATA = "zarr.json"
SUFFIX = ".zarr"
STATE = "pack.json"
"""Exists while packing runs or after it was interrupted; ``zarr.json`` of the group appears last."""

Type = np.dtype[np.signedinteger[Any]]
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
PIECE_SECONDS = 10
"""Seconds of a FLAC stream."""
MARGIN = 0.99
"""Share of the tolerance for quantisation; the rest is for the rounding of vertices to single precision."""

CODECS: dict[str, tuple[Literal["zstd", "lz4hc"], int]] = {"zstd": ("zstd", 5), "lz4": ("lz4hc", 3)}
"""Blosc's codec for motion, and its level, by the name that the user chooses.

What lz4 writes is decoded in two thirds of the time and takes an eighth more room; higher levels change neither."""

REMEDY = "get the packed corpus again, or pack it again"
DAMAGED = "the packed corpus is damaged, " + REMEDY


@dataclass(frozen=True)
class PackedSound:
    """The place and form of a clip's speech.

    Attributes:
        first: its first byte in ``speech``.
        pieces: bytes of each of its streams.
        form: ``flac``, or ``wav`` for a recording that was kept as it was, since FLAC cannot hold its samples.
        rate: samples a second.
        channels: number of channels.
        samples: samples of each channel.
        bits: bits of a sample, 16 or 24; 0 for a recording kept as it was.
    """

    first: int
    pieces: tuple[int, ...]
    form: str
    rate: int
    channels: int
    samples: int
    bits: int


@dataclass(frozen=True)
class PackedClip:
    """The place of a clip in the arrays.

    Attributes:
        name: the clip's name.
        identity: who speaks.
        coding: names the motion array.
        dtype: type of the vertices before they were packed.
        first: its first row in that array.
        frames: its number of frames.
        sound: its speech.
    """

    name: str
    identity: str
    coding: str
    dtype: str
    first: int
    frames: int
    sound: PackedSound


@dataclass(frozen=True)
class PackedFile:
    """A file of the corpus folder in the array ``files``: path below the folder, first byte, size, SHA-256."""

    path: str
    first: int
    bytes: int
    sha256: str


@dataclass(frozen=True)
class ArrayFacts:
    """Shape and chunks of an array, which is divided along its first axis.

    Attributes:
        dtype: type of its numbers.
        rows: length of the first axis.
        width: length of the second axis; 0 for an array of one axis.
        chunk: rows of a chunk.
        chunks: chunks of a shard.
        shards: bytes of each shard's file.
    """

    dtype: str
    rows: int
    width: int
    chunk: int
    chunks: int
    shards: tuple[int, ...]

    @property
    def chunk_bytes(self) -> int:
        """Bytes of a chunk once it is decoded."""
        return self.chunk * max(1, self.width) * np.dtype(self.dtype).itemsize


@dataclass(frozen=True)
class Record:
    """The record of a packed corpus.

    Attributes:
        made_by: version of facediff that packed it.
        corpus: name of the corpus.
        n_vertices: vertices of its meshes.
        frame_rate: stored motion frames a second.
        tolerance: millimetres by which a coordinate may differ from what was packed; 0 for lossless packing.
        step: what one step of the stored offsets is, in the corpus's unit; 0 for lossless packing.
        unit: the corpus's unit of length; any text for lossless packing, which does not use it.
        chunk_seconds: the requested length of a chunk.
        identities: rows of ``templates``.
        clips: every clip, by name.
        files: every other file, by path.
        arrays: the arrays, by name.
        codec: of the motion; ``zstd`` in a record that does not name it.
    """

    made_by: str
    corpus: str
    n_vertices: int
    frame_rate: float
    tolerance: float
    step: float
    unit: str
    chunk_seconds: float
    identities: tuple[str, ...] = ()
    clips: Mapping[str, PackedClip] = field(default_factory=dict)
    files: Mapping[str, PackedFile] = field(default_factory=dict)
    arrays: Mapping[str, ArrayFacts] = field(default_factory=dict)
    codec: str = "zstd"

    def state(self) -> dict[str, Any]:
        """Plain data for the attribute."""
        plain = {attribute.name: getattr(self, attribute.name) for attribute in fields(self)}
        for name in ("clips", "files"):
            plain[name] = [asdict(entry) for entry in plain[name].values()]
        plain["arrays"] = {name: asdict(facts) for name, facts in self.arrays.items()}
        return {"format": FORMAT, **plain}


def step_of(tolerance: float, unit: str) -> float:
    """The step in a corpus's unit whose rounding, by half a step at most, keeps a tolerance in millimetres."""
    return 2 * MARGIN * tolerance / (1000.0 * metres_per_unit(unit)) if tolerance else 0.0


def chunk_frames(frame_rate: float, seconds: float) -> int:
    """Frames of a chunk of motion."""
    return max(1, round(frame_rate * seconds))


def is_plain_name(name: str) -> bool:
    """Whether a clip's or an identity's name can be the name of a file in any folder."""
    return bool(name) and not name.startswith(".") and not set(name) & set("/\\:")


def read_record(text: bytes, source: str) -> Record:
    """The record in a group's ``zarr.json``; every field is checked, since the file may be hostile."""
    name = f"{source}/{METADATA}"
    content = parse_json(text, name, remedy=REMEDY)
    attributes = content.get("attributes") if isinstance(content, dict) else None
    plain = attributes.get(RECORD) if isinstance(attributes, dict) else None
    _require(isinstance(plain, dict), name, "is no packed corpus; expected what `facediff data pack` writes")
    check_format(name, cast(dict[str, Any], plain).get("format"), FORMAT)
    try:
        return _record(cast(dict[str, Any], plain), name)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise FaceDiffError(f"{name}: its record is damaged ({quoted(error)}); {REMEDY}") from error


def _require(condition: object, source: str, fault: str) -> None:
    if not condition:
        raise FaceDiffError(f"{source}: {fault}; {REMEDY}")


def _fields(kind: type[Any], plain: Mapping[str, Any], source: str, **known: Any) -> Any:  # noqa: ANN401
    """An object with every field of the type that its dataclass declares: texts, numbers from 0, lists of them."""
    values = dict(known)
    for name, hint in get_type_hints(kind).items():
        value: Any = plain[name] if name not in known else None
        if name not in known and hint is str:
            _require(isinstance(value, str) and value.isprintable() and len(value) <= LONGEST, source, f"odd {name}")
        elif name not in known:
            # Whole numbers up to 2^53; what they mean is compared with the rest of the record below.
            numbers = list(value) if get_origin(hint) is tuple else [value]
            kinds = (int, float) if hint is float else int
            fit = all(isinstance(n, kinds) and not isinstance(n, bool) and 0 <= n <= 2**53 for n in numbers)
            _require(fit, source, f"{name} is {quoted(value)}; expected numbers from 0 on")
            value = tuple(numbers) if get_origin(hint) is tuple else value
        values.setdefault(name, value)
    return kind(**values)


def _record(plain: Mapping[str, Any], source: str) -> Record:
    lists = all(isinstance(plain[name], list) for name in ("clips", "files", "identities"))
    _require(lists, source, "clips, files and identities are lists")
    arrays: dict[str, ArrayFacts] = {}
    for name, entry in plain["arrays"].items():
        arrays[name] = _fields(ArrayFacts, entry, f"{source}: {quoted(name)}")
    clips: dict[str, PackedClip] = {}
    for entry in plain["clips"]:
        sound = _fields(PackedSound, entry["sound"], f"{source}: clip {quoted(entry['name'])}")
        clip: PackedClip = _fields(PackedClip, entry, source, sound=sound)
        _require(clip.name not in clips, source, f"has two clips {quoted(clip.name)}")
        clips[clip.name] = clip
    files: dict[str, PackedFile] = {}
    for entry in plain["files"]:
        file: PackedFile = _fields(PackedFile, entry, source)
        _require(file.path not in files, source, f"has two files {quoted(file.path)}")
        files[file.path] = file
    identities = tuple(str(name) for name in plain["identities"])
    parts = {"clips": dict(sorted(clips.items())), "files": files, "arrays": arrays, "identities": identities}
    record: Record = _fields(Record, {"codec": "zstd", **plain}, source, **parts)
    _require(record.n_vertices >= 1, source, f"n_vertices is {record.n_vertices}")
    _require(0.1 <= record.frame_rate <= 1000, source, f"frame_rate is {record.frame_rate}")
    _require(record.codec in CODECS, source, f"codec is {quoted(record.codec)}; expected one of {', '.join(CODECS)}")
    for name, facts in arrays.items():
        _check_array(name, facts, 3 * record.n_vertices, source)
    for clip in clips.values():
        _check_clip(clip, record, source)
    for file in files.values():
        where = f"{source}: its file {quoted(file.path)}"
        _require(_is_relative(file.path), where, "is no plain path below the folder")
        _require(file.first + file.bytes <= _rows(arrays, "files"), where, "lies beyond the array")
    _check_meaning(record, source)
    return record


def _check_meaning(record: Record, source: str) -> None:
    """Refuse a record whose declarations contradict each other: they determine what the stored numbers mean."""
    codings = {clip.coding for clip in record.clips.values()}
    try:
        step = step_of(record.tolerance, record.unit)
    except FaceDiffError as error:
        raise FaceDiffError(f"{source}: {error}; {REMEDY}") from error
    expected = f"{step:.6g}" if step else "a tolerance above 0, since motion is quantised"
    fault = f"step is {record.step:.6g} at a tolerance of {record.tolerance:g} mm; expected {expected}"
    fits = math.isclose(record.step, step, rel_tol=1e-6) and (step or not codings & set(QUANTISED))
    _require(fits, source, fault)
    frames = chunk_frames(record.frame_rate, record.chunk_seconds)
    for name in sorted({f"motion_{coding}" for coding in codings}):
        chunk = record.arrays[name].chunk
        _require(chunk == frames, source, f"{name} has chunks of {chunk} frames; expected {frames}")
    rows, names = _rows(record.arrays, "templates"), record.identities
    fault = f"identities has {len(names)} names; expected {rows} different ones"
    _require(rows == len(names) == len(set(names)) and all(map(is_plain_name, names)), source, fault)


def _rows(arrays: Mapping[str, ArrayFacts], name: str) -> int:
    return arrays[name].rows if name in arrays else 0


def _check_array(name: str, facts: ArrayFacts, coordinates: int, source: str) -> None:
    dtypes = {"templates": "float32", "speech": "uint8", "files": "uint8"}
    dtypes |= {f"motion_{coding}": dtype.name for coding, dtype in CODINGS.items()}
    _require(name in dtypes, source, f"has an array {quoted(name)}, which is none of a packed corpus")
    where, width = f"{source}: {name}", 0 if dtypes[name] == "uint8" else coordinates
    fits = (facts.dtype, facts.width) == (dtypes[name], width) and 1 <= facts.chunk <= 2**31
    _require(fits and 1 <= facts.chunks <= 2**20, where, f"is {facts.dtype} of width {facts.width}")
    count = math.ceil(facts.rows / (facts.chunk * facts.chunks))
    _require(len(facts.shards) == count, where, f"has {len(facts.shards)} shards, which do not hold {facts.rows} rows")


def _check_clip(clip: PackedClip, record: Record, source: str) -> None:
    where, sound = f"{source}: clip {quoted(clip.name)}", clip.sound
    _require(is_plain_name(clip.name), where, "has a name that is not plain")
    _require(clip.identity in record.identities, where, f"is of {quoted(clip.identity)}, who is none of identities")
    fits = clip.coding in CODINGS and clip.dtype in EXACT and (clip.coding not in EXACT or clip.dtype == clip.coding)
    _require(fits, where, f"was {quoted(clip.dtype)}, but is coded as {quoted(clip.coding)}")
    facts = record.arrays.get(f"motion_{clip.coding}")
    fits = facts is not None and not clip.first % facts.chunk and clip.first + clip.frames <= facts.rows
    _require(fits and clip.frames >= 1, where, "lies beyond its array")
    low, high = SAMPLE_RATES
    bits = {"flac": (16, 24), "wav": (0,)}.get(sound.form, ())
    fits = low <= sound.rate <= high and 1 <= sound.channels <= 64 and sound.samples >= 1 and sound.bits in bits
    _require(fits, where, f"has speech of form {quoted(sound.form)} with {sound.bits} bits at {sound.rate} Hz")
    count = math.ceil(sound.samples / (PIECE_SECONDS * sound.rate)) if sound.form == "flac" else 1
    fits = len(sound.pieces) == count and sound.first + sum(sound.pieces) <= _rows(record.arrays, "speech")
    _require(fits and all(sound.pieces), where, "has speech that lies beyond its array")


def _is_relative(path: str) -> bool:
    """Whether a path stays below the folder that it is unpacked into."""
    parts = PurePosixPath(path).parts
    odd = "\\" in path or ":" in path or not parts or path != "/".join(parts)
    return not odd and not PurePosixPath(path).is_absolute() and not any(part.startswith(".") for part in parts)


def check_array_metadata(text: bytes, name: str, facts: ArrayFacts) -> None:
    """Refuse an array that its own ``zarr.json`` describes otherwise than the record, or with other codecs.

    Only the codecs that ``facediff data pack`` writes are ever run; Zarr knows others, some of which run code.
    """
    content = parse_json(text, name, remedy=REMEDY)
    width = (facts.width,) if facts.width else ()
    try:
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
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FaceDiffError(f"{name}: describes no sharded array; {REMEDY}") from error
    expected = {
        "shape": [facts.rows, *width],
        "data_type": facts.dtype,
        "chunk_grid": [facts.chunk * facts.chunks, *width],
        "chunk_shape": [facts.chunk, *width],
        "index_location": "end",
        "codecs": ["sharding_indexed", "bytes", "blosc", "crc32c"],
        "index_codecs": ["bytes", "crc32c"],
    }
    for part, value in expected.items():
        _require(declared[part] == value, name, f"{part} is {quoted(declared[part])}; expected {quoted(value)}")
