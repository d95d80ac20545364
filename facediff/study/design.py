"""Which pairs a rater sees, on which sides and in which order: Latin squares, seeded.

A *form* is a set of trials. In the design ``latin``, every form shows every clip once, and the pair that a clip is
shown with moves on from form to form: over all forms, every clip is shown with every pair, equally often on both sides.
An *order* is a row of a square of Williams, in which every trial comes in every place, and directly after every other
one, equally often. A *schedule* is a form in an order; consecutive raters get consecutive schedules.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from facediff.errors import FaceDiffError

Design = Literal["latin", "all"]
Pairs = Literal["first", "all"]
Kind = Literal["pair", "still", "same", "repeat"]

TRUTH, STILL = "truth", "still"
"""Conditions besides the methods: the recording, and a face that does not move."""
MOST_TRIALS = 200
"""Trials of a rater; more would take hours, and the list of schedules would fill the page."""


@dataclass(frozen=True, order=True)
class Showing:
    """A video of a trial: a clip with a condition on each side."""

    # ``pair`` is the comparison of the study; the others are controls: the truth against a still face, the same
    # animation on both sides, and a pair that the rater sees a second time with its sides exchanged
    kind: Kind
    clip: str
    left: str  # condition on the left, a method, ``truth`` or ``still``
    right: str  # condition on the right

    @property
    def mirrored(self) -> Showing:
        """The same with its sides exchanged."""
        return Showing(self.kind, self.clip, self.right, self.left)


def make_pairs(conditions: Sequence[str], pairs: Pairs) -> list[tuple[str, str]]:
    """The compared pairs: the first condition with each other one, or all with all.

    Example:
        >>> make_pairs(["ours", "theirs", "truth"], "first")
        [('ours', 'theirs'), ('ours', 'truth')]
    """
    if pairs == "all":
        return list(combinations(conditions, 2))
    return [(conditions[0], condition) for condition in conditions[1:]]


def make_forms(
    clips: Sequence[str],
    pairs: Sequence[tuple[str, str]],
    *,
    design: Design,
    still: int,
    same: int,
    repeats: int,
    seed: int,
) -> list[list[Showing]]:
    """The forms, in the design ``latin`` one pair of every clip, or ``all``; each with its controls.

    ``still`` of them are the truth against a still face, ``same`` one animation on both sides, and ``repeats`` are
    pairs that come a second time, with their sides exchanged.

    Example:
        >>> forms = make_forms(["a", "b"], [("ours", "theirs")], design="latin", still=0, same=0, repeats=0, seed=0)
        >>> [[(video.clip, video.left) for video in form] for form in forms]
        [[('a', 'ours'), ('b', 'theirs')], [('a', 'theirs'), ('b', 'ours')]]
    """
    rng = np.random.default_rng(seed)
    control_clips = [clips[i] for i in rng.permutation(len(clips))]
    methods = list(dict.fromkeys(name for pair in pairs for name in pair if name != TRUTH)) or [TRUTH]
    count = len(clips) * (1 if design == "latin" else len(pairs)) + still + same + repeats
    if count > MOST_TRIALS:
        raise FaceDiffError(
            f"a rater would see {count} videos, more than {MOST_TRIALS}; lower --max-clips, or choose --design latin"
        )
    forms = []
    for mirror in (0, 1):
        for shift in range(len(pairs) if design == "latin" else 1):
            form = []
            for number, clip in enumerate(clips):
                # Of the clips that a form shows with one pair, every second one has its sides exchanged.
                indices = [(number + shift) % len(pairs)] if design == "latin" else range(len(pairs))
                turn = number // len(pairs) if design == "latin" else number
                for pair in indices:
                    showing = Showing("pair", clip, *pairs[pair])
                    form.append(showing.mirrored if (turn + pair + mirror) % 2 else showing)
            again = [form[i] for i in rng.permutation(len(form))[:repeats]]
            for number in range(still):
                control = Showing("still", control_clips[number % len(clips)], TRUTH, STILL)
                form.append(control.mirrored if (number + mirror + shift) % 2 else control)
            for number in range(same):
                name = methods[number % len(methods)]
                form.append(Showing("same", control_clips[(still + number) % len(clips)], name, name))
            form += [Showing("repeat", pair.clip, pair.right, pair.left) for pair in again]
            forms.append(list(dict.fromkeys(form)))  # more controls than clips would ask for one video twice
    return forms


def orders(count: int) -> list[list[int]]:
    """Rows of a balanced Latin square of Williams (1949): ``count`` rows, or twice as many where ``count`` is odd.

    Every number has every position equally often, and follows every other number equally often.

    Example:
        >>> orders(4)
        [[0, 3, 1, 2], [1, 0, 2, 3], [2, 1, 3, 0], [3, 2, 0, 1]]
    """
    first = [index // 2 if index % 2 == 0 else count - 1 - index // 2 for index in range(count)]
    rows = [[(number + row) % count for number in first] for row in range(count)]
    return rows if count % 2 == 0 else [*rows, *(row[::-1] for row in rows)]


def make_schedules(forms: Sequence[Sequence[Showing]], seed: int) -> tuple[list[Showing], list[list[int]]]:
    """The trials of all forms, and the schedules, as numbers of trials.

    Raters 0, 1, 2 … get schedules 0, 1, 2 …, so that forms alternate from rater to rater.
    """
    rng = np.random.default_rng([seed, 1])
    trials = sorted({showing for form in forms for showing in form})
    number = {showing: index for index, showing in enumerate(trials)}
    rows = []
    for form in forms:
        mixed = [number[form[i]] for i in rng.permutation(len(form))]
        square = orders(len(form))
        rows.append([[mixed[index] for index in square[i]] for i in rng.permutation(len(square))])
    turns = max(len(schedules) for schedules in rows)
    return trials, [schedules[turn % len(schedules)] for turn in range(turns) for schedules in rows]
