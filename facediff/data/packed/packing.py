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
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import numpy as np
import numpy.typing as npt

from facediff.data.corpus import read_templates
from facediff.data.manifest import read_manifest
from facediff.data.packed.layout import (
    BLOB_CHUNK,
    BLOB_SHARD,
    CHUNK_SECONDS,
    CODINGS,
    METADATA,
    PIECE_SECONDS,
    PLAIN_NAME,
    QUANTISED,
    RECORD,
    ROOM,
    SHARD_BYTES,
    STATE,
    ArrayInfo,
    Coding,
    ExactCoding,
    PackedClip,
    PackedFile,
    PackedSound,
    Record,
    chunk_frames,
    step_of,
)
from facediff.data.packed.shards import shard_key
from facediff.data.preparation import version
from facediff.data.storage import MOTION_FOLDERS, WEIGHTS_FOLDER, motion_path, open_motion, refuse_out_of_range
from facediff.errors import FaceDiffError, needs_extra
from facediff.spaces.space import metres_per_unit
from facediff.speech.audio import open_sound, refuse_cut_short
from facediff.utils.batch import begin_folder, do_all
from facediff.utils.checksums import file_stamps, hash_of
from facediff.utils.files import atomic, check_writable, locked
from facediff.utils.limits import quoted
from facediff.utils.paths import name_of_file
from facediff.utils.plain_files import parse_json
from facediff.utils.ranges import Range, checked

if TYPE_CHECKING:
    from facediff.data.check.layouts import CorpusView

Exact = Literal["test", "none"]
"""Clips that are stored without loss: those that scores are computed from, or none."""

LOCK = ".pack.lock"
PARTS = "parts"
"""Folder in the store with the encoded speech of single clips, while packing runs."""
FINEST = 0.001
"""Smallest tolerance in millimetres: single precision rounds the vertices of a face by some hundred-thousandths."""
BITS: dict[str, Literal[16, 24]] = {"PCM_16": 16, "PCM_24": 24, "PCM_S8": 16, "PCM_U8": 16}
"""Bits of FLAC samples that hold a recording's samples exactly, by its form."""
FLAC_CHANNELS, FLAC_RATE = 8, 655_350
BLOCK = 1 << 20
"""Bytes that are compressed together."""
FRAMES = 8  # that are quantised at a time, so that they stay in the processor's cache
REMEDY = "run `facediff data check` on the folder, and correct or remove the clip"


@dataclass(frozen=True)
class PackingReport:
    """The outcome of packing."""

    clips: int
    seconds: float  # of motion
    before: int  # bytes of the folder's motion and speech
    after: int  # bytes of the packed corpus
    written: int  # shards written by this run
    left_out: tuple[str, ...]  # files that belong to no clip: motion without speech, or speech without motion


@dataclass(frozen=True)
class ShardPart:
    """Frames of a clip that lie in a shard."""

    path: Path  # the clip's motion
    identity: str  # speaker of the subtracted template
    row: int  # the first row in the shard
    start: int
    stop: int


@dataclass(frozen=True)
class PackingTask:
    """One file to write: a shard of motion, or the encoded speech of a clip."""

    target: str  # path below the store
    coding: str = ""  # of the motion; empty for speech
    parts: tuple[ShardPart, ...] = ()  # of the shard
    sound: Path | None = None

    def __str__(self) -> str:
        return self.target


@checked
def pack(
    root: Path,
    out: Path,
    *,
    corpus: str | None = None,
    tolerance: Annotated[float, Range(FINEST, 1000)] = 0.01,
    lossless: bool = False,
    exact: Exact = "test",
    workers: int | None = None,
    scheduler: str | None = "",
    quiet: bool = True,
) -> PackingReport:
    """Pack a corpus folder.

    A run that was killed is resumed: shards that are there are kept. The record that makes a Zarr group of the folder
    appears last.

    Args:
        root: the corpus folder.
        out: the packed corpus; a new folder named ``*.zarr``, or one that this function has begun.
        corpus: name or import path of the corpus; found out if None.
        tolerance: millimetres by which a coordinate may differ, at most.
        lossless: keep every bit of the motion.
        exact: which clips keep every bit all the same: ``test`` for the test splits and the style references of their
            clips, so that scores do not change; or ``none``.
        workers: processes; as many as there are processors if None.
        scheduler: where tasks run; see :func:`~facediff.utils.jobs.run_tasks`.
        quiet: no progress bar.
    """
    if out.resolve().is_relative_to(root.resolve()):
        raise FaceDiffError(f"{out}: lies in the corpus folder {root}; choose a folder outside it")
    with needs_extra("zarr", "packed", "packing a corpus"):
        import zarr  # noqa: F401
    plan = PackingPlan.of(root, corpus, 0.0 if lossless else tolerance, exact)
    check_writable(out / STATE)
    with locked(out / LOCK, "facediff data pack"):
        return _carry_out(plan, out, workers, scheduler, quiet)


