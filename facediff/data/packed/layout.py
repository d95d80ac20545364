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
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import PurePosixPath
from typing import Any, Literal

import numpy as np

from facediff.data.manifest import LONGEST
from facediff.errors import FaceDiffError
from facediff.spaces.space import metres_per_unit
from facediff.utils.limits import LIMITS, SAMPLE_RATES, check_array, check_format, check_nesting, check_number, quoted
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
    """The record in a group's ``zarr.json``; every field is checked, since the file may be hostile.

    Raises:
        FaceDiffError: if it is no packed corpus, of a later format, or declares what cannot be.
    """
    name = f"{source}/{METADATA}"
    LIMITS.check("bytes", len(text), name)
    content = parse_json(text, name, remedy=REMEDY)
    check_nesting(content, name)
    attributes = content.get("attributes") if isinstance(content, dict) else None
    plain = attributes.get(RECORD) if isinstance(attributes, dict) else None
    if not isinstance(plain, dict) or content.get("node_type") != "group":
        raise FaceDiffError(f"{name}: is no packed corpus; expected what `facediff data pack` writes")
    check_format(name, plain.get("format"), FORMAT)
    try:
        return _record(plain, _Checks(name))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FaceDiffError(f"{name}: its record is damaged ({quoted(error)}); {REMEDY}") from error


class _Checks:
    """Reads fields of a record, and names the one that is wrong."""

    def __init__(self, source: str) -> None:
        self.source = source

    def whole(self, plain: Mapping[str, Any], name: str, low: int = 0, high: float = 2**53) -> int:
        """A whole number in a range."""
        return int(check_number(self.source, name, plain[name], low, high, whole=True, remedy=REMEDY))

    def number(self, plain: Mapping[str, Any], name: str, low: float, high: float) -> float:
        """A number in a range."""
        return check_number(self.source, name, plain[name], low, high, remedy=REMEDY)

    def text(self, plain: Mapping[str, Any], name: str, allowed: Sequence[str] = ()) -> str:
        """A short text that can be printed, one of the known ones if there are any."""
        text = plain[name]
        fits = isinstance(text, str) and text.isprintable() and len(text) <= LONGEST
        if not fits or (allowed and text not in allowed):
            expected = f"one of {', '.join(allowed)}" if allowed else "a short text"
            raise FaceDiffError(f"{self.source}: {name} is {quoted(text)}; expected {expected}; {REMEDY}")
        return str(text)

    def name(self, plain: Mapping[str, Any], name: str) -> str:
        """A text that can be the name of a file."""
        text = self.text(plain, name)
        if not is_plain_name(text):
            raise self.refuse(f"{name} is {quoted(text)}; expected a plain name, without / \\ : and no leading dot")
        return text

    def items(self, plain: Mapping[str, Any], name: str) -> list[Any]:
        """A list."""
        entries = plain[name]
        if not isinstance(entries, list):
            raise FaceDiffError(f"{self.source}: {name} is {quoted(entries)}; expected a list; {REMEDY}")
        return entries

    def refuse(self, what: str) -> FaceDiffError:
        """The error of a record that contradicts itself."""
        return FaceDiffError(f"{self.source}: {what}; {REMEDY}")


