"""Simulated raters of known preference, to try a study before people take part."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from typing import Annotated

import numpy as np

from facediff.study.answers import Answer, Rater, questions_of
from facediff.study.definition import LEFT, RIGHT, SAME, Study, Trial
from facediff.study.design import STILL
from facediff.utils import ranges
from facediff.utils.ranges import Range

Share = Annotated[float, Range(0, 1)]
Spread = Annotated[float, Range(0, 10)]

STILL_SCORE = -6.0
"""Score of a face that does not move: it is preferred to one of score 0 once in 400 times."""


@ranges.checked
def simulate(
    study: Study,
    scores: Mapping[str, float],
    raters: ranges.Raters,
    *,
    careless: Share = 0.0,
    spread: Spread = 0.0,
    no_difference: Share = 0.0,
    seed: ranges.Seed = 0,
) -> list[Rater]:
    """Raters who answer as Bradley and Terry say: i is preferred to j with the chance 1 / (1 + exp(s_j - s_i)).

    Args:
        study: its definition.
        scores: of each method, and of ``truth``; the same for every question. ``still`` is far below all.
        raters: how many.
        careless: share of the raters who answer at random.
        spread: standard deviation of the raters' own scores around these, so that answers of one rater are alike.
        no_difference: share of the answers that see no difference, where a question allows it.
        seed: of everything.
    """
    rng = np.random.default_rng(seed)
    return [
        _rater(study, {STILL: STILL_SCORE, **scores}, number, rng, careless, spread, no_difference, seed)
        for number in range(raters)
    ]


def _rater(
    study: Study,
    scores: Mapping[str, float],
    number: int,
    rng: np.random.Generator,
    careless: float,
    spread: float,
    no_difference: float,
    seed: int,
) -> Rater:
    by_chance = rng.random() < careless
    personal = {name: score + spread * rng.normal() for name, score in scores.items()}

    def answer(trial: Trial, allowed: tuple[str, ...]) -> str:
        if SAME in allowed and rng.random() < no_difference:
            return SAME
        lead = 0.0 if by_chance else personal[trial.left] - personal[trial.right]
        return LEFT if rng.random() < 1 / (1 + math.exp(-lead)) else RIGHT

    answers = {}
    for index, trial in enumerate(study.trials_of(number)):
        questions = questions_of(study, trial)
        replies = {question: answer(trial, tuple(allowed)) for question, allowed in questions.items()}
        at = f"2026-01-01T{index // 60 % 24:02d}:{index % 60:02d}:00Z"
        answers[trial.id] = Answer(trial.id, replies, float(rng.uniform(5, 30)), int(rng.integers(1, 4)), at)
    token = hashlib.sha256(f"{seed}/{number}".encode()).hexdigest()[:32]
    day = "2026-01-01"
    return Rater(token, number, study.languages[0], "simulated", f"{day}T00:00:00Z", f"{day}T23:59:59Z", answers)
