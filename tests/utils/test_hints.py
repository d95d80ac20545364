"""The checker of values: hints, ranges, words and plain data agree, and every door of it refuses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest

from facediff.animation.options import AnimationControls, AnimationOptions
from facediff.editing.blendshapes import SolveOptions
from facediff.errors import ArgumentError, FaceDiffError
from facediff.evaluation.figures import Paper
from facediff.export import ExportOptions
from facediff.reporting.statistics import Bootstrap
from facediff.utils import hints, ranges
from facediff.utils.hints import Range, checked, checks_arguments, convert, describe, fits, mismatch, read

BAD = [float("nan"), float("inf"), -float("inf"), 1e-300, 1e300, -1, 2**64, 10**400, "1", True, 1j]


class Colour(Enum):
    RED = "red"


VALUES: list[tuple[Any, Any, str]] = [
    (int, 3, "3"),
    (float, 0.5, "5e-1"),
    (Annotated[float, Range(0, 1)] | None, 1, "1"),
    (bool, True, "True"),
    (str, "a word", "a word"),
    (Literal[16, 32], 32, "32"),
    (int | None, None, "none"),
]


@pytest.mark.parametrize(("hint", "value", "word"), VALUES)
def test_a_value_of_a_hint_is_read_from_its_word(hint: object, value: object, word: str) -> None:
    assert fits(hint, value)
    assert fits(hint, value, stored=True)
    assert mismatch(hint, value) is None
    assert read(hint, word) == value
    assert type(read(hint, word)) is type(convert(hint, value))


@pytest.mark.parametrize("word", ["", " 1", "1_0", "½", "٣", "nan", "inf", "1e999", "2", "-1", "none"])
def test_a_word_is_read_as_a_number_only_in_ascii_and_in_its_range(word: str) -> None:
    with pytest.raises(ValueError, match="a number from 0 to 1"):
        read(Annotated[float, Range(0, 1)], word)
    with pytest.raises(ValueError, match="a whole number from 0 to 1"):
        read(Annotated[int, Range(0, 1)], word or "0.5")


PLAIN: list[tuple[Any, Any, Any]] = [
    (tuple[int, ...] | None, [1, 2], (1, 2)),
    (tuple[int, str], [1, "a"], (1, "a")),
    (frozenset[str], ["a"], frozenset("a")),
    (Path, "some/where", Path("some/where")),
    (Colour, "red", Colour.RED),
    (float, 1, 1.0),
    (dict[str, list[int]], {"a": [1]}, {"a": [1]}),
    (Any, {"a": [1, None, "b"]}, {"a": [1, None, "b"]}),
]


@pytest.mark.parametrize(("hint", "stored", "value"), PLAIN)
def test_plain_data_becomes_what_the_hint_asks_for(hint: object, stored: object, value: object) -> None:
    assert fits(hint, stored, stored=True)
    converted = convert(hint, stored)
    assert converted == value
    assert type(converted) is type(value)


@pytest.mark.parametrize(
    "text", ["${oc.env:HOME}", "http://elsewhere", "\\\\server\\share", "//server", "a\nb", "x" * 9999]
)
@pytest.mark.parametrize("hint", [str, Path, Any, list[str], dict[str, str], Annotated[str, "note"] | None])
def test_no_stored_text_can_be_resolved_fetched_or_break_a_line(hint: Any, text: str) -> None:  # noqa: ANN401
    stored = [text] if hint == list[str] else {"key": text} if hint == dict[str, str] else text
    assert not fits(hint, stored, stored=True)


@pytest.mark.parametrize(
    ("hint", "value"),
    [
        (Callable[..., None], "os.system"),
        (type[int], "builtins.int"),
        (dict[str, Any], {"class_path": "os.system"}),
        (Any, {"a": [{"init_args": {}}]}),
        (Any, "{a: b}"),
        (dict[str, int], {3: 4}),
    ],
)
def test_nothing_stored_names_what_could_be_imported(hint: object, value: object) -> None:
    assert not fits(hint, value, stored=True)


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
    assert describe(list[Annotated[float, allowed]]).endswith(f" items, each {words}")


def test_ends_belong_to_the_range_unless_they_do_not() -> None:
    assert [0 in Range(0, 1), 1 in Range(0, 1)] == [True, True]
    assert [0 in Range(0, 1, above=True), 1 in Range(0, 1, below=True)] == [False, False]
    assert all(number in Range() for number in (-1e300, 10**400, np.float32(0.5)))
    assert not any(number in Range() for number in (float("nan"), float("inf"), -float("inf"), True, "1", 1j))


@dataclass
class Options:
    share: Annotated[float, Range(0.1, 1)] = 0.5
    counts: tuple[Annotated[int, Range(1, 9)] | None, ...] = (1, None)

    def __post_init__(self) -> None:
        hints.check_options(self)


@checked
def draw(share: Annotated[float, Range(0.1, 1)], *, counts: Sequence[Annotated[int, Range(1, 9)]] | None = None) -> int:
    return len(counts or ())


class Part:
    @checks_arguments
    def __init__(
        self, share: Annotated[float, Range(0.1, 1)], counts: list[Annotated[int, Range(1, 9)]] | None = None
    ) -> None:
        self.numbers = [share, *(counts or ())]


@pytest.mark.parametrize("door", [Options, draw, Part])
@pytest.mark.parametrize("number", BAD)
def test_what_is_outside_is_refused_at_every_door(door: Callable[..., object], number: object) -> None:
    door(share=0.5, counts=[np.int64(3)])
    with pytest.raises(FaceDiffError, match="share"):
        door(share=number)
    with pytest.raises(FaceDiffError, match="counts"):
        door(share=0.5, counts=[1, number])


def test_an_error_inside_a_constructor_names_its_arguments() -> None:
    class Faulty:
        options_path = "model"

        @checks_arguments
        def __init__(self, size: int) -> None:
            raise RuntimeError("out of memory\nand more")

    with pytest.raises(ArgumentError, match=r"model\.size 3: Faulty cannot be made \(out of memory\)"):
        Faulty(3)


@pytest.mark.parametrize(
    ("group", "options"),
    [
        (AnimationOptions, {"checkpoint": "x.ckpt", "samples": 0}),
        (AnimationOptions, {"checkpoint": "x.ckpt", "window": float("nan")}),
        (AnimationControls, {"gaze": 1e300}),
        (AnimationControls, {"controls_seed": -1}),
        (ExportOptions, {"tolerance": 1e-300}),
        (Paper, {"width": 1e6}),
        (SolveOptions, {"smoothness": float("inf")}),
        (Bootstrap, {"level": 1.0}),
    ],
)
def test_options_of_python_are_checked_when_they_are_made(group: type, options: dict[str, object]) -> None:
    with pytest.raises(FaceDiffError, match=rf"\b{list(options)[-1]} "):
        group(**options)


def test_options_of_a_base_class_count_where_they_are_handed_on() -> None:
    class Base:
        def __init__(self, size: int, rate: float = 0.5) -> None:
            pass

    class Derived(Base):
        def __init__(self, *, depth: ranges.Steps = 3, **options: Any) -> None:  # noqa: ANN401
            pass

    assert hints.defaults(Derived) == {"rate": 0.5, "depth": 3}
    assert {name: p.annotation for name, p in hints.options_of(Derived).items()} == {
        "size": int,
        "rate": float,
        "depth": ranges.Steps,
    }