def _record(plain: dict[str, Any], checks: _Checks) -> Record:
    n_vertices = checks.whole(plain, "n_vertices", 1, LIMITS.vertices)
    arrays = {}
    if not isinstance(plain["arrays"], dict):
        raise checks.refuse("arrays is no object")
    for name, facts in plain["arrays"].items():
        arrays[name] = _array(name, facts, checks, 3 * n_vertices)
    clips = {}
    for entry in checks.items(plain, "clips"):
        clip = _clip(entry, checks, arrays)
        if clip.name in clips:
            raise checks.refuse(f"has two clips {quoted(clip.name)}")
        clips[clip.name] = clip
    files = {}
    for entry in checks.items(plain, "files"):
        file = PackedFile(
            _relative(checks.text(entry, "path"), checks),
            checks.whole(entry, "first"),
            checks.whole(entry, "bytes"),
            checks.text(entry, "sha256"),
        )
        if file.path in files or file.first + file.bytes > _rows(arrays, "files"):
            raise checks.refuse(f"its file {quoted(file.path)} lies beyond the array, or is there twice")
        files[file.path] = file
    LIMITS.check("bytes", sum(file.bytes for file in files.values()), checks.source)
    identities = checks.items(plain, "identities")
    LIMITS.check("identities", len(identities), checks.source)
    record = Record(
        made_by=checks.text(plain, "made_by"),
        corpus=checks.text(plain, "corpus"),
        n_vertices=n_vertices,
        frame_rate=checks.number(plain, "frame_rate", 0.1, 1000.0),
        tolerance=checks.number(plain, "tolerance", 0, 1e6),
        step=checks.number(plain, "step", 0, 1e6),
        unit=checks.text(plain, "unit"),
        chunk_seconds=checks.number(plain, "chunk_seconds", 0, 1e6),
        identities=tuple(checks.name({"identity": name}, "identity") for name in identities),
        clips=dict(sorted(clips.items())),
        files=files,
        arrays=arrays,
        codec=checks.text({"codec": "zstd", **plain}, "codec", list(CODECS)),
    )
    _check_agreement(record, checks)
    return record


def _check_agreement(record: Record, checks: _Checks) -> None:
    """Refuse a record whose declarations contradict each other: they determine what the stored numbers mean."""
    codings = {clip.coding for clip in record.clips.values()}
    if record.tolerance:
        try:
            step = step_of(record.tolerance, record.unit)
        except FaceDiffError as error:
            raise checks.refuse(str(error)) from error
    else:
        step = 0.0
    if not math.isclose(record.step, step, rel_tol=1e-6) or (not step and codings & set(QUANTISED)):
        expected = f"{step:.6g}" if step else "a tolerance above 0, since motion is quantised"
        what = f"step is {record.step:.6g} at a tolerance of {record.tolerance:g} mm; expected {expected}"
        raise checks.refuse(what)
    frames = chunk_frames(record.frame_rate, record.chunk_seconds)
    for name in sorted({f"motion_{coding}" for coding in codings}):
        if record.arrays[name].chunk != frames:
            raise checks.refuse(f"{name} has chunks of {record.arrays[name].chunk} frames; expected {frames}")
    rows = _rows(record.arrays, "templates")
    if rows != len(record.identities) or len(set(record.identities)) != rows:
        raise checks.refuse(f"identities has {len(record.identities)} names; expected {rows} different ones")
    for clip in record.clips.values():
        if clip.identity not in record.identities:
            raise checks.refuse(f"clip {clip.name} is of {clip.identity}, who is none of identities")


def _rows(arrays: Mapping[str, ArrayFacts], name: str) -> int:
    return arrays[name].rows if name in arrays else 0


def _array(name: str, plain: Mapping[str, Any], checks: _Checks, coordinates: int) -> ArrayFacts:
    coding = name.removeprefix("motion_")
    dtypes = {"templates": "float32", "speech": "uint8", "files": "uint8"}
    dtype = CODINGS[coding].name if name != coding and coding in CODINGS else dtypes.get(name)
    if dtype is None:
        raise checks.refuse(f"has an array {quoted(name)}, which is none of a packed corpus")
    width = 0 if dtype == "uint8" else coordinates
    facts = ArrayFacts(
        dtype=checks.text(plain, "dtype", [dtype]),
        rows=checks.whole(plain, "rows"),
        width=checks.whole(plain, "width", width, width),
        chunk=checks.whole(plain, "chunk", 1, 2**31),
        chunks=checks.whole(plain, "chunks", 1, 2**20),
        shards=tuple(
            checks.whole({"bytes of a shard": size}, "bytes of a shard", 4) for size in checks.items(plain, "shards")
        ),
    )
    # This bounds the memory that a hostile record can demand: decoding refuses a chunk of any other size.
    check_array(f"{checks.source}: {name}", (facts.chunk, max(1, width)), np.dtype(dtype).itemsize)
    if len(facts.shards) != math.ceil(facts.rows / (facts.chunk * facts.chunks)):
        raise checks.refuse(f"{name} has {len(facts.shards)} shards, which do not hold {facts.rows} rows")
    return facts


