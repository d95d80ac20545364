"""When which phoneme is spoken in a clip, and when its lips close."""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from facediff.errors import counted, damaged, note
from facediff.speech.text_grids import SILENCES, phones_in
from facediff.utils.paths import find_file
from facediff.utils.plain_files import read_rows

STRESS = "ˈˌ"


@dataclass(frozen=True)
class TimedPhoneme:
    """A phoneme from a start to an end in seconds.

    Attributes:
        ipa: with stress and length marks; empty for a pause.
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


def phonemes_text(phonemes: Iterable[TimedPhoneme]) -> str:
    """Phonemes as JSON: rows of start and end in seconds, the phoneme, and its word."""
    rows = [[round(sound.start, 3), round(sound.end, 3), sound.ipa, sound.word] for sound in phonemes]
    return json.dumps(rows, ensure_ascii=False)


def phonemes_file(corpus: Path | None, clip: str) -> Path | None:
    """Where a corpus has a clip's phonemes; None if it has none."""
    path = None if corpus is None else find_file(corpus / "phonemes" / f"{clip}.csv")
    return path if path is not None and path.is_file() else None


def read_phonemes(path: Path) -> list[TimedPhoneme]:
    """Phonemes of a table with the columns ``start``, ``end`` (seconds) and ``ipa``, and maybe ``viseme``, ``word``."""
    expected = "expected a table with the columns start, end (seconds), ipa"
    with damaged(path, expected):
        phonemes = [
            TimedPhoneme(
                float(row["start"]),
                float(row["end"]),
                row["ipa"],
                row.get("viseme", ""),
                row.get("word", "").strip(),
            )
            for row in read_rows(path, ("start", "end", "ipa", "viseme", "word"), remedy=expected)
        ]
        if not phonemes or any(not (math.isfinite(p.end) and 0 <= p.start <= p.end) for p in phonemes):
            raise ValueError("has no phonemes, or one that starts below 0 or after its end")
    return phonemes


def closed_times(phonemes: Sequence[TimedPhoneme]) -> list[tuple[float, float]]:
    """Start and end, in seconds, of each p, b and m, in order; labels are as :func:`closing` takes them."""
    closed = closing([phoneme.ipa for phoneme in phonemes])
    return sorted(
        (phoneme.start, phoneme.end) for phoneme, closes in zip(phonemes, closed, strict=True) if closes is not None
    )


def closing(labels: Sequence[str]) -> list[str | None]:
    """The p, b or m for which the lips close at each label of a tier; None where they do not.

    Labels may be in the IPA with diacritics and ties, in X-SAMPA, or in the ARPAbet as Kaldi, the Montreal Forced
    Aligner, TIMIT and Buckeye write it: with stress, with places in the word, closures as labels of their own. In
    X-SAMPA capital letters are other sounds, in the ARPAbet they are the same.
    """
    plain = [_PLACE.sub("", label.strip().strip(_MARKS)) for label in labels]
    sounds = [label for label in plain if label.lower() not in SILENCES]
    is_arpabet = any(_VOWEL.fullmatch(label) for label in sounds) or not any(
        character.islower() for label in sounds for character in label
    )
    return [_closing(label.lower() if is_arpabet else label) for label in plain]


_PLACE = re.compile(r"_[BIES]$")  # in the word, of Kaldi's phones
_VOWEL = re.compile(r"[A-Z]{2}[012]")  # a vowel of the ARPAbet
_MARKS = f"/[](){{}}\"%'{STRESS}"  # brackets, and stress in the IPA and X-SAMPA
_DIACRITICS = re.compile(r"_[^pb]|[_=~:'`^<>?0-9-]")  # of X-SAMPA; k_p is tied
_OTHER_NAMES = {"pcl": "p", "bcl": "b", "em": "m", "ɓ": "b", "ʙ": "b", "ʘ": "p", "b_<": "b", "B\\": "b"}
"""Closures and a syllable of TIMIT; implosive, trill and click of the IPA, and some of them in X-SAMPA."""
_LETTERS = re.compile("([pbm])[hjwy]?|([pb])[fvs]|[kgɡNŋ]([pbm])|m([pb])")
"""Aspirated and palatalised ones, affricates, and what is said at two places at once."""


def _closing(label: str) -> str | None:
    """The p, b or m of a label without stress."""
    letters = "".join(
        c for c in unicodedata.normalize("NFD", label) if unicodedata.category(c) not in ("Mn", "Lm", "Sk")
    )
    letters = _OTHER_NAMES.get(letters, _DIACRITICS.sub("", letters))
    match = _LETTERS.fullmatch(_OTHER_NAMES.get(letters, letters))
    return next(filter(None, match.groups())) if match else None


def closures(phonemes: Sequence[TimedPhoneme], frame_rate: float) -> list[tuple[int, int]]:
    """The first frame and the frame after the last of each closure for p, b and m; closures that touch are one."""
    frames: list[tuple[int, int]] = []
    for opens, closes in closed_times(phonemes):
        start = round(opens * frame_rate)
        end = max(start + 1, round(closes * frame_rate))
        if frames and start <= frames[-1][1]:
            frames[-1] = (frames[-1][0], max(end, frames[-1][1]))
        else:
            frames.append((start, end))
    return frames


def read_alignment(path: Path) -> list[TimedPhoneme]:
    """Phonemes in time from a TextGrid (``.TextGrid``), or a table as :func:`read_phonemes` reads it.

    A note says how many labels close the lips; those are p, b or m here, and pauses are empty.
    """
    if path.suffix.lower() == ".textgrid":
        phonemes = [TimedPhoneme(start, end, label) for start, end, label in phones_in(path)]
    else:
        phonemes = read_phonemes(path)
    labels = ["" if phoneme.ipa.strip().lower() in SILENCES else phoneme.ipa.strip() for phoneme in phonemes]
    closed = closing(labels)
    count, total = sum(name is not None for name in closed), sum(map(bool, labels))
    remedy = "" if count else "; expected p, b and m of the IPA, X-SAMPA or the ARPAbet"
    note(f"{path}: {count} of {counted(total, 'label')} close the lips{remedy}")
    return [replace(phoneme, ipa=name or label) for phoneme, name, label in zip(phonemes, closed, labels, strict=True)]
