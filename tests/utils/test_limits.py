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


def test_numbers_of_files() -> None:
    """Those of a table may be text."""
    assert check_number("m.json", "frame_rate", np.float32(25), *FRAME_RATES) == 25
    for value in (math.nan, True, "25", None, HUGE, 0, 1e9, [25], 1j, b"25"):
        with pytest.raises(FaceDiffError, match=r"m.json: frame_rate .{,80} from 0.1 to 1000; write it again"):
            check_number("m.json", "frame_rate", value, *FRAME_RATES, remedy="write it again")
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
