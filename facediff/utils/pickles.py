"""Opening pickles from elsewhere without letting them run code."""

from __future__ import annotations

import pickle  # noqa: S403 - for its exception only
import re
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from facediff.errors import FaceDiffError

# What replaces NumPy's own classes when a pickle from elsewhere is opened.
#
# NumPy trusts the state that a pickle gives its types: a crafted dtype turns bytes into object pointers. Here a dtype
# is kept as text until it is known to be a plain number or text, and only then created.

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


ALLOWED = {
    ("_codecs", "encode"),
    ("collections", "OrderedDict"),
    ("builtins", "set"),
    ("builtins", "frozenset"),
    ("builtins", "complex"),
    ("__builtin__", "set"),
    ("__builtin__", "frozenset"),
}


class StandIn:
    """Takes the place of an object of a foreign package: keeps what the pickle says of it, and does nothing.

    Attributes:
        origin: what the pickle asked for, e.g. ``chumpy.ch.Ch``.
        arguments: what it would have been called with.
        state: its state; None if the pickle gives none.
    """

    origin: ClassVar[str] = ""
    arguments: tuple[object, ...]
    state: object

    def __new__(cls, *arguments: object) -> StandIn:
        """Keep the arguments."""
        made = super().__new__(cls)
        made.arguments, made.state = arguments, None
        return made

    def __setstate__(self, state: object) -> None:
        """Keep the state."""
        self.state = state


@lru_cache(maxsize=256)
def _stand_in(origin: str) -> type[StandIn]:
    return type("StandIn", (StandIn,), {"origin": origin})


class _Reconstructor:
    """In place of ``copyreg._reconstructor``, by which old pickles make their objects.

    An object without attributes: a pickle could set attributes of a function.
    """

    __slots__ = ()

    def __call__(self, wanted: object, base: object, state: object) -> StandIn:
        if not (isinstance(wanted, type) and issubclass(wanted, StandIn)):
            raise pickle.UnpicklingError("it makes an object in an unknown way")
        return wanted()


FOR_STAND_INS: dict[tuple[str, str], Any] = {
    ("copy_reg", "_reconstructor"): _Reconstructor(),
    ("copyreg", "_reconstructor"): _Reconstructor(),
    ("__builtin__", "object"): object,
    ("builtins", "object"): object,
}


class PlainUnpickler(pickle.Unpickler):
    """Unpickles NumPy arrays and plain containers, and nothing else.

    Attributes:
        stand_ins: packages whose objects become :class:`StandIn`; nothing of these packages is imported.
    """

    stand_ins: tuple[str, ...] = ()

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        """Allow the names in :data:`ALLOWED` only, and put stand-ins in the place of what ``stand_ins`` names."""
        if any(module == package or module.startswith(f"{package}.") for package in self.stand_ins):
            return _stand_in(f"{module}.{name}")
        if self.stand_ins and (module, name) in FOR_STAND_INS:
            return FOR_STAND_INS[module, name]
        if (module, name) in SAFE:
            return SAFE[module, name]
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return super().find_class(module, name)


def load_pickle(path: Path, *, stand_ins: tuple[str, ...] = ()) -> Any:  # noqa: ANN401
    """Read a pickle that holds NumPy arrays and plain containers.

    Files written by Python 2 are read as Latin-1, as every project of the field does.

    Args:
        path: the file.
        stand_ins: packages (``scipy.sparse``) whose objects are given out as :class:`StandIn`.

    Raises:
        FaceDiffError: if the file is missing, is no pickle, or asks for anything else; nothing of it has been run.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; expected a pickle with NumPy arrays")
    with path.open("rb") as stream:
        try:
            unpickler = PlainUnpickler(stream, encoding="latin1")
            unpickler.stand_ins = stand_ins
            return unpickler.load()
        except Exception as error:
            raise FaceDiffError(
                f"{path}: not a pickle of plain NumPy arrays ({error}); it was not run. Expected the file as the "
                f"data set's authors distribute it"
            ) from error
