"""People's recordings with their phones, as the built-in corpus takes them (``data.recordings``).

Phones come from a TextGrid next to a recording, where an aligner such as the Montreal Forced Aligner has made one, else
from pocketsphinx (Carnegie Mellon, BSD), which also recognises English words that are not given. Recordings are cut at
pauses into pieces that a corpus can use.
"""

from __future__ import annotations

import contextlib
import glob
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, counted, needs_extra
from facediff.speech.audio import RECORDINGS, read_speech, write_wav
from facediff.speech.phonemes import closing
from facediff.speech.text_grids import SILENCES, WORDS, Interval, find_tier, phones_in, read_text_grid, write_text_grid
from facediff.utils import SAMPLE_RATE
from facediff.utils.batch import FileTask, Recipe, run_batch
from facediff.utils.files import atomic
from facediff.utils.jobs import PerWorker

SHORTEST, LONGEST = 2.5, 8.0
"""Seconds of a piece: shorter ones are joined to the next, longer ones are cut between words."""
LEAST = 1.0  # seconds of a piece that is kept
PAUSE, MARGIN = 0.15, 0.2
"""Seconds of a pause at which recordings are cut, and those of it that a piece keeps."""
ALIGNMENTS = ".alignments"
"""Hidden folder with the alignment of each whole recording."""
STEP = 100  # pocketsphinx's frames a second
_NOISE = {"SIL", "+NSN+", "+SPN+"}


@dataclass(frozen=True)
class AlignmentReport:
    """The recordings that were aligned, and those that could not be, with the reasons."""

    out: Path
    speakers: dict[str, int]  # pieces of each speaker
    seconds: float
    phones: int
    closures: int  # phones at which the lips close
    failed: dict[str, str]

    def lines(self) -> list[str]:
        """The report, a line each."""
        total = f"{counted(len(self.speakers), 'speaker')}, {counted(sum(self.speakers.values()), 'piece')}"
        return [
            f"{self.out}: {total}, {self.seconds / 60:.1f} min; {counted(self.phones, 'phone')}, "
            f"{self.closures} of them p, b or m",
            *(f"not used: {problem}" for problem in self.failed.values()),
        ]


def find_recordings(source: Path) -> dict[Path, str]:
    """Recordings below a folder with their speakers.

    A recording belongs to the first folder on its way; directly in the folder, each is a speaker, who is called as the
    file up to the first dash (``84-121123-0000.flac`` of LibriSpeech is speaker 84).
    """
    found: dict[Path, str] = {}
    for path in sorted(source.rglob("*")):
        parts = path.relative_to(source).parts
        if path.suffix.lower() in RECORDINGS and not any(part.startswith(".") for part in parts):
            found[path] = parts[0] if len(parts) > 1 else path.stem.partition("-")[0]
    if not found:
        raise FaceDiffError(
            f"{source}: holds no recordings; expected {', '.join(RECORDINGS)}, in a folder for each speaker"
        )
    return found


def align_recordings(
    source: Path, out: Path, *, workers: int | None = None, scheduler: str | None = "", progress: bool = False
) -> AlignmentReport:
    """Write ``SPEAKER/NAME-1.wav`` and ``.TextGrid``, ``NAME-2`` … of each recording; a stopped run is continued.

    Args:
        source: folder of recordings; see :func:`find_recordings`. Words may be in ``NAME.txt``, or in a
            ``*.trans.txt`` of LibriSpeech.
        out: folder to make or to continue.
        workers: recordings at a time.
        scheduler: where; see :func:`facediff.utils.jobs.run_tasks`.
        progress: whether to show a progress bar.
    """
    made: dict[Path, FileTask] = {}
    for path, speaker in find_recordings(source).items():
        name = "_".join(path.relative_to(source).with_suffix("").parts[1:]) or path.stem
        output = out / ALIGNMENTS / speaker / f"{name}.TextGrid"
        if output in made:
            raise FaceDiffError(f"{path}: would be written as {made[output].source} is; rename one of them")
        words = [path.with_suffix(".TextGrid"), path.with_suffix(".txt"), *path.parent.glob("*.trans.txt")]
        recipe = Recipe.of(("align",), [file for file in words if file.is_file()])
        made[output] = FileTask(path, output, recipe)
    tasks = made.values()
    pending = [task for task in tasks if not task.output.exists() or task.change()]
    for task in pending:
        task.output.parent.mkdir(parents=True, exist_ok=True)
        (out / task.output.parent.name).mkdir(exist_ok=True)
    options: dict[str, Any] = {"workers": workers, "scheduler": scheduler, "writes": out, "reads": [source]}
    options["progress"] = "aligning" if progress else ""
    with contextlib.closing(run_batch(PerWorker(Aligner), pending, record=FileTask.record, **options)) as outcomes:
        failed = {str(task): outcome.problem for task, outcome in outcomes if outcome.problem}
    return _report(out, failed)


