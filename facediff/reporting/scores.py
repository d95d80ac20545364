"""One table of scores for evaluations and benchmarks: a row a clip, a column a metric or a training run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from facediff.reporting.statistics import Array, Bootstrap, Interval, pooled


@dataclass(frozen=True)
class ScoreMatrix:
    """Scores of clips, and their weights."""

    clips: tuple[str, ...]
    values: Array  # (clips, columns), 0 where there is none
    weights: Array  # (clips, columns): frames where all frames count alike, else 1; 0 where there is no value

    @classmethod
    def of(cls, clips: Sequence[str], values: Array, weights: Array) -> ScoreMatrix:
        """A table of values that are NaN where there is none."""
        lacking = np.isnan(values)
        return cls(tuple(clips), np.where(lacking, 0.0, values), np.where(lacking, 0.0, weights))

    def at(self, clips: Sequence[str]) -> ScoreMatrix:
        """The rows of some clips."""
        rows = [self.clips.index(clip) for clip in clips]
        return ScoreMatrix(tuple(clips), self.values[rows], self.weights[rows])

    def valued(self) -> list[str]:
        """Clips that have a value in some column."""
        return [self.clips[row] for row in np.flatnonzero((self.weights > 0).any(1))]

    def common(self, matrix: ScoreMatrix) -> tuple[ScoreMatrix, ScoreMatrix]:
        """Both tables with their common clips; a clip without a value in a column of one counts in neither."""
        clips = [clip for clip in self.clips if clip in set(matrix.clips)]
        one, two = self.at(clips), matrix.at(clips)
        valued = (one.weights > 0) & (two.weights > 0)
        return replace(one, weights=one.weights * valued), replace(two, weights=two.weights * valued)

    def pool(self) -> Array:
        """The score of each column; NaN where no clip has a value."""
        return pooled(self.values, self.weights)

    def resampled(self, bootstrap: Bootstrap) -> Array | None:
        """The scores of every resample of the clips (resamples, columns); see :meth:`Bootstrap.scores`."""
        return bootstrap.scores(self.values, self.weights)

    def intervals(self, bootstrap: Bootstrap) -> list[Interval | None]:
        """The interval of each column."""
        return bootstrap.intervals(self.resampled(bootstrap), self.values.shape[1])
