from __future__ import annotations

import numpy as np
import pytest

from facediff.reporting.statistics import BLOCK, Bootstrap, draws, pooled
from tests.evaluation.conftest import LENGTHS, OF_VERTICES, Files, scores_of


def test_resamples_are_drawn_with_replacement_by_the_seed() -> None:
    counts = np.concatenate(list(draws(6, 500, 3)))
    assert counts.shape == (500, 6)
    assert (counts.sum(1) == 6).all()
    assert abs(counts.mean() - 1) < 1e-12
    assert abs((counts == 0).mean() - (5 / 6) ** 6) < 0.03
    assert np.array_equal(counts, np.concatenate(list(draws(6, 500, 3))))
    assert not np.array_equal(counts, np.concatenate(list(draws(6, 500, 4))))
    blocks = list(draws(BLOCK // 2, 5, 0))
    assert [len(block) for block in blocks] == [2, 2, 1]


def test_a_score_of_a_resample_is_the_pooled_score_of_the_drawn_sequences() -> None:
    rng = np.random.default_rng(0)
    values, weights = rng.random((5, 3)), rng.integers(1, 9, (5, 3)).astype(float)
    scores = Bootstrap(20, seed=1).scores(values, weights)
    assert scores is not None
    for counts, score in zip(next(draws(5, 20, 1)), scores, strict=True):
        drawn = np.repeat(np.arange(5), counts.astype(int))
        assert score == pytest.approx(pooled(values[drawn], weights[drawn]), rel=1e-12)


def test_intervals_cover_about_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    hits = 0
    for seed in range(200):
        values = rng.exponential(1.0, (40, 1))
        found = Bootstrap(200, 0.9, seed).intervals(Bootstrap(200, 0.9, seed).scores(values, np.ones((40, 1))), 1)[0]
        assert found is not None
        hits += found.low <= 1.0 <= found.high
    assert 0.8 <= hits / 200 <= 0.97  # percentile intervals of a skew distribution are a little narrow


def test_a_method_differs_from_itself_by_exactly_nothing(shared_files: Files) -> None:
    from facediff.evaluation import evaluate
    from facediff.metrics import Region
    from tests.evaluation.conftest import LIPS, VERTICES

    report = evaluate(
        {"one": shared_files.method(), "same": shared_files.method()},
        shared_files.truth,
        lips=Region.from_indices("lips", LIPS),
        n_vertices=VERTICES,
        protocols=["meshtalk"],
        bootstrap=100,
    )
    (found,) = report.comparisons
    assert (found.difference, found.sequences) == (0.0, len(LENGTHS))
    assert found.interval is not None
    assert (found.interval.low, found.interval.high) == (0.0, 0.0)


def test_methods_are_compared_over_the_sequences_that_both_have(files: Files) -> None:
    report = files.evaluate("ours", "theirs", protocols=OF_VERTICES, bootstrap=200)
    differences = {f"{each.protocol}/{each.metric}": each for each in report.comparisons}
    ours, theirs = scores_of(report, 0), scores_of(report, 1)
    for name, found in differences.items():
        assert found.difference == pytest.approx(theirs[name] - ours[name], abs=1e-15)
        assert found.interval is not None
        assert found.interval.low <= found.difference <= found.interval.high
    assert differences["paper/mve"].interval.low > 0  # its noise is more than twice as strong, in every clip
    (files.method("theirs") / "A_e03_condition_A.npy").unlink()
    (files.method("ours") / "B_C_e01_condition_B_C.npy").unlink()
    (files.truth / "A_e02.npy").unlink()
    report = files.evaluate("ours", "theirs", protocols=["paper"])
    assert {each.sequences for each in report.comparisons} == {2}
    for folder in ("ours", "theirs"):
        for clip in ("A_e03_condition_A", "B_C_e01_condition_B_C"):
            (files.method(folder) / f"{clip}.npy").unlink(missing_ok=True)
    common = files.evaluate("ours", "theirs", protocols=["paper"])
    assert [each.difference for each in report.comparisons] == [each.difference for each in common.comparisons]
