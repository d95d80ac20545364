"""Several samples or identities of one sequence: pairs, numbers of samples, and laws between the scores."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.metrics import (
    IdentityDiversity,
    SampleDiversity,
    coverage_error,
    identity_diversity,
    lip_vertex_error,
    mean_estimate_error,
    sample_diversity,
)

few = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**31)
counts = st.integers(1, 5)
LIPS = [0, 3]


def samples(seed: int, count: int = 4, frames: int = 6) -> torch.Tensor:
    return torch.randn(2, count, frames, 5, 3, dtype=torch.float64, generator=torch.manual_seed(seed))


@few
@given(seeds, counts)
def test_the_best_sample_is_no_worse_than_any_and_the_mean_no_worse_than_their_mean(seed: int, count: int) -> None:
    several, truth = samples(seed, count), samples(seed + 1, 1)[:, 0]
    for squared in (True, False):
        each = torch.stack(
            [
                torch.stack([lip_vertex_error(one, g, LIPS, squared=squared) for one in some])
                for some, g in zip(several, truth, strict=True)
            ]
        )
        covered = coverage_error(several, truth, LIPS, squared=squared)
        torch.testing.assert_close(covered, each.amin(1).mean(), rtol=1e-12, atol=0)
        # A largest distance, squared or not, is convex: Jensen.
        assert mean_estimate_error(several, truth, LIPS, squared=squared) <= each.mean() * (1 + 1e-12)


@few
@given(seeds)
def test_one_sample_is_the_lip_vertex_error(seed: int) -> None:
    several, truth = samples(seed, 1), samples(seed + 1, 1)[:, 0]
    expected = lip_vertex_error(several[:, 0], truth, LIPS)
    torch.testing.assert_close(coverage_error(several, truth, LIPS), expected)
    torch.testing.assert_close(mean_estimate_error(several, truth, LIPS), expected)


@few
@given(seeds, st.integers(2, 5), st.floats(0.01, 100))
def test_diversity_scales_and_does_not_see_a_common_motion(seed: int, count: int, scale: float) -> None:
    several, common = samples(seed, count), samples(seed + 1, 1)
    value = identity_diversity(several)
    torch.testing.assert_close(identity_diversity(scale * several + common), scale * value, rtol=1e-9, atol=1e-12)
    order = torch.randperm(count, generator=torch.manual_seed(seed))
    torch.testing.assert_close(identity_diversity(several[:, order]), value, rtol=1e-12, atol=0)
    torch.testing.assert_close(sample_diversity(several, pairing="all"), value, rtol=0, atol=0)
    assert identity_diversity(common.expand(2, count, 6, 5, 3)) == 0


def test_shuffled_pairs_are_two_halves_and_depend_on_the_seed_alone() -> None:
    metric = SampleDiversity(n_samples=10)
    pairs = metric.pairs(10)
    assert len(pairs) == 5
    assert sorted(index for pair in pairs for index in pair) == list(range(10))
    assert SampleDiversity(n_samples=10).pairs(10) == pairs
    assert len({tuple(SampleDiversity(n_samples=10, seed=seed).pairs(10)) for seed in range(20)}) > 15
    several = samples(0, 10)
    by_hand = [(several[0, a] - several[0, b]).norm(dim=-1).mean() for a, b in pairs]
    torch.testing.assert_close(sample_diversity(several[0]), torch.stack(by_hand).mean(), rtol=1e-12, atol=0)


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
