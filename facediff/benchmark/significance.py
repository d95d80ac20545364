"""Intervals and tests of differences between two rows, for both sources of chance: sentences and training runs.

A score depends on which sentences were recorded, and on which numbers the training happened to draw. A bootstrap or a
permutation over sentences knows nothing of the second, and the spread over seeds nothing of the first. Where both act,
their variances add up: a test by one of them alone, or by the less significant of the two, calls too many differences
significant. The p-value is therefore of Student's t with the sum of the variances and Satterthwaite's (1946) degrees of
freedom.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facediff.reporting.scores import ScoreMatrix
from facediff.reporting.statistics import Array, Bootstrap, Interval, holm, sign_flip


@dataclass(frozen=True)
class RowScores:
    """One score of one row."""

    runs: Array  # the score of each training run (runs,)
    # A row a sentence, a column a training run; None if the score is no mean over sentences
    table: ScoreMatrix | None = None
    fixed: bool = False  # whether nothing was trained, so that there is no chance between runs

    @property
    def mean(self) -> float:
        """Mean over the runs."""
        return float(self.runs.mean())

    @property
    def deviation(self) -> float | None:
        """Standard deviation between the runs (n − 1); None with a single one."""
        return float(self.runs.std(ddof=1)) if len(self.runs) > 1 else None

    @property
    def clips(self) -> tuple[str, ...]:
        """Names of the sentences."""
        return () if self.table is None else self.table.clips

    def interval(self, bootstrap: Bootstrap) -> Interval | None:
        """Bootstrap interval over sentences of the mean over the runs."""
        resampled = None if self.table is None else mean_resampled(self.table, bootstrap)
        return None if resampled is None else bootstrap.intervals(resampled[:, None], 1)[0]


def mean_resampled(table: ScoreMatrix, bootstrap: Bootstrap) -> Array | None:
    """The mean over the runs of every resample of the sentences."""
    scores = table.resampled(bootstrap)
    return None if scores is None else np.asarray(scores.mean(1))


def shares(table: ScoreMatrix) -> Array:
    """The part of each sentence in the mean over the runs; their sum is the score over these sentences."""
    return np.asarray((table.values * table.weights / table.weights.sum(0)).mean(1))


@dataclass(frozen=True)
class Difference:
    """One row's score minus another's."""

    value: float  # the difference of the means over runs, over the sentences of which both have a value
    sentences: Interval | None  # bootstrap interval over sentences; None if there is none
    p_sentences: float | None  # of the permutation test over sentences; None if the score is no mean over sentences
    runs: Interval | None  # interval over training runs (Welch); None if the chance between runs is not known
    p_runs: float | None  # of Welch's test; None as for ``runs``
    # Interval over sentences and training runs together; None if the chance between runs is not known
    total: Interval | None
    p: float | None  # of the test with both chances; None as for ``total``, and where the score has no chance
    common: int  # sentences with a value in both rows


def difference(one: RowScores, baseline: RowScores, bootstrap: Bootstrap) -> Difference:
    """Compare two rows by one score; the permutations have the bootstrap's seed."""
    p_runs, runs = welch(one, baseline, bootstrap.level)
    tables = in_both(one, baseline)
    if tables is None:
        # Training runs are the only chance, unless nothing was trained.
        only_runs = one.table is None and baseline.table is None and not (one.fixed and baseline.fixed)
        p, total = (p_runs, runs) if only_runs else (None, None)
        return Difference(one.mean - baseline.mean, None, None, runs, p_runs, total, p, 0)
    gaps = shares(tables[0]) - shares(tables[1])
    p_sentences = sign_flip(gaps[~np.isnan(gaps)], seed=bootstrap.seed)
    mine, yours = (mean_resampled(table, bootstrap) for table in tables)
    interval = None if mine is None or yours is None else bootstrap.intervals((mine - yours)[:, None], 1)[0]
    trained = [scores.runs for scores in (one, baseline) if not scores.fixed]
    p, total = both_chances(gaps[~np.isnan(gaps)], trained, bootstrap.level)
    common = len(tables[0].clips)
    return Difference(float(gaps.sum()), interval, p_sentences, runs, p_runs, total, p, common)


def in_both(one: RowScores, two: RowScores) -> tuple[ScoreMatrix, ScoreMatrix] | None:
    """The scores of the sentences with a value in both rows in some run; None if there are none."""
    if one.table is None or two.table is None:
        return None
    # A sentence of a single row would count as a gap as large as that row's score.
    common = set(two.table.valued())
    clips = [clip for clip in one.table.valued() if clip in common]
    return (one.table.at(clips), two.table.at(clips)) if clips else None


