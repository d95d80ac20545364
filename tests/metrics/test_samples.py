"""Several samples or identities of one sequence: pairs, numbers of samples, and laws between the scores."""

from __future__ import annotations

import pytest
import torch

from facediff.metrics import (
    IdentityDiversity,
    SampleDiversity,
    identity_diversity,
)


def samples(seed: int, count: int = 4, frames: int = 6) -> torch.Tensor:
    return torch.randn(2, count, frames, 5, 3, dtype=torch.float64, generator=torch.manual_seed(seed))


def test_shuffled_pairs_are_two_halves_and_depend_on_the_seed_alone() -> None:
    metric = SampleDiversity(n_samples=10)
    pairs = metric.pairs(10)
    assert len(pairs) == 5
    assert sorted(index for pair in pairs for index in pair) == list(range(10))
    assert SampleDiversity(n_samples=10).pairs(10) == pairs
    assert len({tuple(SampleDiversity(n_samples=10, seed=seed).pairs(10)) for seed in range(20)}) > 15


def test_identities_may_differ_in_number_and_one_alone_is_left_out() -> None:
    metric = IdentityDiversity()
    for count in (1, 2, 3):
        metric.update(samples(count, count))
    assert (metric.coverage().sequences, metric.coverage().left_out) == (4, 2)
    expected = (identity_diversity(samples(2, 2)) + identity_diversity(samples(3, 3))) / 2
    torch.testing.assert_close(metric.compute(), expected, rtol=1e-12, atol=0)


def test_a_nan_in_any_sample_names_the_clip() -> None:
    several = samples(0)
    several[1, 3, 2, 4, 0] = float("nan")
    metric = IdentityDiversity()
    with pytest.raises(ValueError, match="the prediction of b holds NaN or infinity, first in frame 2"):
        metric.update(several, clip_names=["a", "b"])
    metric.update(several, lengths=[6, 2])
    assert metric.coverage().frames == 8
