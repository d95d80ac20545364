"""Packing a corpus folder: the plan, the tasks, and how an interrupted run is continued."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from facediff.data.corpus import read_templates
from facediff.data.manifest import read_manifest
from facediff.data.packed.layout import (
    BLOB_CHUNK,
    BLOB_SHARD,
    CODECS,
    CODINGS,
    EXACT,
    METADATA,
    PIECE_SECONDS,
    QUANTISED,
    RECORD,
    ROOM,
    SHARD_BYTES,
    STATE,
    ArrayFacts,
    PackedClip,
    PackedFile,
    PackedSound,
    Record,
    chunk_frames,
    is_plain_name,
    read_record,
    step_of,
)
from facediff.data.packed.shards import shard_key
from facediff.data.packed.stores import is_packed
from facediff.data.prepare.runner import version
from facediff.data.storage import MOTION_FOLDERS, WEIGHTS_FOLDER, motion_path, open_motion, refuse_out_of_range
from facediff.errors import FaceDiffError, needs_extra
from facediff.spaces.space import metres_per_unit
from facediff.speech.audio import open_sound, refuse_cut_short
from facediff.utils.batch import begin_folder, do_all
from facediff.utils.files import atomic, check_writable, locked
from facediff.utils.limits import quoted
from facediff.utils.plain_files import parse_json

if TYPE_CHECKING:
    from facediff.data.check.layouts import CorpusView

Codec = Literal["zstd", "lz4"]
"""How motion is compressed; see :data:`~facediff.data.packed.layout.CODECS`."""
Exact = Literal["test", "none"]
"""Clips that are stored without loss: those that scores are computed from, or none."""

LOCK = ".pack.lock"
PARTS = "parts"
"""Folder in the store with the encoded speech of single clips, while packing runs."""
FINEST = 0.001
"""Smallest tolerance in millimetres: single precision rounds the vertices of a face by some hundred-thousandths."""
BITS = {"PCM_16": 16, "PCM_24": 24, "PCM_S8": 16, "PCM_U8": 16}
"""Bits of FLAC samples that hold a recording's samples exactly, by its form."""
FLAC_CHANNELS, FLAC_RATE = 8, 655_350
BLOCK = 1 << 20
"""Bytes that are compressed together."""
FRAMES = 8  # that are quantised at a time, so that they stay in the processor's cache
REMEDY = "run `facediff data check` on the folder, and correct or remove the clip"


@dataclass(frozen=True)
class PackingReport:
    """The outcome of packing.

    Attributes:
        out: the packed corpus.
        clips: number of clips.
        seconds: of motion.
        before: bytes of the folder's motion and speech.
        after: bytes of the packed corpus.
        written: shards written by this run.
        left_out: files that belong to no clip: motion without speech, or speech without motion.
    """

    out: Path
    clips: int
    seconds: float
    before: int
    after: int
    written: int
    left_out: tuple[str, ...]

    @property
    def gb_an_hour(self) -> float:
        """Gigabytes of the packed corpus for an hour of motion."""
        return self.after / 1e9 / max(self.seconds / 3600, 1e-9)


@dataclass(frozen=True)
class ShardPart:
    """Frames of a clip that lie in a shard.

    Attributes:
        path: the clip's motion.
        identity: whose template is subtracted.
        row: the first row in the shard.
        start: the first frame.
        stop: the frame after the last one.
    """

    path: Path
    identity: str
    row: int
    start: int
    stop: int


@dataclass(frozen=True)
class PackingTask:
    """One file to write: a shard of motion, or the encoded speech of a clip.

    Attributes:
        target: path below the store.
        coding: of the motion; empty for speech.
        parts: of the shard.
        sound: the recording.
    """

    target: str
    coding: str = ""
    parts: tuple[ShardPart, ...] = ()
    sound: Path | None = None

    def __str__(self) -> str:
        return self.target


