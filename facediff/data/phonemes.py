"""When which phoneme is spoken in a clip, and when its lips close."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.utils.plain_files import read_rows

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
    expected = "expected a table with the columns start, end (seconds), ipa"
    try:
        found = [
            Phoneme(
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
    if not found or any(not (math.isfinite(p.end) and 0 <= p.start <= p.end) for p in found):
        raise FaceDiffError(f"{path}: expected phonemes whose start is not below 0 and not after their end")
    return found


def closures(phonemes: Iterable[Phoneme], frame_rate: float) -> list[tuple[int, int]]:
    """The frames in which the lips close for p, b and m, as `facediff.metrics.BilabialClosureRate` takes them.

    Args:
        phonemes: Of one clip.
        frame_rate: Frames per second of its motion.

    Returns:
        First frame and frame after the last of each closure, in order; at least one frame each. Closures that touch
        are one.

    Example:
        >>> closures([Phoneme(0.0, 0.1, "ˈm"), Phoneme(0.1, 0.3, "a"), Phoneme(0.3, 0.31, "b")], 25)
        [(0, 2), (8, 9)]
    """
    found: list[tuple[int, int]] = []
    for phoneme in sorted(phonemes, key=lambda each: each.start):
        if phoneme.ipa.strip(STRESS + LENGTH) not in BILABIALS:
            continue
        start = round(phoneme.start * frame_rate)
        end = max(start + 1, round(phoneme.end * frame_rate))
        if found and start <= found[-1][1]:
            found[-1] = (found[-1][0], max(end, found[-1][1]))
        else:
            found.append((start, end))
    return found
