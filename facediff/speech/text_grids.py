"""Alignments as Praat's TextGrids, which the usual aligners write: which phone is spoken when."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.utils.files import atomic
from facediff.utils.plain_files import decoded

PHONES = ("phones", "phone", "phonemes", "phoneme", "mau", "segments", "segment")
WORDS = ("words", "word", "ort", "ort-mau")
"""How tiers of phones and of words are called, alone or after the speaker's name (``84 - phones``)."""

SILENCES = {
    *("", "sil", "sp", "spn", "pau", "silence", "_", "<eps>", "<p>", "<p:>", "<p>:", "<sil>", "#", "h#", "epi"),
    *("nsn", "noise", "laugh"),
}
"""Labels of pauses."""

REMEDY = "align the recording again, with Praat or the Montreal Forced Aligner"
# Praat leaves out all else, and what stands between an exclamation mark and the end of its line.
_TOKEN = re.compile(
    r'![^\r\n]*|"((?:[^"]|"")*)"|(<exists>|<absent>)|(?<![^\s=])([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)(?!\S)'
)

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
    by_name = {name.rpartition(" - ")[2].strip().lower(): tier for name, tier in reversed([*tiers.items()]) if tier}
    return next((by_name[kind] for kind in kinds if kind in by_name), None)


def read_text_grid(path: Path) -> dict[str, list[Interval]]:
    """Interval tiers of a TextGrid by name, in Praat's long or short text format: start and end in seconds, and text.

    Tiers of points are left out. The format is from Praat's manual, "TextGrid file formats".
    """
    part, tiers = "its header", dict[str, list[Interval]]()
    try:
        # Both formats hold the same texts and numbers in the same order; the long one names each of them.
        tokens = (match for match in _TOKEN.finditer(_decoded(path.read_bytes())) if match.lastindex)
        kind, content = _text(tokens).split()[0], _text(tokens)
        if (kind, content) != ("ooTextFile", "TextGrid"):
            raise ValueError(kind)
        _number(tokens), _number(tokens), next(tokens)
        for _ in range(int(_number(tokens))):
            kind, part = _text(tokens), f"tier {_text(tokens)}"
            _number(tokens), _number(tokens)
            intervals = [_interval(tokens, kind) for _ in range(int(_number(tokens)))]
            if kind != "IntervalTier":
                continue
            edges = [0.0, *(edge for start, end, _ in intervals for edge in (start, end))]
            if not all(later >= edge - 1e-6 for edge, later in zip(edges, edges[1:], strict=False)):
                raise ValueError(edges)
            tiers.setdefault(part.removeprefix("tier "), intervals)
    # A text where a number belongs, none, one beyond all counts, or an end.
    except (OSError, StopIteration, ValueError, TypeError, AttributeError, LookupError, ArithmeticError) as error:
        raise FaceDiffError(
            f"{path}: {part} cannot be read, is cut short or goes back in time; expected a TextGrid in text format; "
            f"{REMEDY}"
        ) from error
    return tiers


def _decoded(content: bytes) -> str:
    """The text of a file: UTF-8 or UTF-16, and Latin-1 as Praat wrote it once."""
    try:
        return decoded(content)
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _interval(tokens: Iterator[re.Match[str]], kind: str) -> Interval:
    start = _number(tokens)
    return start, _number(tokens) if kind == "IntervalTier" else start, _text(tokens).strip()


def _text(tokens: Iterator[re.Match[str]]) -> str:
    return str(next(tokens)[1].replace('""', '"'))


def _number(tokens: Iterator[re.Match[str]]) -> float:
    return float(next(tokens)[3])


def write_text_grid(path: Path, tiers: Mapping[str, Sequence[Interval]], end: float) -> None:
    """Write interval tiers by name, in order of time, in Praat's long text format; gaps become empty intervals."""
    span = ["xmin = 0", f"xmax = {end:.4f}"]
    lines = ['File type = "ooTextFile"', 'Object class = "TextGrid"', "", *span]
    lines += ["tiers? <exists>", f"size = {len(tiers)}", "item []:"]
    for number, (name, intervals) in enumerate(tiers.items(), 1):
        filled: list[Interval] = []
        for start, stop, text in (*intervals, (end, end, "")):
            before = filled[-1][1] if filled else 0.0
            filled += [(before, start, "")] if start - before > 1e-4 else []
            filled += [(max(start, before), stop, text)] if stop - max(start, before) > 1e-4 else []
        lines += [f"item [{number}]:", 'class = "IntervalTier"', f'name = "{name}"', *span]
        lines += [f"intervals: size = {len(filled)}"]
        for index, (start, stop, text) in enumerate(filled, 1):
            quoted = text.replace('"', '""')
            lines += [f"intervals [{index}]:", f"xmin = {start:.4f}", f"xmax = {stop:.4f}", f'text = "{quoted}"']
    with atomic(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
