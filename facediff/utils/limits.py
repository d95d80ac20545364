"""Ranges of the numbers in files, marks of their formats, and values of theirs in messages."""

from __future__ import annotations

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
    """Refuse a file (``source``) with a mark of another format than this version writes."""
    if type(stated) is not type(expected) or stated != expected:
        raise FaceDiffError(
            f"{source}: its format is {quoted(stated)}; expected {expected!r}; update facediff if a later one wrote "
            f"it, or write it again"
        )


def in_range(array: npt.NDArray[Any]) -> bool:
    """Whether all numbers are finite, and none is larger than :data:`COORDINATE`."""
    # Minimum and maximum are NaN if any number is, and no comparison with NaN is true.
    return not array.size or bool(float(array.min()) >= -COORDINATE and float(array.max()) <= COORDINATE)
