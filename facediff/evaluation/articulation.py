"""Articulation of several speakers: means and intervals over them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import astuple, fields

import numpy as np

from facediff.data.articulation import ArticulationScores, MouthMotion, articulation
from facediff.reporting.statistics import Bootstrap, Interval, pooled


def by_speaker(recordings: Mapping[str, Sequence[MouthMotion]]) -> dict[str, tuple[float, Interval | None]]:
    """Mean over speakers and 95 % interval of each score that any of them has; no interval of a single speaker."""
    values = np.array([astuple(articulation(each)) for each in recordings.values()])
    weights = np.isfinite(values).astype(np.float64)
    values = np.nan_to_num(values)
    intervals = Bootstrap().intervals(Bootstrap().scores(values, weights), values.shape[1])
    means = zip(fields(ArticulationScores), pooled(values, weights).tolist(), intervals, strict=True)
    return {field.name: (mean, interval) for field, mean, interval in means if not math.isnan(mean)}
