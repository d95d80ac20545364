"""The statistics of benchmarks against SciPy, against formulas, and on tables of pure noise."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pytest
import scipy.stats

from facediff.benchmark.significance import RowScores, both_chances, compared, difference, marked, welch
from facediff.reporting.scores import ScoreMatrix
from facediff.reporting.statistics import Bootstrap, holm, sign_flip

BOOTSTRAP = Bootstrap(2000, 0.95, 0)


def scores(
    values: np.ndarray, weights: np.ndarray | None = None, *, fixed: bool = False, clips: Sequence[str] = ()
) -> RowScores:
    """Scores of a row from values (runs, sentences)."""
    weights = np.ones(values.shape[1]) if weights is None else weights
    table = ScoreMatrix.of(
        clips or [*map(str, range(len(weights)))], values.T, np.repeat(weights[:, None], len(values), 1)
    )
    return RowScores(table.pool(), table, fixed)


def table(rows: int, rng: np.random.Generator, *, runs: int = 3, sentences: int = 12) -> dict[str, RowScores]:
    """Rows without any difference but chance: of sentences, of runs, and of both together."""
    difficulty = rng.normal(0, 1, sentences)
    return {
        str(row): scores(difficulty + rng.normal(0, 0.2, (runs, 1)) + rng.normal(0, 0.3, (runs, sentences)))
        for row in range(rows)
    }


def test_welch_is_scipys() -> None:
    rng = np.random.default_rng(0)
    for runs in (2, 3, 7):
        one, other = (scores(rng.normal(level, 1, (runs + place, 5))) for place, level in enumerate((0.0, 1.5)))
        p, interval = welch(one, other)
        wanted = scipy.stats.ttest_ind(one.runs, other.runs, equal_var=False)
        assert p == pytest.approx(wanted.pvalue, rel=1e-9)
        low, high = wanted.confidence_interval(0.95)
        assert interval is not None
        assert (interval.low, interval.high) == pytest.approx((low, high), rel=1e-9)


def test_a_row_without_training_is_a_constant() -> None:
    rng = np.random.default_rng(1)
    one = scores(rng.normal(0, 1, (4, 6)))
    still = scores(np.full((1, 6), 0.7), fixed=True)
    assert welch(one, still)[0] == pytest.approx(scipy.stats.ttest_1samp(one.runs, 0.7).pvalue, rel=1e-9)
    assert welch(still, scores(np.full((1, 6), 0.5), fixed=True))[0] == 0.0
    assert welch(one, scores(rng.normal(0, 1, (1, 6)))) == (None, None)


def test_of_two_rows_without_training_a_score_that_is_no_mean_has_no_p() -> None:
    """Nothing of it is by chance; against a row that was trained, its runs are."""
    still, other = (RowScores(np.array([value]), fixed=True) for value in (0.7, 0.5))
    trained = RowScores(np.array([0.6, 0.4, 0.5]))
    gap = difference(still, other, BOOTSTRAP)
    assert (gap.value, gap.p, gap.total) == (pytest.approx(0.2), None, None)
    assert difference(trained, still, BOOTSTRAP).p == welch(trained, still)[0]


@pytest.mark.parametrize("sentences", [5, 9])
def test_the_permutation_test_is_scipys(sentences: int) -> None:
    differences = np.random.default_rng(sentences).normal(0.4, 1, sentences)
    wanted = scipy.stats.permutation_test(
        (differences, np.zeros(sentences)), lambda x, y, axis: (x - y).sum(axis), permutation_type="samples",
        vectorized=True, n_resamples=np.inf,
    )  # fmt: skip
    assert sign_flip(differences) == pytest.approx(wanted.pvalue, abs=1e-12)


def test_holm_is_closed_testing_by_bonferroni() -> None:
    """A hypothesis is rejected if every intersection that holds it is: that is what the step-down shortcut computes."""
    values = [0.012, 0.2, 0.03, 0.012, 0.9]
    wanted = []
    for place in range(len(values)):
        groups = [g for size in range(1, 6) for g in combinations(range(5), size) if place in g]
        wanted.append(max(min(1.0, len(g) * min(values[i] for i in g)) for g in groups))
    assert holm(values) == pytest.approx(wanted)
    assert holm([]) == []


def test_the_interval_over_sentences_is_scipys() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(2, 1, (3, 30))
    found = scores(values).interval(BOOTSTRAP)
    wanted = scipy.stats.bootstrap(
        (values.mean(0),), np.mean, method="percentile", n_resamples=20_000, rng=np.random.default_rng(1)
    ).confidence_interval
    assert found is not None
    assert (found.low, found.high) == pytest.approx((wanted.low, wanted.high), abs=0.03)


def test_a_difference_is_that_of_the_pooled_scores_over_common_sentences() -> None:
    rng = np.random.default_rng(4)
    frames = rng.integers(10, 90, 12).astype(float)
    first, second = (rng.normal(0, 1, (2, 12)) for _ in range(2))
    one, other = scores(first, frames), scores(second, frames)
    found = difference(one, other, BOOTSTRAP)
    assert found.value == pytest.approx(one.mean - other.mean)
    assert found.p == scipy_both(first, second, frames)
    assert found.total is not None
    means = [np.average(values, axis=1, weights=frames).mean() for values in (first, second)]
    assert found.total.low < means[0] - means[1] < found.total.high
    less = difference(one, scores(second[:, 3:], frames[3:], clips=[*map(str, range(3, 12))]), BOOTSTRAP)
    assert less.common == 9
    mine, theirs = (np.average(values[:, 3:], axis=1, weights=frames[3:]).mean() for values in (first, second))
    assert less.value == pytest.approx(mine - theirs)


def test_a_sentence_without_a_value_in_a_run_does_not_count_there() -> None:
    """As zero it would pull that run's mean, and with it the difference, towards zero."""
    rng = np.random.default_rng(6)
    frames = rng.integers(10, 90, 12).astype(float)
    values, others = 5 + rng.normal(0, 1, (2, 12)), 4 + rng.normal(0, 1, (2, 12))
    values[1, 3] = np.nan
    kept = np.isfinite(values[1])
    means = [np.average(values[0], weights=frames), np.average(values[1, kept], weights=frames[kept])]
    one = scores(values, frames)
    np.testing.assert_allclose(one.runs, means)
    gap = difference(one, scores(others, frames), BOOTSTRAP)
    expected = np.mean(means) - np.average(others, axis=1, weights=frames).mean()
    assert gap.value == pytest.approx(expected)
    assert gap.sentences is not None
    assert gap.sentences.low < expected < gap.sentences.high


