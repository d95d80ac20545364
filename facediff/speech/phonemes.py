"""When which phoneme is spoken in a clip, and when its lips close."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError
from facediff.utils.limits import LIMITS
from facediff.utils.plain_files import read_rows

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

STRESS, LENGTH = "ˈˌ", "ː"
BILABIALS = ("p", "b", "m")
"""Phonemes for which the lips close."""


@dataclass(frozen=True)
class TimedPhoneme:
    """A phoneme in time.

    Attributes:
        start: where it begins, in seconds.
        end: where it ends.
        ipa: the phoneme, with stress and length marks; empty for a pause.
        viseme: names of its visemes, joined by "+"; may be empty.
        word: the word it belongs to; empty if that is not known.
    """

    start: float
    end: float
    ipa: str
    viseme: str = ""
    word: str = ""

    @property
    def middle(self) -> float:
        """The middle of its time, in seconds."""
        return (self.start + self.end) / 2

    @property
    def plain(self) -> str:
        """The phoneme without stress marks."""
        return self.ipa.strip(STRESS)


def phonemes_file(corpus: Path | None, clip: str) -> Path | None:
    """Where a corpus has a clip's phonemes; None if it has none."""
    path = None if corpus is None else corpus / "phonemes" / f"{clip}.csv"
    return path if path is not None and path.is_file() else None


def read_phonemes(path: Path) -> list[TimedPhoneme]:
    """Phonemes of a table with the columns ``start``, ``end`` (seconds) and ``ipa``, and maybe ``viseme``, ``word``.

    Raises:
        FaceDiffError: if the file is not that.
    """
    expected = "expected a table with the columns start, end (seconds), ipa"
    try:
        phonemes = [
            TimedPhoneme(
                float(row["start"]),
                float(row["end"]),
                row["ipa"],
                row.get("viseme", ""),
                row.get("word", "").strip(),
            )
            for row in read_rows(path, remedy=expected)
        ]
    except (KeyError, ValueError) as error:
        raise FaceDiffError(f"{path}: not readable as phonemes ({error}); {expected}") from error
    if not phonemes or any(not (math.isfinite(p.end) and 0 <= p.start <= p.end) for p in phonemes):
        raise FaceDiffError(f"{path}: expected phonemes whose start is not below 0 and not after their end")
    return phonemes


def closed_times(phonemes: Iterable[TimedPhoneme]) -> list[tuple[float, float]]:
    """Start and end, in seconds, of each p, b and m, in order."""
    return [
        (phoneme.start, phoneme.end)
        for phoneme in sorted(phonemes, key=lambda phoneme: phoneme.start)
        if phoneme.ipa.strip(STRESS + LENGTH) in BILABIALS
    ]


def closures(phonemes: Iterable[TimedPhoneme], frame_rate: float) -> list[tuple[int, int]]:
    """The frames in which the lips close for p, b and m, as `facediff.metrics.BilabialClosureRate` takes them.

    Args:
        phonemes: Of one clip.
        frame_rate: Frames per second of its motion.

    Returns:
        First frame and frame after the last of each closure, in order; at least one frame each. Closures that touch
        are one.

    Example:
        >>> closures([TimedPhoneme(0.0, 0.1, "m"), TimedPhoneme(0.3, 0.31, "b")], 25)
        [(0, 2), (8, 9)]
    """
    frames: list[tuple[int, int]] = []
    for opens, closes in closed_times(phonemes):
        start = round(opens * frame_rate)
        end = max(start + 1, round(closes * frame_rate))
        if frames and start <= frames[-1][1]:
            frames[-1] = (frames[-1][0], max(end, frames[-1][1]))
        else:
            frames.append((start, end))
    return frames


def spoken_by_machine(text: str) -> tuple[npt.NDArray[np.float32], list[TimedPhoneme]]:
    """An English text as espeak-ng speaks it, (S,) at 16 kHz, with the times of its phonemes but for pauses.

    Raises:
        MissingExtraError: if espeak-ng is not installed.
    """
    from facediff.speech.espeak import EspeakVoice, speak

    utterance = speak(" ".join(text.split()), EspeakVoice("en-us", rate=165, pitch=50, pitch_range=50))
    return utterance.samples, [
        TimedPhoneme(phoneme.start, phoneme.end, phoneme.ipa) for phoneme in utterance.phonemes if phoneme.ipa
    ]