def pack(
    root: Path,
    out: Path,
    *,
    corpus: str | None = None,
    tolerance: float = 0.01,
    lossless: bool = False,
    exact: Exact = "test",
    unit: str | None = None,
    chunk_seconds: float = 0.5,
    codec: Codec = "zstd",
    workers: int | None = None,
    scheduler: str | None = "",
    quiet: bool = True,
) -> PackingReport:
    """Pack a corpus folder.

    A run that was killed is resumed: shards that are there are kept. The record that makes a Zarr group of the folder
    appears last.

    Args:
        root: the corpus folder.
        out: the packed corpus; a new folder whose name ends in ``.zarr``, or one that this function has begun.
        corpus: name or import path of the corpus; found out if None.
        tolerance: millimetres by which a coordinate may differ, at most.
        lossless: keep every bit of the motion.
        exact: which clips keep every bit all the same: ``test`` for those of the test splits and the style references
            of each, so that scores do not change; or ``none``.
        unit: the corpus's unit of length; that of its manifest or its data module if None.
        chunk_seconds: length of the pieces in which motion is read.
        codec: of the motion: ``zstd``, or ``lz4``, which is larger and read faster.
        workers: processes; as many as there are processors if None.
        scheduler: where tasks run; see :func:`~facediff.utils.jobs.run_tasks`.
        quiet: no progress bar.
    """
    if not lossless and tolerance < FINEST:
        raise FaceDiffError(
            f"--tolerance {tolerance:g}: is finer than single precision allows; expected {FINEST:g} mm or more, or "
            f"--lossless"
        )
    if is_packed(root):
        raise FaceDiffError(f"{root}: is packed already; expected a corpus folder with wav/ and vertices_npy/")
    if out.resolve().is_relative_to(root.resolve()):
        raise FaceDiffError(f"{out}: lies in the corpus folder {root}; choose a folder outside it")
    with needs_extra("zarr", "packed", "packing a corpus"):
        import zarr  # noqa: F401
    plan = PackingPlan.of(root, corpus, 0.0 if lossless else tolerance, unit, chunk_seconds, exact, codec)
    check_writable(out / STATE)
    with locked(out / LOCK, "facediff data pack"):
        return _carry_out(plan, out, workers, scheduler, quiet)