def test_a_sentence_that_one_row_has_no_value_of_is_not_compared() -> None:
    """As zero it would be a gap as large as the other row's score."""
    rng = np.random.default_rng(7)
    frames = rng.integers(10, 90, 12).astype(float)
    values, others = 5 + rng.normal(0, 1, (2, 12)), 5 + rng.normal(0, 1, (2, 12))
    lacking = values.copy()
    lacking[:, 3] = np.nan
    kept = np.arange(12) != 3
    names = [*map(str, np.flatnonzero(kept))]
    expected = difference(*(scores(side[:, kept], frames[kept], clips=names) for side in (values, others)), BOOTSTRAP)
    gap = difference(scores(lacking, frames), scores(others, frames), BOOTSTRAP)
    assert (gap.value, gap.p_sentences, gap.common) == (expected.value, expected.p_sentences, 11)
    assert gap.sentences == expected.sentences


def scipy_both(one: np.ndarray, other: np.ndarray, frames: np.ndarray) -> object:
    """p of a difference with the variances of sentences and of both rows' runs, from SciPy's distributions."""
    weights = frames / frames.sum()
    gaps = weights * (one.mean(0) - other.mean(0))
    runs = [(values * weights).sum(1) for values in (one, other)]
    parts = [(len(gaps) ** 2 * scipy.stats.sem(gaps) ** 2, len(gaps) - 1)]
    parts += [(scipy.stats.sem(scores) ** 2, len(scores) - 1) for scores in runs]
    total = sum(variance for variance, _ in parts)
    freedom = total**2 / sum(variance**2 / count for variance, count in parts)
    return pytest.approx(2 * scipy.stats.t.sf(abs(gaps.sum()) / np.sqrt(total), freedom))