# Alignments from elsewhere: Praat's TextGrid, which the usual aligners write.

SILENCES = ("", "sil", "sp", "spn", "pau", "<eps>", "<sil>", "_", "#", "silence")
"""Labels of pauses."""

TIERS = ("phones", "phone", "phonemes", "phoneme", "mau", "segments", "segment")
"""Names of the tier that has the phonemes, in order of preference."""


def read_alignment(path: Path) -> list[TimedPhoneme]:
    """Phonemes in time from a TextGrid (``.TextGrid``), or a table as :func:`read_phonemes` reads it.

    Labels may be IPA, also with marks, or ARPAbet with or without digits of stress.

    Raises:
        FaceDiffError: if the file is neither, or holds no phonemes.
    """
    phonemes = _read_textgrid(path) if path.suffix.lower() == ".textgrid" else read_phonemes(path)
    return [replace(phoneme, ipa=_plain_label(phoneme.ipa)) for phoneme in phonemes]


def _plain_label(label: str) -> str:
    """A label as IPA as far as the lips' closing goes: p, b, m without marks, nothing for a pause."""
    label = label.strip()
    if label.lower() in SILENCES:
        return ""
    bare = label.strip(STRESS).rstrip("ʰʲʷˠ̩̚ːˑ0123456789")
    return bare.lower() if bare.lower() in BILABIALS else label


def _read_textgrid(path: Path) -> list[TimedPhoneme]:
    expected = "expected a TextGrid with an interval tier named phones, as Praat or an aligner writes it"
    try:
        LIMITS.check("bytes", 40 * path.stat().st_size, path)
        content = path.read_bytes()
        text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror or error}); {expected}") from error
    except UnicodeDecodeError as error:
        raise FaceDiffError(f"{path}: is no text; {expected}") from error
    # Long and short form hold the same values in the same order: texts in quotes, numbers that stand alone, and flags.
    # What the long form has around them, such as `xmin =` or `intervals [3]:`, is left out.
    tokens: list[str] = []
    for quoted_text, number in _TEXTGRID.findall(text):
        tokens.append(number or f'"{quoted_text.replace(chr(34) * 2, chr(34))}')
    try:
        if tokens[:2] != ['"ooTextFile', '"TextGrid']:
            raise ValueError("its head is another one")
        tiers = _tiers(tokens[4:])
    except (ValueError, IndexError) as error:
        raise FaceDiffError(f"{path}: not readable as a TextGrid ({error}); {expected}") from error
    for tier in TIERS:
        for name, intervals in tiers:
            # Several speakers have a tier each: "Anna - phones".
            if intervals and name.lower().split(" - ")[-1].strip() == tier:
                return intervals
    raise FaceDiffError(
        f"{path}: has no tier of phonemes but {', '.join(name for name, _ in tiers) or 'none'}; {expected}"
    )


def _tiers(tokens: list[str]) -> list[tuple[str, list[TimedPhoneme]]]:
    """The interval tiers of a TextGrid, from its values behind its times."""
    rest = iter(tokens)
    tiers = []
    for _ in range(int(float(next(rest, "0")))):
        kind, name = next(rest, ""), next(rest, "")
        next(rest, ""), next(rest, "")
        intervals = []
        for _ in range(int(float(next(rest, "0")))):
            start = float(next(rest, ""))
            if kind != '"IntervalTier':
                next(rest, "")
                continue
            end, label = float(next(rest, "")), next(rest, "")
            if not (0 <= start <= end < math.inf) or not label.startswith('"'):
                raise ValueError(f"an interval from {start:g} to {end:g} s")
            intervals.append(TimedPhoneme(start, end, label[1:]))
        tiers.append((name.removeprefix('"'), intervals))
    return tiers


_TEXTGRID = re.compile(r'"((?:[^"]|"")*)"|(?<![\w\[.-])(-?[0-9]+(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?)(?![\w\].])')