@dataclass(frozen=True)
class PackingPlan:
    """The contents of a packed corpus, from the headers of all files."""

    root: Path  # the corpus folder
    record: Record  # without the shards' sizes, the speech and the files
    files: tuple[str, ...]  # other files of the folder, by path below it
    left_out: tuple[str, ...]  # files of motion or speech that no clip has
    bytes: int  # of motion and speech

    @classmethod
    def of(cls, root: Path, corpus: str | None, tolerance: float, exact: Exact) -> PackingPlan:
        """Scan a corpus folder."""
        from facediff.data.check.layouts import view_of

        view = view_of(root, corpus)
        manifest = read_manifest(root)
        unit = str(manifest.get("unit") or view.unit)
        millimetres = 1000.0 * metres_per_unit(unit) if tolerance else 1.0
        rate = float(manifest.get("frame_rate") or view.stored_frame_rate)
        chunk = chunk_frames(rate, CHUNK_SECONDS)
        step = step_of(tolerance, unit)
        quantised: Coding = "int16" if step * millimetres * np.iinfo(np.int16).max >= ROOM else "int32"
        templates = read_templates(root / "templates.pkl", view.n_vertices)
        if odd := [name for name in templates if name not in PLAIN_NAME]:
            raise FaceDiffError(
                f"{root / 'templates.pkl'}: has an identity {quoted(odd[0])}; expected plain names, without / \\ : and "
                f"no leading dot"
            )
        clips, arrays, left_out, size = {}, {}, [], 0
        rows = dict.fromkeys(CODINGS, 0)
        exact_clips = scored_clips(root, view) if tolerance and exact == "test" else frozenset()
        sounds = {name_of_file(path): path for path in sorted((root / "wav").glob("*.wav"))}
        motions = {
            name_of_file(path): path
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
            if clip.identity not in templates:
                raise FaceDiffError(
                    f"{root / 'templates.pkl'}: no template for {clip.identity}, needed by clip {name}; {REMEDY}"
                )
            dtype = cast(ExactCoding, motion.dtype.name)
            coding = quantised if tolerance and name not in exact_clips else dtype
            silence = PackedSound(0, (), "flac", 16_000, 1, 1, 16)
            clips[name] = PackedClip(name, clip.identity, coding, dtype, rows[coding], motion.frames, silence)
            # Each clip begins at a chunk of its own, so that reading a window decodes no other clip.
            rows[coding] += -(-motion.frames // chunk) * chunk
            size += path.stat().st_size + sounds[name].stat().st_size
        if not clips:
            raise FaceDiffError(f"{root}: no clip with both wav/<clip>.wav and vertices_npy/<clip>.npy; {REMEDY}")
        width = 3 * view.n_vertices
        for coding in sorted({clip.coding for clip in clips.values()}):
            stored = CODINGS[coding]
            chunks = min(max(1, SHARD_BYTES // (chunk * width * stored.itemsize)), rows[coding] // chunk)
            arrays[f"motion_{coding}"] = ArrayInfo(stored.name, rows[coding], width, chunk, chunks, ())
        record = Record(
            made_by=version(),
            corpus=view.corpus,
            n_vertices=view.n_vertices,
            frame_rate=rate,
            tolerance=tolerance,
            step=step,
            unit=unit,
            chunk_seconds=CHUNK_SECONDS,
            identities=tuple(sorted(templates)),
            clips=clips,
            arrays=arrays,
            sources=hash_of([stamp for stamp in file_stamps(root) if "/." not in f"/{stamp[0]}"]),
        )
        return cls(root, record, _other_files(root), tuple(left_out), size)

    @property
    def recipe(self) -> dict[str, Any]:
        """All that determines the output; a run may be resumed only with the same."""
        names = ("made_by", "corpus", "n_vertices", "frame_rate", "tolerance", "unit", "chunk_seconds")
        clips = {name: [clip.coding, clip.frames] for name, clip in self.record.clips.items()}
        settings = {name: getattr(self.record, name) for name in names}
        return {**settings, "state of the corpus": self.record.sources, "clips": clips}

    def tasks(self) -> Iterator[PackingTask]:
        """A task for every shard of motion, and for every clip's speech."""
        for name, array in self.record.arrays.items():
            shard_rows = array.chunk * array.chunks
            parts: dict[int, list[ShardPart]] = {}
            for clip in self.record.clips.values():
                if name != f"motion_{clip.coding}":
                    continue
                path = motion_path(self.root, clip.name)
                for shard in range(clip.first // shard_rows, -(-(clip.first + clip.frames) // shard_rows)):
                    low = max(clip.first, shard * shard_rows)
                    high = min(clip.first + clip.frames, (shard + 1) * shard_rows)
                    part = ShardPart(path, clip.identity, low - shard * shard_rows, low - clip.first, high - clip.first)
                    parts.setdefault(shard, []).append(part)
            for shard in range(-(-array.rows // shard_rows)):
                target = f"{name}/{shard_key(shard, array.width)}"
                yield PackingTask(target, name.removeprefix("motion_"), tuple(parts.get(shard, ())))
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
        relative = path.relative_to(root)
        if relative.parts[0] in (*MOTION_FOLDERS, "wav") or any(part.startswith(".") for part in relative.parts):
            continue
        if path.is_file():
            paths.append(relative.as_posix())
    return tuple(paths)


def _carry_out(plan: PackingPlan, out: Path, workers: int | None, scheduler: str | None, quiet: bool) -> PackingReport:
    if (out / METADATA).is_file():
        return _finished(plan, out)
    begin_folder(out, STATE, plan.recipe, "facediff data pack")
    # Every task writes one file, which appears whole or not at all: a file that exists is finished.
    tasks = [task for task in plan.tasks() if not (out / task.target).is_file()]
    work = partial(_write, out, plan.root, plan.record)
    options = {"workers": workers, "scheduler": scheduler, "writes": out, "reads": [plan.root]}
    do_all(work, tasks, **options, progress="" if quiet else "packing")
    record = _finish(plan, out)
    return _report(plan, record, sum(bool(task.coding) for task in tasks))


def _finished(plan: PackingPlan, out: Path) -> PackingReport:
    """The report of a corpus that an earlier run has packed; sizes are compared, `data check` reads every byte."""
    record = Record.read((out / METADATA).read_bytes(), str(out))
    if replace(plan, record=record).recipe != plan.recipe:
        raise FaceDiffError(
            f"{out}: was packed otherwise, or its corpus has changed since; choose a new folder, or remove this one"
        )
    for name, array in record.arrays.items():
        sizes = {out / name / shard_key(number, array.width): size for number, size in enumerate(array.shards)}
        if odd := [path for path, size in sizes.items() if not path.is_file() or path.stat().st_size != size]:
            raise FaceDiffError(f"{odd[0]}: is missing or damaged; remove the packed corpus, and pack it again")
    _clear(out)
    return _report(plan, record, 0)


def _report(plan: PackingPlan, record: Record, written: int) -> PackingReport:
    seconds = sum(clip.frames for clip in record.clips.values()) / record.frame_rate
    after = sum(size for array in record.arrays.values() for size in array.shards)
    return PackingReport(len(record.clips), seconds, plan.bytes, after, written, plan.left_out)


def _finish(plan: PackingPlan, out: Path) -> Record:
    """Join the encoded speech, add files and templates, and write the record last."""
    # Speech is encoded in parallel to one file a clip; its place in the common array is known only now.
    clips, speech_bytes = {}, 0
    for name, clip in plan.record.clips.items():
        with (out / PARTS / name).open("rb") as stream:
            sound = PackedSound(**{**parse_json(stream.readline(), out / STATE), "first": speech_bytes})
        clips[name] = replace(clip, sound=replace(sound, pieces=tuple(sound.pieces)))
        speech_bytes += sum(sound.pieces)
    speech = ((out / PARTS / name).read_bytes().partition(b"\n")[2] for name in clips)
    files, file_bytes = {}, 0
    for path in plan.files:
        content = (plan.root / path).read_bytes()
        files[path] = PackedFile(path, file_bytes, len(content), hashlib.sha256(content).hexdigest())
        file_bytes += len(content)
    templates = read_templates(plan.root / "templates.pkl", plan.record.n_vertices)
    faces = np.stack([templates[name].numpy().ravel() for name in plan.record.identities])
    arrays = dict(plan.record.arrays)
    arrays["templates"] = ArrayInfo("float32", len(faces), faces.shape[1], 1, len(faces), ())
    with atomic(out / "templates" / shard_key(0, faces.shape[1])) as temporary:
        temporary.write_bytes(encoded(arrays["templates"], faces))
    arrays["speech"] = write_blob(out, "speech", speech_bytes, speech)
    arrays["files"] = write_blob(out, "files", file_bytes, ((plan.root / path).read_bytes() for path in plan.files))
    for name, array in arrays.items():
        with atomic(out / name / METADATA) as temporary:
            temporary.write_bytes(encoded(array, None))
        count = -(-array.rows // (array.chunk * array.chunks))
        sizes = tuple((out / name / shard_key(shard, array.width)).stat().st_size for shard in range(count))
        arrays[name] = replace(array, shards=sizes)
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
        array = record.arrays[f"motion_{task.coding}"]
        rows = np.zeros((array.chunk * array.chunks, array.width), CODINGS[task.coding])
        templates = read_templates(root / "templates.pkl", record.n_vertices)
        for part in task.parts:
            stored = open_motion(part.path, record.n_vertices).read(range(part.start, part.stop))
            with np.errstate(all="ignore"):
                refuse_out_of_range(stored.astype(np.float32), range(part.start, part.stop), part.path)
            last = part.row + part.stop - part.start
            if task.coding in QUANTISED:
                rows[part.row : last] = _steps(part, stored, templates[part.identity].numpy(), record, rows.dtype)
            else:  # the bits of absolute vertices as whole numbers
                exact = np.ascontiguousarray(stored, stored.dtype.newbyteorder("<"))
                rows[part.row : last] = exact.reshape(len(exact), -1).view(rows.dtype)
            padded = -(-last // array.chunk) * array.chunk
            # The end of a clip's last chunk repeats its last frame: the differences below are zero there.
            rows[last:padded] = rows[last - 1]
        for first in range(0, len(rows), array.chunk):
            chunk = rows[first : first + array.chunk]
            # Differences between frames are small and compress well; each chunk starts with a whole row, so that it can
            # be decoded alone.
            chunk[1:] = chunk[1:] - chunk[:-1]
        content = encoded(array, rows)
    with atomic(out / task.target) as temporary:
        temporary.write_bytes(content)


def _steps(
    part: ShardPart,
    stored: npt.NDArray[np.floating],
    template: npt.NDArray[np.float32],
    record: Record,
    dtype: np.dtype[Any],
) -> npt.NDArray[Any]:
    """Offsets from the template in whole quantisation steps (frames, 3V)."""
    steps = np.empty((len(stored), stored.shape[1] * 3), dtype)
    for first in range(0, len(stored), FRAMES):
        piece = np.rint((np.array(stored[first : first + FRAMES], np.float64) - template) / record.step)
        largest = float(np.abs(piece).max(initial=0.0))
        if largest > np.iinfo(dtype).max:
            raise FaceDiffError(
                f"{part.path}: a coordinate lies {largest * record.step:.4g} {record.unit.split(' ')[0]} away from the "
                f"template of {part.identity}, more than can be packed at this tolerance; {REMEDY}, or pack with "
                f"--lossless"
            )
        steps[first : first + FRAMES] = piece.reshape(len(piece), -1)
    return steps


def encode_speech(path: Path) -> bytes:
    """A line of JSON, then the recording as FLAC streams; as the file itself where FLAC would lose something."""
    import soundfile

    with open_sound(path) as file:
        refuse_cut_short(path)
        rate, channels, samples = int(file.samplerate), int(file.channels), int(file.frames)
        fits_flac = channels <= FLAC_CHANNELS and rate <= FLAC_RATE
        bits: Literal[0, 16, 24] = BITS.get(file.subtype, 0) if fits_flac else 0
        pieces, decoded = [] if bits else [path.read_bytes()], 0 if bits else samples
        for first in range(0, samples if bits else 0, PIECE_SECONDS * rate):
            block = file.read(min(PIECE_SECONDS * rate, samples - first), dtype="int32", always_2d=True)
            stream = io.BytesIO()
            soundfile.write(stream, block, rate, format="FLAC", subtype=f"PCM_{bits}")
            pieces.append(stream.getvalue())
            decoded += len(block)
        if not samples or decoded != samples:
            raise FaceDiffError(f"{path}: is cut short: {decoded} of {samples} samples; {REMEDY}")
    sound = PackedSound(0, tuple(map(len, pieces)), "flac" if bits else "wav", rate, channels, samples, bits)
    return json.dumps(asdict(sound), allow_nan=False).encode() + b"\n" + b"".join(pieces)


# Zarr's files, made by the zarr package.


def write_blob(out: Path, name: str, size: int, contents: Iterable[bytes]) -> ArrayInfo:
    """Write an array of bytes; no more than a shard is in memory."""
    chunks = max(1, min(BLOB_SHARD, size + BLOB_CHUNK - 1) // BLOB_CHUNK)
    array = ArrayInfo("uint8", size, 0, BLOB_CHUNK, chunks, ())
    shard_bytes, buffer, shard = BLOB_CHUNK * chunks, bytearray(), 0
    for content in chain(contents, [b""]):
        buffer += content
        while len(buffer) >= shard_bytes or (not content and buffer):
            with atomic(out / name / shard_key(shard, 0)) as temporary:
                temporary.write_bytes(encoded(array, np.frombuffer(bytes(buffer[:shard_bytes]), np.uint8)))
            del buffer[:shard_bytes]
            shard += 1
    return array


def encoded(array: ArrayInfo, rows: npt.NDArray[Any] | None) -> bytes:
    """A shard as Zarr writes it, with zeros after ``rows``; the array's ``zarr.json`` if ``rows`` is None."""
    import zarr
    from zarr.codecs import BloscCodec, Crc32cCodec
    from zarr.storage import MemoryStore

    shard_rows = array.chunk * array.chunks
    width = (array.width,) if array.width else ()
    files: dict[str, Any] = {}
    itemsize = np.dtype(array.dtype).itemsize
    stored: Any = zarr.create_array(
        store=MemoryStore(files),
        shape=(array.rows if rows is None else shard_rows, *width),
        shards=(shard_rows, *width),
        chunks=(array.chunk, *width),
        dtype=array.dtype,
        compressors=[
            # The upper bits of differences are alike and the lowest are noise. After a bit shuffle, zstd sees either
            # one repeated byte or noise that it stores, and decodes in a fraction of the time that a byte shuffle
            # takes. Smaller blocks take more room; level 5 takes 5 % less room than level 1 and decodes as quickly.
            BloscCodec(
                typesize=itemsize,
                cname="zstd",
                clevel=5,
                shuffle="bitshuffle",
                blocksize=min(array.chunk_bytes, BLOCK),
            ),
            Crc32cCodec(),
        ],
        fill_value=0,
        config={"write_empty_chunks": True},
    )
    if rows is None:
        return bytes(files[METADATA].to_bytes())
    content = np.zeros((shard_rows, *width), array.dtype)
    content[: len(rows)] = rows
    stored[...] = content
    return bytes(files[shard_key(0, array.width)].to_bytes())


def group_metadata(record: Record) -> bytes:
    """The group's ``zarr.json``."""
    import zarr
    from zarr.storage import MemoryStore

    files: dict[str, Any] = {}
    zarr.create_group(store=MemoryStore(files), attributes={RECORD: record.state()})
    return bytes(files[METADATA].to_bytes())