def _report(out: Path, failed: dict[str, str]) -> AlignmentReport:
    speakers: Counter[str] = Counter()
    phones = closures = 0
    seconds = 0.0
    for grid in sorted(out.glob("*/*.TextGrid")):
        if grid.parent.name != ALIGNMENTS:
            intervals = phones_in(grid)
            speakers[grid.parent.name] += 1
            labels = [text for _, _, text in intervals if text.lower() not in SILENCES]
            phones, closures = phones + len(labels), closures + sum(name is not None for name in closing(labels))
            seconds += intervals[-1][1]
    return AlignmentReport(out, dict(speakers), seconds, phones, closures, failed)


Word = tuple[Interval, list[Interval]]
"""A word, or a pause, and its phones."""


class Aligner:
    """Aligns recordings; a worker has one, which loads its models when they are needed."""

    def __call__(self, task: FileTask) -> list[Path]:
        """Write the pieces of a recording, then the alignment of the whole."""
        speech = read_speech(task.source)
        own = task.source.with_suffix(".TextGrid")
        words = _words_of(own) if own.is_file() else self.align(speech, known_words(task.source), task.source)
        folder = task.output.parents[2] / task.output.parent.name
        stem, count, end = task.output.stem, 0, len(speech) / SAMPLE_RATE
        for stale in folder.glob(f"{glob.escape(stem)}-*"):
            if re.fullmatch(r"\d+\.(wav|TextGrid)", stale.name.removeprefix(f"{stem}-")):
                stale.unlink()
        for count, piece in enumerate(pieces(words), 1):
            start, stop = _margins(piece, end)
            sound = folder / f"{stem}-{count}.wav"
            with atomic(sound) as temporary:
                write_wav(temporary, speech[round(start * SAMPLE_RATE) : round(stop * SAMPLE_RATE)], SAMPLE_RATE)
            _write_words(sound.with_suffix(".TextGrid"), piece, start, stop)
        if not count:
            raise FaceDiffError(f"{task.source}: holds no {LEAST:g} s of speech between pauses; leave it out")
        _write_words(task.output, words, 0.0, end)
        return [task.output]

    def align(self, speech: npt.NDArray[np.float32], text: str, source: Path) -> list[Word]:
        """Words and phones of speech; the words are recognised where they are not known.

        Args:
            speech: (S,) at 16 kHz.
            text: its English words, or nothing.
            source: for messages.
        """
        samples = np.rint(np.clip(speech, -1, 1) * 32767).astype(np.int16).tobytes()
        if not text:
            self._hear(self._recogniser, samples)
            text = getattr(self._recogniser.hyp(), "hypstr", "")
        unknown = [word for word in text.split() if self._aligner.lookup_word(word) is None]
        if unknown or not text:
            fault = (
                f"pocketsphinx does not know the word {unknown[0]!r}" if unknown else "no words are recognised in it"
            )
            raise FaceDiffError(f"{source}: {fault}; put a TextGrid of another aligner next to it, or leave it out")
        words: list[Word] = []
        try:
            self._aligner.set_align_text(text)
            self._hear(self._aligner, samples)
            self._aligner.set_alignment()
            self._hear(self._aligner, samples)
            alignment = self._aligner.get_alignment()
            # Its entries live as long as the iteration over it.
            words = [(_interval(word), [_interval(phone) for phone in word]) for word in alignment]
        except RuntimeError:  # its only sign that there is no path through the words
            pass
        if [word for (_, _, word), _ in words if word] != text.split():  # or a path that stops before the last word
            raise FaceDiffError(
                f"{source}: its words could not be found in its sound; correct NAME.txt, or put a TextGrid next to it"
            )
        return words

    @cached_property
    def _recogniser(self) -> Any:  # noqa: ANN401 - a class of C
        return _decoder()

    @cached_property
    def _aligner(self) -> Any:  # noqa: ANN401
        return _decoder(lm=None)

    @staticmethod
    def _hear(decoder: Any, samples: bytes) -> None:  # noqa: ANN401
        decoder.start_utt()
        decoder.process_raw(samples, no_search=False, full_utt=True)
        decoder.end_utt()


