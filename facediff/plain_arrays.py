"""What NumPy's own classes are replaced by when a pickle from elsewhere is opened.

NumPy trusts the state that a pickle gives its types: a crafted dtype turns bytes into object pointers. Here a dtype is
kept as words until it is known to be a plain number or text, and only then made.
"""

from __future__ import annotations

import pickle  # noqa: S403 - for its exception only
import re
from typing import Any

import numpy as np

PLAIN = re.compile(r"[<>|=]?(?:[biufc]\d{1,2}|[SU]\d+|\?)")


class PlainType:
    """In place of ``numpy.dtype``: the words for it, checked when they are used."""

    __slots__ = ("order", "words")

    def __init__(self, words: object, *flags: object) -> None:
        self.words, self.order = words, "="

    def __setstate__(self, state: object) -> None:
        """Version, byte order, then what only structured types have."""
        plain = isinstance(state, tuple) and len(state) >= 5 and state[2:5] == (None, None, None)
        if not plain or not isinstance(state, tuple) or state[1] not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("it holds an array of a structured type")
        self.order = state[1]


class PlainArray(np.ndarray[Any, Any]):
    """An array whose state may only be of a plain type."""

    def __setstate__(self, state: object) -> None:
        """Version, shape, type, order, bytes."""
        if not isinstance(state, tuple) or len(state) != 5 or not isinstance(state[4], bytes | str):
            raise pickle.UnpicklingError("it holds an array in an unknown form")
        version, shape, kind, fortran, data = state
        data = data.encode("latin1") if isinstance(data, str) else data
        super().__setstate__((version, shape, real_type(kind), fortran, data))

    def __reduce_ex__(self, protocol: Any) -> Any:  # noqa: ANN401
        """Written anew it is an array like any other."""
        return self.view(np.ndarray).__reduce_ex__(protocol)


def real_type(kind: object) -> np.dtype[Any]:
    """The dtype that a :class:`PlainType` stands for."""
    words = kind.words if isinstance(kind, PlainType) else None
    if not isinstance(words, str) or not isinstance(kind, PlainType) or not PLAIN.fullmatch(words):
        raise pickle.UnpicklingError(f"it holds an array of the type {words!r}")
    made = np.dtype(words)
    if kind.order not in ("<", ">"):
        return made
    return np.dtype(made.newbyteorder(">" if kind.order == ">" else "<").str)


class ArrayType:
    """In place of ``numpy.ndarray``, which pickles name but do not call."""

    __slots__ = ()


class Reconstruct:
    """In place of NumPy's ``_reconstruct``; an object without attributes, since a pickle could set a function's."""

    __slots__ = ()

    def __call__(self, subtype: object, shape: object, code: object) -> PlainArray:
        """An empty array, filled by its state."""
        return PlainArray((0,), np.uint8)


class FromBuffer:
    """In place of NumPy's ``_frombuffer``, by which newer pickles make arrays."""

    __slots__ = ()

    def __call__(
        self, buffer: object, kind: object, shape: tuple[int, ...], order: str, *rest: object
    ) -> np.ndarray[Any, Any]:
        """An array of a plain type from bytes."""
        if not isinstance(buffer, bytes | bytearray) or order not in ("C", "F") or rest not in ((), (None,)):
            raise pickle.UnpicklingError("it holds an array in an unknown form")
        return np.frombuffer(buffer, real_type(kind)).reshape(shape, order="F" if order == "F" else "C")


class Scalar:
    """In place of NumPy's ``scalar``."""

    __slots__ = ()

    def __call__(self, kind: object, data: object) -> object:
        """One plain number or text."""
        data = data.encode("latin1") if isinstance(data, str) else data
        if not isinstance(data, bytes):
            raise pickle.UnpicklingError("it holds a number in an unknown form")
        return np.frombuffer(data, real_type(kind), count=1)[0]


class NoBytes:
    """In place of ``bytes``, by which older pickles make the content of an empty array."""

    __slots__ = ()

    def __call__(self) -> bytes:
        """Nothing; a number would ask for so much memory."""
        return b""


SAFE: dict[tuple[str, str], Any] = {
    ("__builtin__", "bytes"): NoBytes(),
    ("builtins", "bytes"): NoBytes(),
    ("numpy", "ndarray"): ArrayType(),
    ("numpy", "dtype"): PlainType,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): Reconstruct() for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): Scalar() for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): FromBuffer() for core in ("core", "_core")},
}
"""What is given in the place of each name of NumPy's that a pickle may ask for."""