def both_chances(gaps: Array, runs: Sequence[Array], level: float = 0.95) -> tuple[float | None, Interval | None]:
    """Student's t-test of a difference by which both sentences and training runs are chance, and its interval.

    The common part of a run and a sentence is in both variances, so the test errs on the safe side.

    ``gaps`` are the contributions of sentences to the difference (sentences,), ``runs`` the score of each training run
    (runs,), for each of the rows that were trained. None with a single sentence, or where such a row has a single run.
    """
    from scipy.stats import t as student

    if len(gaps) < 2 or any(len(scores) < 2 for scores in runs):
        return None, None
    # The difference is a sum over sentences, hence the factor; a row's score is a mean over runs.
    variances = np.array([len(gaps) * gaps.var(ddof=1), *(scores.var(ddof=1) / len(scores) for scores in runs)])
    freedoms = np.array([len(gaps) - 1, *(len(scores) - 1 for scores in runs)])
    gap, variance = float(gaps.sum()), float(variances.sum())
    if variance == 0:
        return (0.0 if gap else 1.0), Interval(gap, gap)
    freedom, error = variance**2 / (variances**2 / freedoms).sum(), float(np.sqrt(variance))
    reach = error * float(student.ppf((1 + level) / 2, freedom))
    return 2 * float(student.sf(abs(gap) / error, freedom)), Interval(gap - reach, gap + reach)


def welch(one: RowScores, two: RowScores, level: float = 0.95) -> tuple[float | None, Interval | None]:
    """Welch's t-test between the training runs of two rows, and its interval of the difference.

    A row that was not trained has one value without chance, against which the other's runs are tested. Where both are
    such, nothing is by chance of training.

    Returns:
        p-value and interval; None where a row that was trained has a single run.
    """
    from scipy.stats import ttest_1samp, ttest_ind

    trained = [scores.runs for scores in (one, two) if not scores.fixed]
    if any(len(runs) < 2 for runs in trained):
        return None, None
    gap = one.mean - two.mean
    if all(np.ptp(runs) == 0 for runs in trained):
        return (0.0 if gap else 1.0), Interval(gap, gap)
    if len(trained) == 2:
        test = ttest_ind(one.runs, two.runs, equal_var=False)
    else:
        test = ttest_1samp(one.runs - two.mean if two.fixed else one.mean - two.runs, 0)
    return float(test.pvalue), Interval(*map(float, test.confidence_interval(level)))


def compared(
    rows: Mapping[str, RowScores], baseline: str, bootstrap: Bootstrap, references: Container[str] = ()
) -> dict[str, tuple[Difference, float | None]]:
    """Every row against one, with p-values corrected for the number of rows: one family for each score and split.

    Reference rows are not in the family, since they would cost power; their p-values are not corrected.
    """
    differences = {
        name: difference(scores, rows[baseline], bootstrap) for name, scores in rows.items() if name != baseline
    }
    tested = {name: comparison.p for name, comparison in differences.items() if comparison.p is not None}
    family = [name for name in tested if name not in references]
    adjusted = tested | dict(zip(family, holm([tested[name] for name in family]), strict=True))
    return {name: (comparison, adjusted.get(name)) for name, comparison in differences.items()}


def follows_speech(scores: RowScores, shuffled: RowScores, sign: int, bootstrap: Bootstrap) -> bool:
    """Whether a method's score is significantly better with the sentence's speech than with another sentence's.

    Both are of the same training runs, so that runs are paired. With one run alone, sentences decide.
    ``sign`` is 1 where lower is better, −1 where higher is.
    """
    gap = sign * (shuffled.mean - scores.mean)
    tables = in_both(scores, shuffled)
    if gap <= 0 or tables is None:
        return gap > 0
    gaps = shares(tables[1]) - shares(tables[0])
    gaps = gaps[~np.isnan(gaps)]
    p, _ = both_chances(gaps, [scores.runs - shuffled.runs], bootstrap.level)
    return (sign_flip(gaps, seed=bootstrap.seed) if p is None else p) < 1 - bootstrap.level


def marked(rows: Mapping[str, RowScores], better: str | None, bootstrap: Bootstrap) -> dict[str, str]:
    """Which rows are ``best`` and ``second``, each only where its difference from every row behind it is significant.

    Without a direction that is the better one (``lower``, ``higher``) nothing is marked.
    """
    if better not in ("lower", "higher") or len(rows) < 2:
        return {}
    sign = 1 if better == "lower" else -1
    order = sorted(rows, key=lambda name: (sign * rows[name].mean, name))
    marks: dict[str, str] = {}
    for rank, mark in enumerate(("best", "second")):
        behind = order[rank + 1 :]
        if not behind:
            break
        leader = rows[order[rank]]
        values = [difference(leader, rows[name], bootstrap).p for name in behind]
        tested = [value for value in values if value is not None]
        if len(tested) < len(values) or max(holm(tested)) >= 1 - bootstrap.level:
            break
        marks[order[rank]] = mark
    return marks
