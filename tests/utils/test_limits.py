"""Numbers of files, marks of formats, and values in messages."""

from __future__ import annotations

import math

import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.utils.hints import check_number
from facediff.utils.limits import FRAME_RATES, check_format, quoted

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


def test_values_are_quoted_short_and_on_one_line() -> None:
    class Broken:
        def __repr__(self) -> str:
            raise RuntimeError

    for value in (HUGE, "a\nb" * 500, Broken(), {"a": "\x1b[31m" * 99}):
        assert len(quoted(value)) <= 60
        assert quoted(value).isprintable()
