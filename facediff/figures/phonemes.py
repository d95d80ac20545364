"""When which phoneme is spoken in a clip."""

from __future__ import annotations

import csv
import math
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from facediff.errors import FaceDiffError, choices

STRESS, LENGTH = "ˈˌ", "ː"
BILABIALS = ("p", "b", "m")
"""Phonemes for which the lips close."""


@dataclass(frozen=True)
class Phoneme:
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


def read_phonemes(path: Path) -> list[Phoneme]:
    """Phonemes of a table with the columns ``start``, ``end`` (seconds) and ``ipa``, and maybe ``viseme``, ``word``.

    Raises:
        FaceDiffError: if the file is not that.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = list(csv.DictReader(stream))
        found = [
            Phoneme(float(row["start"]), float(row["end"]), row["ipa"] or "", row.get("viseme") or "", _word(row))
            for row in rows
        ]
    except (OSError, UnicodeDecodeError, csv.Error, KeyError, ValueError, TypeError) as error:
        raise FaceDiffError(
            f"{path}: not readable as phonemes ({error}); expected a table with the columns start, end (seconds), ipa"
        ) from error
    if not found or any(not (math.isfinite(p.end) and 0 <= p.start <= p.end) for p in found):
        raise FaceDiffError(f"{path}: expected phonemes whose start is not below 0 and not after their end")
    return found


def _word(row: dict[str, str]) -> str:
    return (row.get("word") or "").strip()


def find_phoneme(wanted: str, phonemes: Sequence[Phoneme], clip: str) -> Phoneme:
    """A phoneme by name: ``m`` is the first of the clip, ``m:2`` the second.

    A name that is in the clip to the letter goes first; else stress marks are passed over, then length marks and
    diacritics; else it is the name of a viseme, ``PP``.

    Raises:
        FaceDiffError: if the clip has no such phoneme, or not so many.
    """
    name, _, number = wanted.rpartition(":") if re.search(r".:\d+$", wanted) else (wanted, "", "1")
    place, spoken = int(number), [phoneme for phoneme in phonemes if phoneme.ipa]
    for same in (
        lambda p: p.ipa == name,
        lambda p: p.plain == name.strip(STRESS),
        lambda p: _bare(p.ipa) == _bare(name),
        lambda p: name in p.viseme.split("+"),
    ):
        found = [phoneme for phoneme in spoken if same(phoneme)]
        if found:
            if 1 <= place <= len(found):
                return found[place - 1]
            raise FaceDiffError(f'phoneme "{wanted}": clip {clip} has {name} {len(found)} times, counted from 1')
    known = dict.fromkeys(phoneme.plain for phoneme in spoken)
    raise FaceDiffError(f'phoneme "{wanted}": not spoken in clip {clip}: {choices(name, known)}')


def _bare(ipa: str) -> str:
    """Without stress, length and diacritics."""
    letters = unicodedata.normalize("NFD", ipa)
    return "".join(letter for letter in letters if letter not in STRESS + LENGTH and not unicodedata.combining(letter))
