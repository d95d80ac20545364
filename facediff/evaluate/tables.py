"""The values of all clips of a method, and what becomes of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from facediff.errors import FaceDiffError
from facediff.evaluate.pairs import Pair, Pairing
from facediff.evaluate.report import Comparison, MethodResult, Missing, Score, SequenceScores
from facediff.evaluate.scoring import ClipScores, Column
from facediff.evaluate.statistics import Array, Bootstrap, pooled


class MethodTable:
    """One method's values: a row a clip, sorted by clip, so that no order of files or workers changes a digit.

    Args:
        name: what the method is called.
        folder: where its files lie.
        pairing: what it has, and what not.
        found: scores by clip, or in words why there are none.
        columns: what the values are.

    Raises:
        FaceDiffError: if nothing can be scored.
    """

    def __init__(
        self,
        name: str,
        folder: str,
        pairing: Pairing,
        found: Mapping[str, ClipScores | str],
        columns: Sequence[Column],
    ) -> None:
        self.name = name
        self.folder = folder
        self.columns = columns
        self.missing = Missing(
            pairing.without_truth,
            pairing.without_prediction,
            pairing.unused,
            pairing.unnamed,
            {clip: reason for clip, reason in sorted(found.items()) if isinstance(reason, str)},
        )
        self.rows: list[tuple[Pair, ClipScores]] = []
        for pair in pairing.pairs:
            scores = found[pair.clip]
            if isinstance(scores, ClipScores):
                self.rows.append((pair, scores))
        if not self.rows:
            raise FaceDiffError(f"{folder}: {_why_nothing(self.missing)}")
        self.clips = [pair.clip for pair, _ in self.rows]
        self.values: Array = np.array([scores.values for _, scores in self.rows])
        by_frames = np.array([column.pooling == "frames" for column in columns])
        self.weights: Array = np.where(by_frames, np.array([scores.weights for _, scores in self.rows]), 1.0)

    def result(self, bootstrap: Bootstrap) -> MethodResult:
        """The scores with their intervals, and the values of each clip."""
        totals = pooled(self.values, self.weights)
        intervals = bootstrap.intervals(bootstrap.scores(self.values, self.weights), len(self.columns))
        frames = sum(scores.frames for _, scores in self.rows)
        return MethodResult(
            self.name,
            self.folder,
            [
                Score(column.protocol, column.metric, float(total), interval, frames, len(self.rows))
                for column, total, interval in zip(self.columns, totals, intervals, strict=True)
            ],
            [self._sequence(pair, scores) for pair, scores in self.rows],
            self.missing,
        )

    def _sequence(self, pair: Pair, scores: ClipScores) -> SequenceScores:
        return SequenceScores(
            self.name,
            pair.clip,
            pair.truth.name.subject,
            pair.truth.name.sentence,
            tuple(pair.predictions),
            scores.frames,
            scores.cut_prediction,
            scores.cut_truth,
            {column.name: value for column, value in zip(self.columns, scores.values, strict=True)},
        )

    def compare(self, baseline: MethodTable, bootstrap: Bootstrap) -> list[Comparison]:
        """This method's scores minus another's, over the clips that both have and over the same resamples.

        Empty if they share no clip.
        """
        common = sorted(set(self.clips) & set(baseline.clips))
        if not common:
            return []
        ours, theirs = (table.places(common) for table in (self, baseline))
        a = self.values[ours], self.weights[ours]
        b = baseline.values[theirs], baseline.weights[theirs]
        mine, other = bootstrap.scores(*a), bootstrap.scores(*b)
        spread = None if mine is None or other is None else mine - other
        return [
            Comparison(
                self.name, baseline.name, column.protocol, column.metric, float(difference), interval, len(common)
            )
            for column, difference, interval in zip(
                self.columns, pooled(*a) - pooled(*b), bootstrap.intervals(spread, len(self.columns)), strict=True
            )
        ]

    def places(self, clips: Sequence[str]) -> list[int]:
        """The rows of some clips."""
        place = {clip: row for row, clip in enumerate(self.clips)}
        return [place[clip] for clip in clips]


def _why_nothing(missing: Missing) -> str:
    """One sentence for a method of which nothing can be scored: the first thing that stands in the way."""
    if missing.unusable:
        clip, reason = next(iter(missing.unusable.items()))
        return f"nothing can be scored; of {clip}: {reason}"
    if missing.unused:
        return (
            f"no prediction has the condition asked for, but {missing.unused[0]} is there; choose --identity all or "
            f"an identity's name"
        )
    if missing.without_truth:
        return f"no prediction has a truth, {missing.without_truth[0]} for one; check --truth-pattern and the folders"
    example = missing.unnamed[0] if missing.unnamed else "no file"
    return f"no file's name is understood, {example} for one; say with --pattern how files are named"
