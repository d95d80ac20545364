"""Ranges of the numbers in files, marks of their formats, and values of theirs in messages."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy.typing as npt

FRAME_RATES = (0.1, 1000.0)
"""Frames a second that motion may have."""

SAMPLE_RATES = (1000, 768_000)
"""Samples a second that speech may have; resampling multiplies the length of anything slower."""

COORDINATE = 1e12
"""Largest absolute coordinate, in any unit; squares and sums of larger ones leave the range of float32."""

WORDS_SHOWN = 60  # characters of a file's own text that a message repeats


def quoted(value: object) -> str:
    """A value from a file as a message may show it: short and on one line."""
    try:
        text = " ".join(repr(value).split())  # arrays and tensors take several lines
    except Exception:  # a whole number of more than 4300 digits has no decimal form; other objects may raise anything
        text = f"a {type(value).__name__}"
    return text if len(text) <= WORDS_SHOWN else f"{text[: WORDS_SHOWN - 1]}…"


def brief(error: object) -> str:
    """A library's words about a damaged file, as a message may repeat them: short and on one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    text = "".join(character if character.isprintable() else "?" for character in text)
    return text if len(text) <= 2 * WORDS_SHOWN else f"{text[: 2 * WORDS_SHOWN - 1]}…"


def check_format(source: object, stated: object, expected: str | int) -> None:
    """Refuse a file of another format than this version writes, above all a later one.

    Args:
        source: the file, for the message.
        stated: the file's mark of its format; a text that ends in a number (``facediff take 1``), or a number.
        expected: the mark that this version writes.
    """
    if type(stated) is type(expected) and stated == expected:
        return
    mark, other_mark = _split_format(expected), _split_format(stated)
    later = mark is not None and other_mark is not None and other_mark[0] == mark[0] and other_mark[1] > mark[1]
    advice = "it was written by a later version, update facediff" if later else "write the file again"
    raise FaceDiffError(f"{source}: its format is {quoted(stated)}; expected {expected!r}; {advice}")


def _split_format(mark: object) -> tuple[str, int] | None:
    """The words and the number of a mark of a format; None if it is no such mark."""
    if isinstance(mark, int) and not isinstance(mark, bool):
        return "", mark
    match = re.fullmatch(r"(.*?) ?(\d{1,9})", mark) if isinstance(mark, str) else None
    return (match[1], int(match[2])) if match else None


def in_range(array: npt.NDArray[Any]) -> bool:
    """Whether all numbers are finite, and none is larger than :data:`COORDINATE`."""
    # Minimum and maximum are NaN if any number is, and no comparison with NaN is true.
    return not array.size or bool(float(array.min()) >= -COORDINATE and float(array.max()) <= COORDINATE)
