"""The options that tell one definition of a metric from another, their names, and their words."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Literal, get_args

Reduction = Literal["mean", "max"]
"""How the vertices of one frame become one number."""

Pooling = Literal["frames", "sequences"]
"""All frames of all sequences alike, or the mean of the sequences' means."""

LengthRule = Literal["min", "error", "prediction"]
"""What to do where prediction and truth differ in length: cut both to the shorter; refuse; or cut the
prediction only and refuse a prediction that is shorter than the truth."""

Sign = Literal["signed", "absolute"]
"""Whether a deviation keeps its sign, so that sequences can cancel, or is made positive in each sequence."""

Subject = Literal["prediction", "truth", "gap"]
"""Whose score: the prediction's, the truth's, which a prediction can be held against, or the prediction's minus
the truth's."""

REDUCTIONS: tuple[Reduction, ...] = get_args(Reduction)
POOLINGS: tuple[Pooling, ...] = get_args(Pooling)
LENGTH_RULES: tuple[LengthRule, ...] = get_args(LengthRule)
SIGNS: tuple[Sign, ...] = get_args(Sign)
SUBJECTS: tuple[Subject, ...] = get_args(Subject)

POOLING_WORDS: dict[Pooling, str] = {
    "frames": "mean over the frames of all sequences",
    "sequences": "mean over the frames of each sequence, then mean over sequences",
}
SUBJECT_WORDS: dict[Subject, str] = {
    "prediction": "of the prediction",
    "truth": "of the truth",
    "gap": "of the prediction minus that of the truth",
}
LENGTH_WORDS: dict[LengthRule, str] = {
    "min": "prediction and truth are both cut to the shorter of the two",
    "error": "prediction and truth must have the same number of frames",
    "prediction": "the prediction is cut to the truth; a shorter prediction is an error",
}


def check_option(name: str, value: str, choices: Sequence[str]) -> None:
    """Refuse a value that is not among the choices.

    Args:
        name: What is being chosen, as the caller wrote it.
        value: The value given.
        choices: Every value that is allowed.

    Raises:
        ValueError: If ``value`` is not one of ``choices``; the message lists them and the nearest.

    >>> check_option("pooling", "frame", ("frames", "sequences"))
    Traceback (most recent call last):
    ...
    ValueError: unknown pooling 'frame': choose one of frames, sequences. Did you mean 'frames'?
    """
    if value in choices:
        return
    nearest = get_close_matches(str(value), choices, n=1)
    hint = f". Did you mean {nearest[0]!r}?" if nearest else ""
    raise ValueError(f"unknown {name} {value!r}: choose one of {', '.join(choices)}{hint}")


def vertex_error_words(where: str, *, reduction: Reduction, squared: bool, pooling: Pooling) -> str:
    """The definition of a vertex error in plain words.

    >>> vertex_error_words("the lips", reduction="max", squared=True, pooling="frames")
    'in each frame the largest squared distance over the lips; mean over the frames of all sequences [unit²]'
    """
    distance = "squared distance" if squared else "distance"
    over = "mean" if reduction == "mean" else "largest"
    unit = "unit²" if squared else "unit"
    return f"in each frame the {over} {distance} over {where}; {POOLING_WORDS[pooling]} [{unit}]"


def dynamics_words(where: str, *, sign: Sign) -> str:
    """The definition of the face dynamics deviation in plain words."""
    kept = "signed, positive where the prediction moves less" if sign == "signed" else "its absolute value"
    return (
        f"in each sequence the mean over {where} of the standard deviation over time (population) of the "
        f"squared offset from the template, truth minus prediction, {kept}; mean over sequences [unit²]"
    )
