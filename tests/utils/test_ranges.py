"""Ranges of numbers: what they hold, and that dataclasses and functions check theirs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest

from facediff.animation.options import AnimationControls, AnimationOptions
from facediff.editing.blendshapes import SolveOptions
from facediff.errors import FaceDiffError
from facediff.evaluation.figures import Paper
from facediff.export import ExportOptions
from facediff.reporting.statistics import Bootstrap
from facediff.utils import ranges
from facediff.utils.ranges import Range, check_fields, checked, mismatch

BAD = [float("nan"), float("inf"), -float("inf"), 1e-300, 1e300, -1, 2**64, 10**400, "1", True, 1j]


@dataclass
class Made:
    share: Annotated[float, Range(0.1, 1)] = 0.5
    counts: tuple[Annotated[int, Range(1, 9)] | None, ...] = (1, None)

    def __post_init__(self) -> None:
        check_fields(self)


@pytest.mark.parametrize("number", BAD)
def test_what_is_outside_is_refused(number: object) -> None:
    with pytest.raises(FaceDiffError, match=r"Made\.share"):
        Made(share=number)  # type: ignore[arg-type]
    with pytest.raises(FaceDiffError, match=r"Made\.counts"):
        Made(counts=(1, number))  # type: ignore[arg-type]


def test_counts_are_whole() -> None:
    assert Made(share=1, counts=(np.int64(3), None)).counts[0] == 3
    assert Made(share=np.float32(0.25)).share == 0.25
    with pytest.raises(FaceDiffError, match="a whole number from 1 to 9"):
        Made(counts=(2.0,))  # type: ignore[arg-type]


def test_ends_belong_to_the_range_unless_they_do_not() -> None:
    assert 0 in Range(0, 1)
    assert 1 in Range(0, 1)
    assert 0 not in Range(0, 1, above=True)
    assert 1 not in Range(0, 1, below=True)


@pytest.mark.parametrize(
    ("allowed", "words"),
    [
        (Range(1, 8), "a number from 1 to 8"),
        (Range(0, 1, above=True), "a number above 0 and at most 1"),
        (Range(0, 1, above=True, below=True), "a number above 0 and below 1"),
        (Range(0), "a finite number of at least 0"),
        (Range(0, above=True), "a finite number above 0"),
        (Range(most=2, below=True), "a finite number below 2"),
        (Range(), "a finite number"),
    ],
)
def test_a_range_in_words(allowed: Range, words: str) -> None:
    assert allowed.numbers() == words
    assert allowed.numbers(whole=True).startswith("a whole number")
    assert mismatch(Annotated[float, allowed], float("nan")) == words


def test_a_range_without_ends_takes_every_finite_number() -> None:
    assert all(number in Range() for number in (-1e300, 10**400, np.float32(0.5)))
    assert not any(number in Range() for number in (float("nan"), float("inf"), -float("inf"), True, "1", 1j))


def test_arguments_are_checked_by_name_and_by_place() -> None:
    @checked
    def draw(size: ranges.Pixels, *, share: ranges.Smoothing | None = None) -> int:
        return size

    assert draw(64) == 64
    for call in (lambda: draw(3), lambda: draw(size=10**9), lambda: draw(64, share=1.0)):
        with pytest.raises(FaceDiffError, match=r"draw\.(size|share)"):
            call()


@pytest.mark.parametrize(
    ("made", "options"),
    [
        (AnimationOptions, {"checkpoint": "x.ckpt", "samples": 0}),
        (AnimationOptions, {"checkpoint": "x.ckpt", "samples": 10**6}),
        (AnimationOptions, {"checkpoint": "x.ckpt", "steps": 10**9}),
        (AnimationOptions, {"checkpoint": "x.ckpt", "window": float("nan")}),
        (AnimationControls, {"blinks": float("nan")}),
        (AnimationControls, {"gaze": 1e300}),
        (AnimationControls, {"sway": -1.0}),
        (AnimationControls, {"controls_seed": -1}),
        (ExportOptions, {"size": 10**6}),
        (ExportOptions, {"tolerance": 1e-300}),
        (Paper, {"width": 1e6}),
        (Paper, {"dpi": 10**6}),
        (SolveOptions, {"smoothness": float("inf")}),
        (SolveOptions, {"lower": float("nan")}),
        (Bootstrap, {"resamples": 10**9}),
        (Bootstrap, {"level": 1.0}),
    ],
)
def test_options_of_python_are_checked_when_they_are_made(made: type, options: dict[str, object]) -> None:
    with pytest.raises(FaceDiffError, match=rf"\b{list(options)[-1]} "):
        made(**options)
