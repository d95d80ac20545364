"""How much an untrusted file may expand to, checked before memory is allocated.

A file of a few kilobytes can declare sizes of terabytes. Every reader compares what a file declares with one budget,
:data:`LIMITS`, before it believes the file. Whoever needs more raises a limit by an environment variable.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy.typing as npt


@dataclass(frozen=True)
class Limits:
    """The budget of one file from elsewhere. ``FACEDIFF_MAX_<NAME>`` overrides a limit.

    Attributes:
        bytes: memory that its arrays may take, 4 GiB.
        seconds: length of speech, 6 hours.
        vertices: vertices or faces of a mesh, two million.
        frames: frames of a motion, three million (a day at 30 frames a second).
        identities: identities of a checkpoint or corpus, 100 000.
        nesting: depth of lists and dicts, 64.
        entries: entries of a list, a table or an archive, two million.
        computing: seconds that a graph may compute for each begun second of speech, 60.
    """

    bytes: float = 4 * 2**30
    seconds: float = 6 * 3600
    vertices: float = 2_000_000
    frames: float = 3_000_000
    identities: float = 100_000
    nesting: float = 64
    entries: float = 2_000_000
    computing: float = 60

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Limits:
        """The limits, with those replaced that an environment variable states.

        Raises:
            FaceDiffError: if a variable is not a positive number.
        """
        limits: dict[str, float] = {}
        for field in fields(cls):
            variable = f"FACEDIFF_MAX_{field.name.upper()}"
            text = environment.get(variable)
            if text is None:
                continue
            try:
                limits[field.name] = float(text)
            except ValueError:
                limits[field.name] = math.nan
            if not limits[field.name] > 0:
                raise FaceDiffError(f"{variable}={text}: not a valid limit; expected a positive number")
        return cls(**limits)

    def check(self, what: str, count: float, source: object) -> None:
        """Refuse a count above a limit.

        Args:
            what: the limit's name.
            count: what the file declares.
            source: the file, for the message.
        """
        limit = getattr(self, what)
        if not 0 <= count <= limit:
            # A product of declared sizes may have more digits than Python agrees to write.
            huge = isinstance(count, int) and abs(count) > 1 << 64
            shown = "more than 10^19" if huge else f"{count:g}" if isinstance(count, float) else str(count)
            raise FaceDiffError(
                f"{source}: declares {shown} {what}; expected 0 to {limit:g}. If you trust the file, set "
                f"FACEDIFF_MAX_{what.upper()} to a larger number"
            )


LIMITS = Limits.from_environment()

FRAME_RATES = (0.1, 1000.0)
"""Frames a second that motion may have."""

SAMPLE_RATES = (1000, 768_000)
"""Samples a second that speech may have; resampling multiplies the length of anything slower."""

COORDINATE = 1e12
"""Largest absolute coordinate, in any unit; squares and sums of larger ones leave the range of float32."""

WORDS_SHOWN = 60  # characters of a file's own text that a message repeats


def quoted(value: object) -> str:
    """A value from a file as a message may show it: short, on one line, and whatever it is."""
    try:
        text = " ".join(repr(value).split())  # arrays and tensors take several lines
    except Exception:  # a whole number of more than 4300 digits has no decimal form; other objects may raise anything
        text = f"a {type(value).__name__}"
    return text if len(text) <= WORDS_SHOWN else f"{text[: WORDS_SHOWN - 1]}…"


def brief(error: object) -> str:
    """What a library says of a damaged file, as a message may repeat it: short and on one line."""
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
    ours, theirs = _split_format(expected), _split_format(stated)
    later = ours is not None and theirs is not None and theirs[0] == ours[0] and theirs[1] > ours[1]
    advice = "it was written by a later version, update facediff" if later else "write the file again"
    raise FaceDiffError(f"{source}: its format is {quoted(stated)}; expected {expected!r}; {advice}")


def _split_format(mark: object) -> tuple[str, int] | None:
    """The words and the number of a mark of a format; None if it is no such mark."""
    if isinstance(mark, int) and not isinstance(mark, bool):
        return "", mark
    match = re.fullmatch(r"(.*?) ?(\d{1,9})", mark) if isinstance(mark, str) else None
    return (match[1], int(match[2])) if match else None


def check_array(source: object, shape: tuple[int, ...], item_bytes: int) -> None:
    """Refuse a declared array that would not fit into the budget.

    Raises:
        FaceDiffError: if a size is negative, or the array is larger than :attr:`Limits.bytes`.
    """
    if any(size < 0 for size in shape):
        raise FaceDiffError(f"{source}: declares an array of shape {quoted(shape)}; the file is damaged")
    # An axis of length 0 takes no memory, but a walk along the other axes takes its time.
    LIMITS.check("bytes", math.prod(max(1, size) for size in shape) * max(1, item_bytes), source)


def in_range(array: npt.NDArray[Any]) -> bool:
    """Whether all numbers are finite, and none is larger than :data:`COORDINATE`."""
    # Minimum and maximum are NaN if any number is, and no comparison with NaN is true.
    return not array.size or bool(float(array.min()) >= -COORDINATE and float(array.max()) <= COORDINATE)


_LEAVES = {str, bytes, int, float, bool, type(None)}
"""What holds nothing: :func:`check_nesting` passes over it quickly."""


def check_nesting(
    value: object, source: object, parts: Callable[[object], Collection[object] | None] | None = None
) -> None:
    """Refuse plain data that is nested too deeply or has too many entries; walks without recursion.

    What is shared counts as often as it is seen: that is what a walk or a conversion to an array costs.

    Args:
        value: dicts, lists, tuples and sets.
        source: the file, for the message.
        parts: what objects of other types hold; None for those that it does not know.
    """
    level, count, depth = [value], 1, 0
    while level:
        LIMITS.check("nesting", depth, source)
        inner: list[object] = []
        for item in level:
            held = parts(item) if parts is not None else None
            if isinstance(item, dict):
                held = item.values()
            elif isinstance(item, list | tuple | set | frozenset):
                held = item
            if held is None:
                continue
            # Counted before it is kept: lists that share their entries multiply.
            count += len(held)
            if count > LIMITS.entries:
                LIMITS.check("entries", count, source)
            inner += [part for part in held if type(part) not in _LEAVES]
        level, depth = inner, depth + 1