@dataclass(frozen=True)
class PackingPlan:
    """The contents of a packed corpus, from the headers of all files.

    Attributes:
        root: the corpus folder.
        record: without the shards' sizes, the speech and the files.
        files: other files of the folder, by path below it.
        left_out: files of motion or speech that no clip has.
        sources: size and time of every file that is packed; a resumed run must find the same.
        bytes: of motion and speech.
    """

    root: Path
    record: Record
    files: tuple[str, ...]
    left_out: tuple[str, ...]
    sources: str
    bytes: int

    @classmethod
    def of(
        cls,
        root: Path,
        corpus: str | None,
        tolerance: float,
        unit: str | None,
        chunk_seconds: float,
        exact: Exact,
        codec: Codec,
    ) -> PackingPlan:
        """Scan a corpus folder."""
        from facediff.data.check.layouts import view_of

        view = view_of(root, corpus)
        manifest = read_manifest(root)
        named = unit or str(manifest.get("unit") or view.unit)
        try:
            millimetres = 1000.0 * metres_per_unit(named)
        except FaceDiffError as error:
            if tolerance:
                raise FaceDiffError(f"{root}: {error}; give it with --unit, or pack with --lossless") from error
            millimetres = 1.0
        rate = float(manifest.get("frame_rate") or view.stored_frame_rate)
        chunk = chunk_frames(rate, chunk_seconds)
        step = step_of(tolerance, named)
        coding = "int16" if step * millimetres * np.iinfo(np.int16).max >= ROOM else "int32"
        templates = read_templates(root / "templates.pkl", view.n_vertices)
        if odd := [name for name in templates if not is_plain_name(name)]:
            raise FaceDiffError(
                f"{root / 'templates.pkl'}: has an identity {quoted(odd[0])}; expected plain names, without / \\ : and "
                f"no leading dot"
            )
        clips, arrays, left_out, size, seen = {}, {}, [], 0, hashlib.sha256()
        rows = dict.fromkeys(CODINGS, 0)
        kept = scored_clips(root, view) if tolerance and exact == "test" else frozenset()
        sounds = {path.stem: path for path in sorted((root / "wav").glob("*.wav"))}
        motions = {
            path.stem: path
            for folder in (WEIGHTS_FOLDER, *reversed(MOTION_FOLDERS))
            for path in sorted((root / folder).glob("*.npy"))
            if not path.name.startswith(".")
        }
        for name in sorted({*sounds, *motions}):
            clip = view.parse(name) if name in sounds and name in motions else None
            if clip is None:
                left_out += [str(paths[name].relative_to(root)) for paths in (sounds, motions) if name in paths]
                continue
            path = motion_path(root, name)
            motion = open_motion(path, view.n_vertices)
            if motion.dtype.name not in EXACT:
                raise FaceDiffError(f"{path}: holds {motion.dtype}; expected {', '.join(EXACT)}")
            if clip.identity not in templates:
                raise FaceDiffError(
                    f"{root / 'templates.pkl'}: no template for {clip.identity}, needed by clip {name}; {REMEDY}"
                )
            own = coding if tolerance and name not in kept else motion.dtype.name
            nothing = PackedSound(0, (), "flac", 16_000, 1, 1, 16)
            clips[name] = PackedClip(name, clip.identity, own, motion.dtype.name, rows[own], motion.frames, nothing)
            # Each clip begins at a chunk of its own, so that reading a window decodes no other clip.
            rows[own] += -(-motion.frames // chunk) * chunk
            for file in (path, sounds[name]):
                facts = file.stat()
                size += facts.st_size
                seen.update(f"{file.name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
        if not clips:
            raise FaceDiffError(f"{root}: no clip with both wav/<clip>.wav and vertices_npy/<clip>.npy; {REMEDY}")
        width = 3 * view.n_vertices
        for own in sorted({clip.coding for clip in clips.values()}):
            dtype = CODINGS[own]
            chunks = max(1, SHARD_BYTES // (chunk * width * dtype.itemsize))
            arrays[f"motion_{own}"] = ArrayFacts(
                dtype.name, rows[own], width, chunk, min(chunks, rows[own] // chunk), ()
            )
        record = Record(
            made_by=version(),
            corpus=view.corpus,
            n_vertices=view.n_vertices,
            frame_rate=rate,
            tolerance=tolerance,
            step=step,
            unit=named,
            chunk_seconds=chunk_seconds,
            identities=tuple(sorted(templates)),
            clips=clips,
            arrays=arrays,
            codec=codec,
        )
        return cls(root, record, _other_files(root), tuple(left_out), seen.hexdigest(), size)

    @property
    def recipe(self) -> dict[str, Any]:
        """All that determines the output; a run may be resumed only with the same."""
        record = self.record
        return {
            **{name: getattr(record, name) for name in ("made_by", "corpus", "n_vertices", "frame_rate")},
            **{name: getattr(record, name) for name in ("tolerance", "unit", "chunk_seconds", "codec")},
            "clips": {name: [clip.coding, clip.frames] for name, clip in record.clips.items()},
        }

    def tasks(self) -> Iterator[PackingTask]:
        """A task for every shard of motion, and for every clip's speech."""
        for name, facts in self.record.arrays.items():
            shard_rows = facts.chunk * facts.chunks
            parts: dict[int, list[ShardPart]] = {}
            for clip in self.record.clips.values():
                if name != f"motion_{clip.coding}":
                    continue
                path = motion_path(self.root, clip.name)
                for shard in range(clip.first // shard_rows, -(-(clip.first + clip.frames) // shard_rows)):
                    low, high = (
                        max(clip.first, shard * shard_rows),
                        min(clip.first + clip.frames, (shard + 1) * shard_rows),
                    )
                    part = ShardPart(path, clip.identity, low - shard * shard_rows, low - clip.first, high - clip.first)
                    parts.setdefault(shard, []).append(part)
            for shard in range(-(-facts.rows // shard_rows)):
                yield PackingTask(
                    f"{name}/{shard_key(shard, facts.width)}",
                    name.removeprefix("motion_"),
                    tuple(parts.get(shard, ())),
                )
        for clip in self.record.clips.values():
            yield PackingTask(f"{PARTS}/{clip.name}", sound=self.root / "wav" / f"{clip.name}.wav")


def scored_clips(root: Path, view: CorpusView) -> frozenset[str]:
    """Clips that scores are computed from: the test splits and the style references of their clips."""
    from facediff.data.check.layouts import by_name, instance

    scored: set[str] = set()
    if view.data_module is None:  # a person's folder, which is read next to a corpus and never packed with one
        return frozenset()
    for way in view.split_of:
        data = instance(by_name(view.data_module, view.n_vertices), root, way)
        policy = data.reference_policy()
        for clip in (clip for split in data.test_splits for clip in data.clips(split)):
            scored.add(clip.name)
            with suppress(FaceDiffError):  # without a reference it cannot be scored
                scored.add(policy.evaluated(clip).name)
    return frozenset(scored)


def _other_files(root: Path) -> tuple[str, ...]:
    """Every file of a corpus folder but motion, speech and hidden ones, by path below it."""
    paths = []
    for path in sorted(root.rglob("*")):
        place = path.relative_to(root)
        if place.parts[0] in (*MOTION_FOLDERS, "wav") or any(part.startswith(".") for part in place.parts):
            continue
        if path.is_file():
            paths.append(place.as_posix())
    return tuple(paths)


def _carry_out(plan: PackingPlan, out: Path, workers: int | None, scheduler: str | None, quiet: bool) -> PackingReport:
    if (out / METADATA).is_file():
        return _finished(plan, out)
    begin_folder(out, STATE, {**plan.recipe, "state of the corpus": plan.sources}, "facediff data pack")
    # Every task writes one file, which appears whole or not at all: a file that exists is finished.
    tasks = [task for task in plan.tasks() if not (out / task.target).is_file()]
    work = partial(_write, out, plan.root, plan.record)
    places = {"workers": workers, "scheduler": scheduler, "writes": out, "reads": [plan.root]}
    do_all(work, tasks, **places, progress="" if quiet else "packing")
    record = _finish(plan, out)
    return _report(plan, record, out, sum(bool(task.coding) for task in tasks))


def _finished(plan: PackingPlan, out: Path) -> PackingReport:
    record = read_record((out / METADATA).read_bytes(), str(out))
    if replace(plan, record=record).recipe != plan.recipe:
        raise FaceDiffError(f"{out}: holds a corpus that was packed otherwise; choose a new folder, or remove this one")
    for name, facts in record.arrays.items():
        _check_written(out / name, facts, record)
    _clear(out)
    return _report(plan, record, out, 0)


def _check_written(folder: Path, facts: ArrayFacts, record: Record) -> None:
    """Refuse an array with files of other sizes than were written; `data check` reads every byte."""
    sizes = {folder / shard_key(number, facts.width): size for number, size in enumerate(facts.shards)}
    sizes[folder / METADATA] = len(encoded(facts, None, _codec_of(folder.name, record)))
    for path, size in sizes.items():
        actual = path.stat().st_size if path.is_file() else 0
        if actual != size:
            raise FaceDiffError(
                f"{path}: has {actual} bytes instead of {size}; remove the packed corpus, and pack it again"
            )


def _report(plan: PackingPlan, record: Record, out: Path, written: int) -> PackingReport:
    seconds = sum(clip.frames for clip in record.clips.values()) / record.frame_rate
    after = sum(size for facts in record.arrays.values() for size in facts.shards)
    return PackingReport(out, len(record.clips), seconds, plan.bytes, after, written, plan.left_out)


def _finish(plan: PackingPlan, out: Path) -> Record:
    """Join the encoded speech, add files and templates, and write the record last."""
    # Speech is encoded in parallel to one file a clip; its place in the common array is known only now.
    clips, place = {}, 0
    for name, clip in plan.record.clips.items():
        with (out / PARTS / name).open("rb") as stream:
            sound = PackedSound(**{**parse_json(stream.readline(), out / STATE), "first": place})
        clips[name] = replace(clip, sound=replace(sound, pieces=tuple(sound.pieces)))
        place += sum(sound.pieces)
    speech = ((out / PARTS / name).read_bytes().partition(b"\n")[2] for name in clips)
    files, read = {}, 0
    for path in plan.files:
        content = (plan.root / path).read_bytes()
        files[path] = PackedFile(path, read, len(content), hashlib.sha256(content).hexdigest())
        read += len(content)
    templates = read_templates(plan.root / "templates.pkl", plan.record.n_vertices)
    faces = np.stack([templates[name].numpy().ravel() for name in plan.record.identities])
    arrays = dict(plan.record.arrays)
    arrays["templates"] = ArrayFacts("float32", len(faces), faces.shape[1], 1, len(faces), ())
    with atomic(out / "templates" / shard_key(0, faces.shape[1])) as temporary:
        temporary.write_bytes(encoded(arrays["templates"], faces))
    arrays["speech"] = write_blob(out, "speech", place, speech)
    arrays["files"] = write_blob(out, "files", read, ((plan.root / path).read_bytes() for path in plan.files))
    for name, facts in arrays.items():
        with atomic(out / name / METADATA) as temporary:
            temporary.write_bytes(encoded(facts, None, _codec_of(name, plan.record)))
        count = -(-facts.rows // (facts.chunk * facts.chunks))
        sizes = tuple((out / name / shard_key(shard, facts.width)).stat().st_size for shard in range(count))
        arrays[name] = replace(facts, shards=sizes)
    record = replace(plan.record, clips=clips, files=files, arrays=arrays)
    with atomic(out / METADATA) as temporary:
        temporary.write_bytes(group_metadata(record))
    _clear(out)
    return record


def _clear(out: Path) -> None:
    """Remove what only an unfinished packed corpus needs."""
    for path in sorted((out / PARTS).glob("*")):
        path.unlink()
    if (out / PARTS).is_dir():
        (out / PARTS).rmdir()
    (out / STATE).unlink(missing_ok=True)


# Tasks: run in worker processes, each writes one file.


def _write(out: Path, root: Path, record: Record, task: PackingTask) -> None:
    if task.sound is not None:
        content = encode_speech(task.sound)
    else:
        facts = record.arrays[f"motion_{task.coding}"]
        rows = np.zeros((facts.chunk * facts.chunks, facts.width), CODINGS[task.coding])
        templates = read_templates(root / "templates.pkl", record.n_vertices)
        for part in task.parts:
            read = _quantised if task.coding in QUANTISED else _exact
            stored = open_motion(part.path, record.n_vertices).read(range(part.start, part.stop))
            rows[part.row : part.row + part.stop - part.start] = read(
                part, stored, templates[part.identity].numpy(), record, rows.dtype
            )
            last = part.row + part.stop - part.start
            padded = -(-last // facts.chunk) * facts.chunk
            # The end of a clip's last chunk repeats its last frame: the differences below are zero there.
            rows[last:padded] = rows[last - 1]
        for first in range(0, len(rows), facts.chunk):
            chunk = rows[first : first + facts.chunk]
            # Differences between frames are small and compress well; each chunk starts with a whole row, so that it can
            # be decoded alone.
            chunk[1:] = chunk[1:] - chunk[:-1]
        content = encoded(facts, rows, record.codec)
    with atomic(out / task.target) as temporary:
        temporary.write_bytes(content)


def _quantised(
    part: ShardPart,
    stored: npt.NDArray[np.floating],
    template: npt.NDArray[np.float32],
    record: Record,
    dtype: np.dtype[Any],
) -> npt.NDArray[Any]:
    """Offsets from the template in whole quantisation steps (frames, 3V)."""
    steps = np.empty((len(stored), stored.shape[1] * 3), dtype)
    limit = np.iinfo(dtype).max
    for first in range(0, len(stored), FRAMES):
        piece = np.array(stored[first : first + FRAMES], np.float64)
        with np.errstate(all="ignore"):
            refuse_out_of_range(piece.astype(np.float32), range(part.start + first, part.stop), part.path)
        piece -= template
        piece /= record.step
        np.rint(piece, out=piece)
        most = float(np.abs(piece).max(initial=0.0))
        if most > limit:
            raise FaceDiffError(
                f"{part.path}: a coordinate lies {most * record.step:.4g} {record.unit.split(' ')[0]} away from the "
                f"template of {part.identity}, more than can be packed at this tolerance; {REMEDY}, or pack with "
                f"--lossless"
            )
        steps[first : first + FRAMES] = piece.reshape(len(piece), -1)
    return steps


def _exact(
    part: ShardPart,
    stored: npt.NDArray[np.floating],
    template: npt.NDArray[np.float32],
    record: Record,
    dtype: np.dtype[Any],
) -> npt.NDArray[Any]:
    """The bits of absolute vertices as whole numbers (frames, 3V)."""
    stored = np.ascontiguousarray(stored, stored.dtype.newbyteorder("<"))
    with np.errstate(all="ignore"):
        refuse_out_of_range(stored.astype(np.float32), range(part.start, part.stop), part.path)
    return stored.reshape(len(stored), -1).view(dtype)


def encode_speech(path: Path) -> bytes:
    """A line of JSON, then the recording as FLAC streams; as the file itself where FLAC would lose something."""
    import soundfile

    with open_sound(path) as file:
        refuse_cut_short(path)
        rate, channels, samples = int(file.samplerate), int(file.channels), int(file.frames)
        if not samples:
            raise FaceDiffError(f"{path}: holds no samples; {REMEDY}")
        bits = BITS.get(file.subtype, 0)
        pieces, form = [], "flac"
        if not bits or channels > FLAC_CHANNELS or rate > FLAC_RATE:
            bits, form = 0, "wav"
            pieces.append(path.read_bytes())
        for first in range(0, samples if bits else 0, PIECE_SECONDS * rate):
            length = min(PIECE_SECONDS * rate, samples - first)
            block = file.read(length, dtype="int32", always_2d=True)
            if len(block) != length:
                raise FaceDiffError(f"{path}: is cut short: {first + len(block)} of {samples} samples; copy it again")
            stream = io.BytesIO()
            soundfile.write(stream, block, rate, format="FLAC", subtype=f"PCM_{bits}")
            pieces.append(stream.getvalue())
    sound = PackedSound(0, tuple(map(len, pieces)), form, rate, channels, samples, bits)
    return json.dumps(asdict(sound), allow_nan=False).encode() + b"\n" + b"".join(pieces)


# Zarr's files, made by the zarr package.


def write_blob(out: Path, name: str, size: int, contents: Iterable[bytes]) -> ArrayFacts:
    """Write an array of bytes; no more than a shard is in memory.

    Args:
        out: the packed corpus.
        name: the array's name.
        size: of all parts together.
        contents: its parts, in order.
    """
    chunks = max(1, min(BLOB_SHARD, size + BLOB_CHUNK - 1) // BLOB_CHUNK)
    facts = ArrayFacts("uint8", size, 0, BLOB_CHUNK, chunks, ())
    shard_bytes, waiting, shard = BLOB_CHUNK * chunks, bytearray(), 0
    for content in chain(contents, [b""]):
        waiting += content
        while len(waiting) >= shard_bytes or (not content and waiting):
            with atomic(out / name / shard_key(shard, 0)) as temporary:
                temporary.write_bytes(encoded(facts, np.frombuffer(bytes(waiting[:shard_bytes]), np.uint8)))
            del waiting[:shard_bytes]
            shard += 1
    return facts


def _codec_of(array: str, record: Record) -> str:
    return record.codec if array.startswith("motion_") else "zstd"


def encoded(facts: ArrayFacts, rows: npt.NDArray[Any] | None, codec: str = "zstd") -> bytes:
    """A shard as Zarr writes it, with zeros after ``rows``; the array's ``zarr.json`` if ``rows`` is None."""
    import zarr
    from zarr.codecs import BloscCodec, Crc32cCodec
    from zarr.storage import MemoryStore

    shard_rows = facts.chunk * facts.chunks
    width = (facts.width,) if facts.width else ()
    files: dict[str, Any] = {}
    itemsize = np.dtype(facts.dtype).itemsize
    compressor, level = CODECS[codec]
    array: Any = zarr.create_array(
        store=MemoryStore(files),
        shape=(facts.rows if rows is None else shard_rows, *width),
        shards=(shard_rows, *width),
        chunks=(facts.chunk, *width),
        dtype=facts.dtype,
        compressors=[
            # The upper bits of differences are alike and the lowest are noise. After a bit shuffle, zstd sees either
            # one repeated byte or noise that it stores, and decodes in a fraction of the time that a byte shuffle
            # takes. Smaller blocks take more room; level 5 takes 5 % less room than level 1 and decodes as quickly.
            BloscCodec(
                typesize=itemsize,
                cname=compressor,
                clevel=level,
                shuffle="bitshuffle",
                blocksize=min(facts.chunk_bytes, BLOCK),
            ),
            Crc32cCodec(),
        ],
        fill_value=0,
        config={"write_empty_chunks": True},
    )
    if rows is None:
        return bytes(files[METADATA].to_bytes())
    whole = np.zeros((shard_rows, *width), facts.dtype)
    whole[: len(rows)] = rows
    array[...] = whole
    return bytes(files[shard_key(0, facts.width)].to_bytes())


def group_metadata(record: Record) -> bytes:
    """The group's ``zarr.json``."""
    import zarr
    from zarr.storage import MemoryStore

    files: dict[str, Any] = {}
    zarr.create_group(store=MemoryStore(files), attributes={RECORD: record.state()})
    return bytes(files[METADATA].to_bytes())
