"""Reading a packed corpus: its small files as a folder, its clips as a :class:`~facediff.data.storage.ClipStorage`."""

from __future__ import annotations

import hashlib
import io
import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.packed.decoded import DecodedChunks
from facediff.data.packed.layout import (
    DAMAGED,
    EXACT,
    METADATA,
    PIECE_SECONDS,
    REMEDY,
    STATE,
    PackedClip,
    PackedSound,
    Record,
)
from facediff.data.packed.shards import ShardedArray, chunks_of
from facediff.data.packed.stores import ByteStore, LocalStore, open_store, runs
from facediff.data.storage import refuse_out_of_range, within
from facediff.errors import FaceDiffError, damaged
from facediff.speech.audio import fit_length, open_sound, read_speech, to_speech
from facediff.utils import SAMPLE_RATE
from facediff.utils.arrays import ArrayStore
from facediff.utils.files import atomic_folder, cache_dir
from facediff.utils.workers import processors

Floats = npt.NDArray[np.float32]

MOST_THREADS = 4
"""Threads that decode the chunks of a window; more are limited by memory bandwidth."""


class PackedCorpus:
    """A packed corpus, opened.

    Args:
        source: its folder, or its address.
    """

    def __init__(self, source: str | Path) -> None:
        store = open_store(source)
        if isinstance(store, LocalStore) and not (store.root / METADATA).is_file():
            what = (
                f"its packing was interrupted ({STATE} is there, {METADATA} is not); run the same `facediff data pack` "
                f"again to continue it"
                if (store.root / STATE).is_file()
                else "no packed corpus; expected what `facediff data pack` writes"
            )
            raise FaceDiffError(f"{store.root}: {what}")
        text = store.whole(METADATA)
        self.source = store.source
        self.record = Record.read(text, self.source)
        # The record holds the size and place of everything, so its hash identifies the content for caches.
        self.identity = hashlib.sha256(text).hexdigest()[:40]
        self.store: ByteStore = store
        self._decoded_chunks = DecodedChunks()
        self._arrays = {name: ShardedArray(store, name, array) for name, array in self.record.arrays.items()}

    @property
    def folders(self) -> list[Path]:
        """Folders that workers on other machines must see: its own, or none for an address."""
        return [Path(self.source)] if isinstance(self.store, LocalStore) else []

    # Its small files.

    @cached_property
    def folder(self) -> Path:
        """A folder on this machine with every file of the corpus but motion and speech, made on first use."""
        folder = cache_dir() / "packed" / self.identity / "corpus"
        if not folder.is_dir():
            try:
                with atomic_folder(folder) as temporary:
                    self.write_files(temporary)
            except FaceDiffError:
                if not folder.is_dir():  # else another process was quicker
                    raise
        return folder

    def write_files(self, folder: Path) -> None:
        """Write every file of the corpus but motion and speech."""
        for file in self.record.files.values():
            content = self._arrays["files"].read(file.first, file.first + file.bytes).tobytes()
            if hashlib.sha256(content).hexdigest() != file.sha256:
                raise FaceDiffError(
                    f"{self.source}: its file {file.path} has another checksum than when it was packed; {DAMAGED}"
                )
            path = folder / file.path
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def templates(self) -> dict[str, Floats]:
        """Neutral face (V, 3) of every identity, from the array."""
        rows = self._arrays["templates"].read(0, len(self.record.identities))
        return {name: row.reshape(-1, 3) for name, row in zip(self.record.identities, rows, strict=True)}

    # Its clips: the methods of ClipStorage.

    def names(self) -> list[str]:
        """Every clip, sorted."""
        return list(self.record.clips)

    def open(self, name: str) -> PackedMotion:
        """The motion of a clip; nothing is read yet."""
        clip = self.record.clips[name]
        return PackedMotion(self.source, self.record, clip, self._arrays[f"motion_{clip.coding}"], self._decoded_chunks)

    def version(self, name: str) -> object:
        """The hash of the whole record, which holds the size of every shard: the same for all clips."""
        return self.identity

    def speech(self, name: str, first: int, length: int, store: ArrayStore) -> Floats:
        """Samples of a clip's speech at 16 kHz (length,), filled with zeros past its end.

        Of 16 kHz mono speech only the streams that hold the samples are read. Any other speech is converted as a whole
        once and cached in ``store``, like the speech of a folder.
        """
        sound = self.record.clips[name].sound
        if sound.form == "flac" and sound.rate == SAMPLE_RATE and sound.channels == 1:
            stop = min(first + length, sound.samples)
            samples = self.samples(name, first, stop) if stop > first else np.zeros((0, 1), np.int32)
            scale = np.float32(2.0 ** (1 - sound.bits))
            return fit_length(samples[:, 0].astype(np.float32) * scale, length)
        key = store.key("packed speech", SAMPLE_RATE, self.identity, name)
        speech = store.get(key)
        if speech is None:
            speech = store.put(key, self.whole_speech(name))
        return fit_length(np.array(speech[first : first + length], np.float32), length)

    def whole_speech(self, name: str) -> Floats:
        """All speech of a clip as 16 kHz mono (S,)."""
        sound = self.record.clips[name].sound
        if sound.form == "flac":
            samples = self.samples(name, 0, sound.samples)
            return to_speech(samples * np.float32(2.0 ** (1 - sound.bits)), sound.rate, self._speech_of(name))
        with tempfile.TemporaryDirectory(prefix="facediff-") as folder:
            path = Path(folder) / f"{name}.wav"
            path.write_bytes(self.recording(name))
            return read_speech(path)

    def samples(self, name: str, first: int, stop: int) -> npt.NDArray[np.int32]:
        """Samples ``first`` to ``stop`` of a clip (samples, channels) as they were recorded, whole numbers."""
        sound = self.record.clips[name].sound
        piece_samples = PIECE_SECONDS * sound.rate
        # libsndfile left-aligns FLAC samples in 32 bits; the shift at the end gives the recorded values back.
        samples = np.empty((stop - first, sound.channels), np.int32)
        for number, begin, end in _pieces(sound, first, stop):
            encoded = self._arrays["speech"].read(begin, end).tobytes()
            expected = min(piece_samples, sound.samples - number * piece_samples)
            low, high = max(first, number * piece_samples), min(stop, number * piece_samples + expected)
            samples[low - first : high - first] = self._decoded(
                encoded, name, expected, low - number * piece_samples, high - number * piece_samples
            )
        return samples >> (32 - sound.bits)

    def recording(self, name: str) -> bytes:
        """The original file of a recording that FLAC cannot hold."""
        sound = self.record.clips[name].sound
        return self._arrays["speech"].read(sound.first, sound.first + sum(sound.pieces)).tobytes()

    def _decoded(self, encoded: bytes, name: str, expected: int, low: int, high: int) -> npt.NDArray[np.int32]:
        """Samples ``low`` to ``high`` of a stream of ``expected`` samples; the samples around them are not decoded."""
        sound = self.record.clips[name].sound
        with open_sound(io.BytesIO(encoded), self._speech_of(name)) as file:
            declared = (file.format, file.frames, file.channels, file.samplerate)
            required = ("FLAC", expected, sound.channels, sound.rate)
            if declared == required:
                if low:
                    file.seek(low)
                piece: npt.NDArray[np.int32] = file.read(high - low, dtype="int32", always_2d=True)
                if len(piece) == high - low:
                    return piece
        raise FaceDiffError(f"{self._speech_of(name)} differs from its entry in the record; {REMEDY}")

    def _speech_of(self, name: str) -> str:
        return f"{self.source}: speech of clip {name}"