@pytest.mark.parametrize("runs", [3, 5, 10])
@pytest.mark.slow
def test_false_positives_stay_at_five_per_cent_where_both_chances_act(runs: int) -> None:
    """Of two equal methods, whatever share of the variance is that of sentences; the larger p-value gave 10 %."""
    rng, count = np.random.default_rng(runs), 700
    for share in (0.3, 1.0, 3.0):  # variance of the mean over runs, by that over sentences
        wrong = 0
        for _ in range(count):
            sentences = rng.normal(0, 1, 30)
            trained = [rng.normal(0, np.sqrt(share * runs / 60), runs) for _ in range(2)]
            p, _ = both_chances((sentences + trained[0].mean() - trained[1].mean()) / 30, trained)
            wrong += p is not None and p < 0.05
        assert wrong <= scipy.stats.binom.ppf(0.999, count, 0.05), share


def test_references_cost_the_methods_no_power() -> None:
    rng = np.random.default_rng(8)
    rows = table(4, rng)
    everyone, methods = compared(rows, "0", BOOTSTRAP), compared(rows, "0", BOOTSTRAP, {"3"})
    plain = {name: comparison.p for name, (comparison, _) in everyone.items()}
    assert {name: p for name, (_, p) in methods.items() if name != "3"} == dict(
        zip(("1", "2"), holm([plain["1"], plain["2"]]), strict=True)  # type: ignore[list-item]
    )
    assert methods["3"][1] == plain["3"]


@pytest.mark.slow
def test_tables_of_noise_mark_nothing_as_best() -> None:
    """In at most 5 % of them, up to the chance of 150 tables; sentences alone would mark far more."""
    rng = np.random.default_rng(5)
    quick = Bootstrap(0)
    tables = [table(5, rng) for _ in range(150)]
    wrong = sum(bool(marked(rows, "lower", quick)) for rows in tables)
    starred = sum(any(p is not None and p < 0.05 for _, p in compared(rows, "0", quick).values()) for rows in tables)
    limit = scipy.stats.binom.ppf(0.999, 150, 0.05)
    assert wrong <= limit
    assert starred <= limit
    by_sentences = sum(difference(rows["0"], rows["1"], quick).p_sentences < 0.05 for rows in tables)  # type: ignore[operator]
    assert by_sentences > 3 * limit  # what a star that knows nothing of training runs would do


def test_a_true_difference_is_found_and_second_needs_best() -> None:
    rng = np.random.default_rng(6)
    difficulty = rng.normal(0, 1, 30)
    rows = {
        name: scores(difficulty + level + rng.normal(0, 0.02, (4, 1)) + rng.normal(0, 0.1, (4, 30)))
        for name, level in (("a", 0.0), ("b", 0.5), ("c", 1.0), ("d", 1.0))
    }
    assert marked(rows, "lower", BOOTSTRAP) == {"a": "best", "b": "second"}
    assert marked(rows, "higher", BOOTSTRAP) == {}  # c and d are alike
    assert marked(rows, None, BOOTSTRAP) == {}
    assert marked(rows, "zero", BOOTSTRAP) == {}


def test_one_training_run_is_never_best() -> None:
    rng = np.random.default_rng(7)
    rows = {"a": scores(rng.normal(0, 0.1, (1, 30))), "b": scores(rng.normal(5, 0.1, (3, 30)))}
    found = difference(rows["a"], rows["b"], BOOTSTRAP)
    assert found.p is None
    assert found.p_sentences is not None
    assert found.p_sentences < 0.01
    assert marked(rows, "lower", BOOTSTRAP) == {}
