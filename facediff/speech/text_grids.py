"""Alignments as Praat's TextGrids, which the usual aligners write: which phone is spoken when."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from facediff.errors import FaceDiffError

PHONES = ("phones", "phone", "phonemes", "phoneme", "mau", "segments", "segment")
WORDS = ("words", "word", "ort", "ort-mau")
"""How tiers of phones and of words are called, alone or after the speaker's name (``84 - phones``)."""

SILENCES = {"", "sil", "sp", "spn", "pau", "silence", "_", "<eps>", "<p>", "<p:>", "<p>:", "<sil>", "#"}
"""Labels of pauses."""

REMEDY = "align the recording again, with Praat or the Montreal Forced Aligner"
_TOKEN = re.compile(r'"((?:[^"]|"")*)"|(<exists>|<absent>)|(?<![^\s=])([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)(?!\S)')

Interval = tuple[float, float, str]


def phones_in(path: Path) -> list[Interval]:
    """The intervals of a TextGrid's tier of phones: start and end in seconds, and label."""
    tiers = read_text_grid(path)
    intervals = find_tier(tiers, PHONES)
    if not intervals:
        names = ", ".join(tiers) or "none"
        raise FaceDiffError(f"{path}: has no tier of phones (its tiers: {names}); name it phones, or {REMEDY}")
    return intervals


def find_tier(tiers: Mapping[str, list[Interval]], kinds: tuple[str, ...]) -> list[Interval] | None:
    """The first tier with intervals that is called so, alone or after a speaker's name; the first kind goes first."""
    own = {name.rpartition(" - ")[2].strip().lower(): tier for name, tier in reversed([*tiers.items()]) if tier}
    return next((own[kind] for kind in kinds if kind in own), None)


def read_text_grid(path: Path) -> dict[str, list[Interval]]:
    """Interval tiers of a TextGrid by name, in Praat's long or short text format: start and end in seconds, and text.

    Tiers of points are left out. The format is that of Praat's manual, "TextGrid file formats".
    """
    try:
        content = path.read_bytes()
        text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); {REMEDY}") from error
    except UnicodeDecodeError as error:
        raise FaceDiffError(f"{path}: is no text in UTF-8 or UTF-16; save it in Praat as a text file") from error
    # Both formats hold the same texts and numbers in the same order; the long one names each of them.
    tokens = iter(_TOKEN.finditer(text))
    tier = "its header"
    try:
        if (_text(tokens), _text(tokens)) != ("ooTextFile", "TextGrid"):
            raise FaceDiffError(f"{path}: is no TextGrid; expected a text file that Praat or an aligner has written")
        _number(tokens), _number(tokens), next(tokens)
        tiers: dict[str, list[Interval]] = {}
        for _ in range(int(_number(tokens))):
            kind, tier = _text(tokens), f"tier {_text(tokens)}"
            _number(tokens), _number(tokens)
            intervals = [_interval(tokens, kind) for _ in range(int(_number(tokens)))]
            if kind != "IntervalTier":
                continue
            edges = [edge for start, end, _ in intervals for edge in (start, end)]
            backwards = next((i for i in range(1, len(edges)) if edges[i] < edges[i - 1] - 1e-6), None)
            if backwards is not None or (edges and edges[0] < 0.0):
                where = edges[backwards or 0]
                raise FaceDiffError(f"{path}: {tier} goes back in time at {where:g} s; {REMEDY}")
            tiers.setdefault(tier.removeprefix("tier "), intervals)
    except (StopIteration, ValueError) as error:
        raise FaceDiffError(f"{path}: {tier} is cut short or damaged; {REMEDY}") from error
    return tiers


def _interval(tokens: Iterator[re.Match[str]], kind: str) -> Interval:
    start = _number(tokens)
    return start, _number(tokens) if kind == "IntervalTier" else start, _text(tokens).strip()


def _text(tokens: Iterator[re.Match[str]]) -> str:
    match = next(tokens)
    if match[1] is None:
        raise ValueError(match[0])
    return match[1].replace('""', '"')


def _number(tokens: Iterator[re.Match[str]]) -> float:
    match = next(tokens)
    if match[3] is None:
        raise ValueError(match[0])
    return float(match[3])
