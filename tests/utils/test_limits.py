"""The budget of an untrusted file, and numbers that enter from one."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.utils.hints import check_number
from facediff.utils.limits import FRAME_RATES, LIMITS, Limits, check_array, check_format, check_nesting, quoted

HUGE = 10**6000
"""More digits than Python agrees to write."""


@pytest.mark.parametrize("value", [25, 25.0, np.float32(25), np.int64(25), 0.1, 1000])
def test_number_in_range_is_returned(value: object) -> None:
    assert check_number("m.json", "frame_rate", value, *FRAME_RATES) == value


@pytest.mark.parametrize(
    "value", [math.nan, math.inf, -math.inf, True, "25", None, HUGE, -HUGE, 0, 1e-300, 1e9, [25], 1j, b"25"], ids=quoted
)
def test_number_that_is_none_or_out_of_range_is_refused(value: object) -> None:
    with pytest.raises(FaceDiffError, match=r"m.json: frame_rate .* from 0.1 to 1000; write it again") as refused:
        check_number("m.json", "frame_rate", value, *FRAME_RATES, remedy="write it again")
    assert len(str(refused.value)) < 200


def test_number_of_a_table_may_be_text_and_must_be_whole_where_asked() -> None:
    assert check_number("a.csv", "start", " 1.5", 0, text=True) == 1.5
    assert check_number("a.csv", "row", "3", 0, 9, text=True, whole=True) == 3
    for text, whole in (("1.5", True), ("nan", False), ("1e999", False), ("", False), ("9" * 5000, False)):
        with pytest.raises(FaceDiffError, match=r"a.csv: row"):
            check_number("a.csv", "row", text, 0, text=True, whole=whole)


@pytest.mark.parametrize(
    "found", ["facediff take 2", "facediff take", "other 1", 1, None, HUGE, "x" * 9999, b"1"], ids=quoted
)
def test_format_of_another_version_is_refused(found: object) -> None:
    check_format("a.npz", "facediff take 1", "facediff take 1")
    with pytest.raises(FaceDiffError, match=r"a.npz: its format") as refused:
        check_format("a.npz", found, "facediff take 1")
    assert len(str(refused.value)) < 250
    assert ("update facediff" in str(refused.value)) == (found == "facediff take 2")


@pytest.mark.parametrize("found", [2, "1", 1.0, True, None])
def test_format_number_is_compared_with_its_type(found: object) -> None:
    check_format("m.json", 1, 1)
    with pytest.raises(FaceDiffError, match=r"m.json: its format"):
        check_format("m.json", found, 1)


def test_values_are_quoted_short_and_on_one_line() -> None:
    class Broken:
        def __repr__(self) -> str:
            raise RuntimeError

    for value in (HUGE, "a\nb" * 500, Broken(), {"a": "\x1b[31m" * 99}):
        assert len(quoted(value)) <= 60
        assert quoted(value).isprintable()


def test_limit_is_raised_by_its_variable() -> None:
    assert Limits.from_environment({"FACEDIFF_MAX_SECONDS": "1e6"}).seconds == 1e6
    for text in ("0", "-1", "nan", "much"):
        with pytest.raises(FaceDiffError, match="FACEDIFF_MAX_SECONDS"):
            Limits.from_environment({"FACEDIFF_MAX_SECONDS": text})
    with pytest.raises(FaceDiffError, match=r"a.flac.*FACEDIFF_MAX_SECONDS"):
        LIMITS.check("seconds", math.nan, "a.flac")


@pytest.mark.parametrize("shape", [(2**33,), (2**40, 2**40, 2**40), (HUGE,), (-1, 3), (10**15, 0, 3)], ids=quoted)
def test_declared_array_beyond_the_budget_is_refused(shape: tuple[int, ...]) -> None:
    check_array("a.npy", (0, 3), 4)
    with pytest.raises(FaceDiffError, match=r"a.npy: declares"):
        check_array("a.npy", shape, 4)


def shared(depth: int) -> list[Any]:
    made: list[Any] = [1.0]
    for _ in range(depth):
        made = [made, made]
    return made


@pytest.mark.parametrize("make", [lambda: shared(40), lambda: [[0] * 2000] * 2000, lambda: shared(200)])
def test_shared_lists_are_counted_as_often_as_a_walk_sees_them(make: Any) -> None:  # noqa: ANN401
    check_nesting([[1, {"a": (2, 3)}]], Path("t.pkl"))
    with pytest.raises(FaceDiffError, match=r"t.pkl: declares"):
        check_nesting(make(), Path("t.pkl"))


def test_a_list_that_holds_itself_is_too_deep() -> None:
    endless: list[Any] = []
    endless.append(endless)
    with pytest.raises(FaceDiffError, match="nesting"):
        check_nesting(endless, "t.pkl")