@dataclass(frozen=True, eq=False)
class PackedMotion:
    """The motion of one clip of a packed corpus."""

    source: str  # the corpus, for messages
    record: Record  # of the corpus
    clip: PackedClip  # the clip
    array: ShardedArray  # that holds its rows
    decoded: DecodedChunks  # cache of chunks

    @property
    def frames(self) -> int:
        """Stored frames."""
        return self.clip.frames

    def offsets(self, picks: Sequence[int], template: Floats) -> Floats:
        """Offsets from the template of some frames; only the chunks that hold them are read."""
        picks = within(picks, self.frames)
        motion = np.empty((len(picks), self.array.info.width), np.float32)
        rows_by_chunk = chunks_of(picks, self.array.info.chunk)
        tasks: list[tuple[int, npt.NDArray[Any] | memoryview]] = []
        to_fetch = []
        for number in sorted(rows_by_chunk):
            chunk = self.decoded.get((self.array.name, self._begin + number))
            if chunk is None:
                to_fetch.append(number)
            else:
                tasks.append((number, chunk))
        # Neighbouring chunks are fetched together: in a store at an address each request costs a round trip.
        with damaged(f"clip {self.clip.name}", REMEDY):
            for run in runs([(number, 1) for number in to_fetch]):
                first, stop = run[0][0], sum(run[-1])
                fetched = self.array.fetch(self._begin + first, self._begin + stop)
                tasks += zip(range(first, stop), fetched, strict=True)

            def write(task: tuple[int, npt.NDArray[Any] | memoryview]) -> None:
                number, chunk = task
                rows = rows_by_chunk[number]
                if isinstance(chunk, memoryview):
                    chunk = self._summed(self._begin + number, chunk, max(row for row, _ in rows))
                self._write(chunk, rows, motion)

            threads = min(len(tasks), _threads())
            if threads > 1:
                list(_pool().map(write, tasks))
            else:
                for task in tasks:
                    write(task)
        offsets = motion.reshape(len(picks), -1, 3)
        if self.clip.coding in EXACT:
            refuse_out_of_range(offsets, picks, f"{self.source}: clip {self.clip.name}")
            offsets -= template
        return offsets

    @property
    def _begin(self) -> int:
        """Its first chunk in the array."""
        return self.clip.first // self.array.info.chunk

    def _summed(self, number: int, encoded: memoryview, last: int) -> npt.NDArray[Any]:
        """The rows of a chunk up to ``last`` at least, in memory that the thread's next call overwrites."""
        chunk = self.array.decode(number, encoded)
        key = (self.array.name, number)
        stores = self.decoded.stores(key, chunk.nbytes, _processes())
        # Rows are stored as differences from the row before, in whole numbers that wrap around, so the running sum is
        # exact. A window needs few rows of its last chunk.
        for row in range(1, len(chunk) if stores else last + 1):
            np.add(chunk[row], chunk[row - 1], out=chunk[row])
        if stores:
            self.decoded.put(key, chunk, _processes())
        return chunk

    def _write(self, chunk: npt.NDArray[Any], rows: list[tuple[int, int]], motion: Floats) -> None:
        """Write rows of a chunk to frames of ``motion``."""
        exact = np.dtype(self.clip.coding) if self.clip.coding in EXACT else None
        step = np.float32(self.record.step)
        for row, frame in rows:
            if exact is None:
                # Convert, then scale in place: a fifth faster than `row * step`, which allocates an array.
                np.copyto(motion[frame], chunk[row])
                motion[frame] *= step
            else:
                with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is refused
                    np.copyto(motion[frame], chunk[row].view(exact), casting="same_kind")

    def vertices(self) -> npt.NDArray[np.floating]:
        """All frames as they were, bit for bit (T, V, 3), of a clip that was packed without loss."""
        info = self.array.info
        rows = np.empty((self.frames, info.width), info.dtype)
        count = -(-self.frames // info.chunk)
        for number, encoded in enumerate(self.array.fetch(self._begin, self._begin + count)):
            chunk = self.array.decode(self._begin + number, encoded)
            np.cumsum(chunk, axis=0, dtype=chunk.dtype, out=chunk)
            first = number * info.chunk
            rows[first : first + info.chunk] = chunk[: self.frames - first]
        return rows.view(np.dtype(self.clip.coding)).reshape(self.frames, -1, 3)


def _pieces(sound: PackedSound, first: int, stop: int) -> list[tuple[int, int, int]]:
    """Number, first byte and last byte + 1 of the streams that hold samples ``first`` to ``stop``."""
    length = PIECE_SECONDS * sound.rate
    ends = np.cumsum([sound.first, *sound.pieces]).tolist()
    return [(number, ends[number], ends[number + 1]) for number in range(first // length, -(-stop // length))]


def _threads() -> int:
    """Threads that may decode at the same time: this loader process's share of the processors."""
    return max(1, min(MOST_THREADS, processors() // _processes()))


def _processes() -> int:
    """Loader processes that share this machine's processors and memory."""
    from torch.utils.data import get_worker_info

    worker: Any = get_worker_info()
    return 1 if worker is None else max(1, worker.num_workers)


_pools: dict[int, ThreadPoolExecutor] = {}


def _pool() -> ThreadPoolExecutor:
    """The threads of this process that decode; threads do not survive the fork of a loader process."""
    if os.getpid() not in _pools:
        _pools.clear()
        _pools[os.getpid()] = ThreadPoolExecutor(_threads(), "facediff-packed")
    return _pools[os.getpid()]
