"""Batches under a frame budget, on several processes, repeatable."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.data.dataset import ClipBatches, Pick

LENGTHS = st.lists(st.integers(1, 300), min_size=1, max_size=60)


def batches(lengths: list[int], epoch: int = 0, **options: object) -> list[list[Pick]]:
    sampler = ClipBatches(lengths, **{"batch_size": 4, **options})  # type: ignore[arg-type]
    sampler.set_epoch(epoch)
    found = list(sampler)
    assert len(found) == len(sampler)
    return found


def indices(found: list[list[Pick]]) -> list[list[int]]:
    return [[pick.index for pick in batch] for batch in found]


@settings(deadline=None, max_examples=40)
@given(LENGTHS, st.integers(1, 400), st.integers(0, 3), st.booleans())
def test_a_budget_holds_and_every_clip_is_there_once(
    lengths: list[int], budget: int, epoch: int, training: bool
) -> None:
    found = indices(batches(lengths, epoch, max_frames=budget, training=training))
    assert sorted(i for batch in found for i in batch) == list(range(len(lengths)))
    for batch in found:
        assert len(batch) == 1 or max(lengths[i] for i in batch) * len(batch) <= budget


@settings(deadline=None, max_examples=40)
@given(LENGTHS, st.integers(10, 400))
def test_batches_are_of_like_length(lengths: list[int], budget: int) -> None:
    """No worse than sorting: once lengths are rounded up to buckets, batches do not overlap in length."""
    width = max(1, budget // 32)
    picked = indices(batches(lengths, max_frames=budget, training=True))
    buckets = sorted(sorted(-(-lengths[i] // width) for i in batch) for batch in picked)
    for shorter, longer in zip(buckets, buckets[1:], strict=False):
        assert min(longer) >= max(shorter)


@settings(deadline=None, max_examples=40)
@given(LENGTHS, st.integers(1, 5), st.one_of(st.none(), st.integers(1, 400)), st.integers(1, 6))
def test_processes_share_evaluation_without_repeats(
    lengths: list[int], world: int, budget: int | None, size: int
) -> None:
    shares = [
        batches(lengths, max_frames=budget, batch_size=size, rank=rank, world_size=world) for rank in range(world)
    ]
    # They wait for one another at every batch.
    assert len({len(share) for share in shares}) == 1
    scored = Counter(pick.index for share in shares for batch in share for pick in batch if not pick.repeated)
    assert scored == Counter(range(len(lengths)))
    assert sum(pick.repeated for share in shares for batch in share for pick in batch) < world
    for batch in (batch for share in shares for batch in share):
        longest = max(lengths[pick.index] for pick in batch)
        assert len(batch) == 1 or (len(batch) <= size if budget is None else longest * len(batch) <= budget)
    assert all(len({pick.repeated for pick in batch}) == 1 for share in shares for batch in share)


@settings(deadline=None, max_examples=40)
@given(LENGTHS, st.integers(1, 5), st.one_of(st.none(), st.integers(1, 400)), st.integers(0, 3))
def test_processes_train_on_all_clips_in_equally_many_batches(
    lengths: list[int], world: int, budget: int | None, epoch: int
) -> None:
    shares = [
        indices(batches(lengths, epoch, max_frames=budget, training=True, rank=rank, world_size=world))
        for rank in range(world)
    ]
    assert len({len(share) for share in shares}) == 1
    assert {i for share in shares for batch in share for i in batch} == set(range(len(lengths)))


@pytest.mark.parametrize("budget", [None, 300])
def test_order_and_draws_follow_from_seed_and_epoch(budget: int | None) -> None:
    lengths = [20 + 7 * i % 90 for i in range(40)]

    def made(epoch: int, seed: int = 3, **options: object) -> list[list[Pick]]:
        return batches(lengths, epoch, max_frames=budget, training=True, seed=seed, **options)

    assert made(1) == made(1)
    assert made(1) != made(2)
    assert made(1) != made(1, seed=4)
    # A clip's draws are its own, whichever process and batch it is in.
    draws = {pick.index: pick.seed for batch in made(1) for pick in batch}
    for rank in range(2):
        assert all(pick.seed == draws[pick.index] for b in made(1, rank=rank, world_size=2) for pick in b)
    assert len(set(draws.values())) == len(lengths)


def test_the_number_of_batches_does_not_change_from_epoch_to_epoch() -> None:
    lengths = [30 + 13 * i % 170 for i in range(97)]
    assert len({len(batches(lengths, epoch, max_frames=500, training=True)) for epoch in range(20)}) == 1


def test_evaluation_is_in_order() -> None:
    assert indices(batches([5] * 6, batch_size=4)) == [[0, 1, 2, 3], [4, 5]]
    assert {pick.seed for batch in batches([5] * 6) for pick in batch} == {0}


GROUPS = [f"e{i % 7}" for i in range(23)] + ["alone", "lonely", "single"]


@pytest.mark.parametrize("world", [1, 2])
def test_training_batches_of_pairs(world: int) -> None:
    """Neighbours share a group, every clip comes, the number of batches is the same in each epoch."""
    counts = set()
    for epoch in range(4):
        seen: list[int] = []
        for rank in range(world):
            batches = ClipBatches(
                [10] * len(GROUPS), batch_size=4, training=True, groups=GROUPS, rank=rank, world_size=world
            )
            batches.set_epoch(epoch)
            made = [[pick.index for pick in batch] for batch in batches]
            counts.add(len(made))
            assert len(made) == len(batches)
            for batch in made:
                for one, other in zip(batch[::2], batch[1::2], strict=True):
                    assert one != other
                    together = {GROUPS[one], GROUPS[other]}
                    assert len(together) == 1 or together <= {"alone", "lonely", "single"}
            seen += [index for batch in made for index in batch]
        assert set(seen) == set(range(len(GROUPS)))
    assert len(counts) == 1


def test_evaluation_knows_no_pairs() -> None:
    batches = ClipBatches([10] * len(GROUPS), batch_size=4, groups=GROUPS)
    assert [pick.index for batch in batches for pick in batch] == list(range(len(GROUPS)))


def test_pairs_keep_to_a_frame_budget() -> None:
    lengths = [10 + 3 * (i % 5) for i in range(len(GROUPS))]
    for batch in ClipBatches(lengths, batch_size=1, max_frames=90, training=True, groups=GROUPS):
        assert len(batch) % 2 == 0
        assert max(lengths[pick.index] for pick in batch) * len(batch) <= 90