def _decoder(**options: Any) -> Any:  # noqa: ANN401
    with needs_extra("pocketsphinx", "align", "aligning recordings without a TextGrid"):
        from pocketsphinx import Decoder
    return Decoder(samprate=float(SAMPLE_RATE), loglevel="FATAL", **options)


def _interval(entry: Any) -> Interval:  # noqa: ANN401
    name = re.sub(r"\(\d+\)$", "", entry.name)
    silent = name in _NOISE or name.startswith(("<", "["))
    return entry.start / STEP, (entry.start + entry.duration) / STEP, "" if silent else name


def known_words(recording: Path) -> str:
    """The words of a recording, in lower case without punctuation; empty if they are not known."""
    beside = recording.with_suffix(".txt")
    text = beside.read_text(encoding="utf-8-sig") if beside.is_file() else ""
    for table in recording.parent.glob("*.trans.txt") if not text else ():  # LibriSpeech: a line for each recording
        lines = (line.partition(" ") for line in table.read_text(encoding="utf-8-sig").splitlines())
        text = next((words for name, _, words in lines if name == recording.stem), "")
    return " ".join(re.findall(r"[\w']+", text.lower()))


def _words_of(grid: Path) -> list[Word]:
    """Words with their phones of a TextGrid; without a tier of words, each phone is cut as a word is."""
    phones = [(start, end, "" if text.lower() in SILENCES else text) for start, end, text in phones_in(grid)]
    tier = find_tier(read_text_grid(grid), WORDS)
    words = [(start, end, "" if text.lower() in SILENCES else text) for start, end, text in tier] if tier else phones
    return [
        (word, [phone for phone in phones if word[0] - 1e-3 <= (phone[0] + phone[1]) / 2 < word[1] + 1e-3])
        for word in words
    ]


def pieces(words: Sequence[Word]) -> Iterator[list[Word]]:
    """Cut a recording at pauses, and between words where none comes in time; pieces without speech are left out."""
    piece: list[Word] = []
    for word in words:
        (start, end, text), _ = word
        begun = piece[0][0][0] if piece else start
        pause = not text and end - start >= PAUSE
        piece.append(word)
        if (pause and start - begun >= SHORTEST) or end - begun > LONGEST:
            yield from _usable(piece)
            piece = [word] if pause else []
    yield from _usable(piece)


def _usable(piece: list[Word]) -> Iterator[list[Word]]:
    spoken = [word for word, _ in piece if word[2]]
    if spoken and spoken[-1][1] - spoken[0][0] >= LEAST:
        yield piece


def _margins(piece: Sequence[Word], end: float) -> tuple[float, float]:
    """Where a piece begins and ends in seconds, with a little of the pauses around it."""
    (first_start, first_end, first), (last_start, last_end, last) = piece[0][0], piece[-1][0]
    start = first_start if first else max(first_start, first_end - MARGIN)
    return start, min(end, last_end if last else min(last_end, last_start + MARGIN))


def _write_words(path: Path, words: Sequence[Word], start: float, stop: float) -> None:
    def inside(intervals: Sequence[Interval]) -> list[Interval]:
        moved = [(max(a, start) - start, min(b, stop) - start, text) for a, b, text in intervals]
        return [(a, b, text) for a, b, text in moved if b - a > 1e-3]

    phones = [phone for _, part in words for phone in part]
    write_text_grid(path, {"words": inside([word for word, _ in words]), "phones": inside(phones)}, stop - start)
