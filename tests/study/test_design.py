"""The design is balanced: pairs over clips, sides, places and neighbours, whatever the numbers are."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.errors import FaceDiffError
from facediff.study.design import Design, Showing, make_forms, make_pairs, make_schedules, orders

NONE = {"still": 0, "same": 0, "repeats": 0}


@pytest.mark.parametrize("count", range(1, 14))
def test_every_trial_is_in_every_place_and_after_every_other_equally_often(count: int) -> None:
    rows = orders(count)
    assert all(sorted(row) == list(range(count)) for row in rows)
    assert len(rows) == (count if count % 2 == 0 else 2 * count)
    places = Counter((place, number) for row in rows for place, number in enumerate(row))
    assert len(set(places.values())) == 1
    neighbours = Counter(pair for row in rows for pair in pairwise(row))
    assert len(set(neighbours.values())) <= 1
    assert len(neighbours) == count * (count - 1)


@settings(max_examples=40, deadline=None)
@given(
    clips=st.integers(1, 13),
    methods=st.integers(2, 5),
    kind=st.sampled_from(["first", "all"]),
    design=st.sampled_from(["latin", "all"]),
    seed=st.integers(0, 9),
)
def test_over_all_forms_every_clip_has_every_pair_on_both_sides_equally_often(
    clips: int, methods: int, kind: str, design: Design, seed: int
) -> None:
    names = [f"clip{i}" for i in range(clips)]
    pairs = make_pairs([f"m{i}" for i in range(methods)], kind)  # type: ignore[arg-type]
    assert len(pairs) == (methods - 1 if kind == "first" else methods * (methods - 1) // 2)
    forms = make_forms(names, pairs, design=design, seed=seed, **NONE)
    counts = Counter((showing.clip, showing.left, showing.right) for form in forms for showing in form)
    assert set(counts) == {(clip, *sides) for clip in names for a, b in pairs for sides in ((a, b), (b, a))}
    assert len(set(counts.values())) == 1
    for form in forms:
        seen = Counter(showing.clip for showing in form)
        assert set(seen.values()) == {1 if design == "latin" else len(pairs)}
        for first, second in pairs:
            left = sum((showing.left, showing.right) == (first, second) for showing in form)
            right = sum((showing.right, showing.left) == (first, second) for showing in form)
            assert abs(left - right) <= 1


def test_controls_are_in_every_form_and_repeats_show_the_sides_exchanged() -> None:
    pairs = make_pairs(["ours", "theirs", "truth"], "first")
    forms = make_forms(["a", "b", "c", "d"], pairs, design="latin", still=3, same=2, repeats=2, seed=1)
    for form in forms:
        kinds = Counter(showing.kind for showing in form)
        assert kinds == {"pair": 4, "still": 3, "same": 2, "repeat": 2}
        shown = {(each.clip, each.left, each.right) for each in form if each.kind == "pair"}
        assert all((r.clip, r.right, r.left) in shown for r in form if r.kind == "repeat")
        assert all(each.left == each.right for each in form if each.kind == "same")
        assert all({each.left, each.right} == {"truth", "still"} for each in form if each.kind == "still")
    sides = Counter(each.left for form in forms for each in form if each.kind == "still")
    assert sides["truth"] == sides["still"]


def test_consecutive_raters_get_other_forms_and_seeds_change_orders_only_where_they_should() -> None:
    pairs = make_pairs(["ours", "theirs", "third"], "first")

    def made(seed: int) -> tuple[list[Showing], list[list[int]]]:
        return make_schedules(make_forms(["a", "b", "c", "d"], pairs, design="latin", seed=seed, **NONE), seed)

    trials, schedules = made(0)
    assert made(0) == (trials, schedules)
    assert made(1)[1] != schedules
    assert set(made(1)[0]) == set(trials)
    forms = [frozenset(row) for row in schedules]
    assert len(set(forms[:4])) == 4
    assert forms[:4] == forms[4:8]
    assert set(Counter(number for row in schedules for number in row).values()) == {len(schedules) // 4}


def test_too_many_trials_are_refused() -> None:
    with pytest.raises(FaceDiffError, match="--max-clips"):
        make_forms([str(i) for i in range(300)], [("a", "b")], design="latin", seed=0, **NONE)
