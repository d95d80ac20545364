"""Which prediction belongs to which truth, and what is left over on either side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.evaluate.names import Name

OWN, ALL = "own", "all"
"""Which conditions are scored: the subject's own identity, or the mean over all."""


@dataclass(frozen=True)
class Truth:
    """The truth of one clip.

    Attributes:
        path: its file.
        name: who says what.
    """

    path: Path
    name: Name


@dataclass(frozen=True)
class Pair:
    """A clip and the predictions that are scored on it.

    Attributes:
        clip: ``<subject>_<sentence>``.
        truth: its truth.
        predictions: files by identity; several only if the mean over conditions is asked for. The identity is "" where
            the file's name does not say it.
    """

    clip: str
    truth: Truth
    predictions: dict[str, Path]


@dataclass
class Pairing:
    """What one method has.

    Attributes:
        pairs: what can be scored, sorted by clip.
        without_truth: files of clips that have no truth.
        without_prediction: clips that have no prediction of the conditions asked for.
        unused: files of clips that have a truth, under conditions that were not asked for.
        unnamed: files whose names no pattern fits.
    """

    pairs: list[Pair] = field(default_factory=list)
    without_truth: list[str] = field(default_factory=list)
    without_prediction: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    unnamed: list[str] = field(default_factory=list)


def index_truths(names: Mapping[Path, Name]) -> dict[str, Truth]:
    """Truths by clip.

    Raises:
        FaceDiffError: if two files are of the same clip.
    """
    truths: dict[str, Truth] = {}
    for path, name in names.items():
        if name.clip in truths:
            raise FaceDiffError(
                f"{path}: is the truth of {name.clip}, as {truths[name.clip].path} is; keep one of them"
            )
        truths[name.clip] = Truth(path, name)
    return truths


def pair_up(predictions: Mapping[Path, Name], truths: Mapping[str, Truth], identity: str) -> Pairing:
    """Find each truth's predictions.

    Args:
        predictions: what the names of a method's files say.
        truths: truths by clip.
        identity: ``own``: the prediction conditioned on the subject itself, or else the one whose name has no
            condition; ``all``: every condition; or a condition's name.

    Raises:
        FaceDiffError: if two files are of the same clip and condition.
    """
    made = Pairing()
    by_clip: dict[str, dict[str, Path]] = {}
    own: dict[str, str] = {}
    for path, name in predictions.items():
        if name.clip not in truths:
            made.without_truth.append(path.name)
            continue
        conditions = by_clip.setdefault(name.clip, {})
        condition = name.identity or ""
        if condition in conditions:
            raise FaceDiffError(
                f"{path}: is the same clip and condition as {conditions[condition]}; keep one, or name files "
                f"apart with --pattern"
            )
        conditions[condition] = path
        if name.identity is not None and name.identity in (name.subject, truths[name.clip].name.subject):
            own[name.clip] = name.identity
    for clip, truth in sorted(truths.items()):
        there = by_clip.get(clip, {})
        chosen = _choose(there, own.get(clip, "") if identity == OWN else identity)
        made.unused += sorted(path.name for name, path in there.items() if name not in chosen)
        if chosen:
            made.pairs.append(Pair(clip, truth, {name: there[name] for name in chosen}))
        else:
            made.without_prediction.append(clip)
    return made


def _choose(there: Mapping[str, Path], wanted: str) -> list[str]:
    """The conditions to score of those that are there; "" stands for a name without a condition."""
    if wanted == ALL:
        return sorted(name for name in there if name) or list(there)
    return [wanted] if wanted in there else []