def _clip(plain: Mapping[str, Any], checks: _Checks, arrays: Mapping[str, ArrayFacts]) -> PackedClip:
    sound = plain["sound"]
    pieces = checks.items(sound, "pieces")
    samples = checks.whole(sound, "samples", 1)
    packed_sound = PackedSound(
        first=checks.whole(sound, "first"),
        pieces=tuple(checks.whole({"piece": size}, "piece", 1) for size in pieces),
        form=checks.text(sound, "form", ["flac", "wav"]),
        rate=checks.whole(sound, "rate", *SAMPLE_RATES),
        channels=checks.whole(sound, "channels", 1, 64),
        samples=samples,
        bits=checks.whole(sound, "bits", 0, 24),
    )
    clip = PackedClip(
        name=checks.name(plain, "name"),
        identity=checks.name(plain, "identity"),
        coding=checks.text(plain, "coding", list(CODINGS)),
        dtype=checks.text(plain, "dtype", list(EXACT)),
        first=checks.whole(plain, "first"),
        frames=checks.whole(plain, "frames", 1, LIMITS.frames),
        sound=packed_sound,
    )
    if clip.coding in EXACT and clip.dtype != clip.coding:
        raise checks.refuse(f"clip {clip.name} was {clip.dtype}, but is coded as {clip.coding}")
    facts = arrays.get(f"motion_{clip.coding}")
    if facts is None or clip.first % facts.chunk or clip.first + clip.frames > facts.rows:
        raise checks.refuse(f"clip {clip.name} lies beyond its array")
    LIMITS.check("seconds", samples / packed_sound.rate, f"{checks.source}: clip {clip.name}")
    if packed_sound.bits not in ((16, 24) if packed_sound.form == "flac" else (0,)):
        raise checks.refuse(f"the speech of clip {clip.name} has {packed_sound.bits} bits")
    count = math.ceil(samples / (PIECE_SECONDS * packed_sound.rate)) if packed_sound.form == "flac" else 1
    if len(packed_sound.pieces) != count or packed_sound.first + sum(packed_sound.pieces) > _rows(arrays, "speech"):
        raise checks.refuse(f"the speech of clip {clip.name} lies beyond its array")
    return clip


def _relative(path: str, checks: _Checks) -> str:
    """A path that stays below the folder that it is unpacked into."""
    parts = PurePosixPath(path).parts
    odd = "\\" in path or ":" in path or not parts or path != "/".join(parts)
    if odd or PurePosixPath(path).is_absolute() or any(part.startswith(".") for part in parts):
        raise checks.refuse(f"has a file {quoted(path)}; expected a plain path below the folder")
    return path


def check_array_metadata(text: bytes, name: str, facts: ArrayFacts) -> None:
    """Refuse an array that its own ``zarr.json`` describes otherwise than the record, or with other codecs.

    Only the codecs that ``facediff data pack`` writes are ever run; Zarr knows others, some of which run code.
    """
    content = parse_json(text, name, remedy=REMEDY)
    width = (facts.width,) if facts.width else ()
    grid, shape = [facts.chunk * facts.chunks, *width], [facts.rows, *width]
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
        "shape": shape,
        "data_type": facts.dtype,
        "chunk_grid": grid,
        "chunk_shape": [facts.chunk, *width],
        "index_location": "end",
        "codecs": ["sharding_indexed", "bytes", "blosc", "crc32c"],
        "index_codecs": ["bytes", "crc32c"],
    }
    for field_name, value in expected.items():
        if declared[field_name] != value:
            raise FaceDiffError(
                f"{name}: {field_name} is {quoted(declared[field_name])}; expected {quoted(value)}; {REMEDY}"
            )
