"""Opening pickles of unknown origin without letting them run code.

A pickle is a program: it names functions and classes and has them called. :func:`load_pickle` resolves a fixed list of
names only, and puts harmless objects in the place of NumPy's own, because NumPy trusts the state that a pickle gives
its types: a crafted dtype turns bytes into object pointers. The objects that are called have no attributes, because a
pickle could set those of a function.
"""

from __future__ import annotations

import pickle  # noqa: S403 - for its exception only
import re
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from facediff.errors import FaceDiffError

PLAIN = re.compile(r"[<>|=]?(?:[biufc]\d{1,2}|[SU]\d+|\?)")
"""Types that arrays may have: plain numbers and text."""


class PlainType:
    """In place of ``numpy.dtype``: its name, from which the type is created once that is known to be plain."""

    __slots__ = ("name", "order")

    def __init__(self, name: object, *flags: object) -> None:
        self.name, self.order = name, "="

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
        """Pickled again, it is an ordinary array."""
        return self.view(np.ndarray).__reduce_ex__(protocol)


def real_type(kind: object) -> np.dtype[Any]:
    """The dtype that a :class:`PlainType` stands for."""
    name = kind.name if isinstance(kind, PlainType) else None
    if not isinstance(name, str) or not isinstance(kind, PlainType) or not PLAIN.fullmatch(name):
        raise pickle.UnpicklingError(f"it holds an array of the type {name!r}")
    plain = np.dtype(name)
    if kind.order not in ("<", ">"):
        return plain
    return np.dtype(plain.newbyteorder(">" if kind.order == ">" else "<").str)


class ArrayType:
    """In place of ``numpy.ndarray``, which pickles name as an argument but do not call."""

    __slots__ = ()


class Reconstruct:
    """In place of NumPy's ``_reconstruct``."""

    __slots__ = ()

    def __call__(self, subtype: object, shape: object, code: object) -> PlainArray:
        """An empty array, filled by its state."""
        return PlainArray((0,), np.uint8)


class FromBuffer:
    """In place of NumPy's ``_frombuffer``, with which newer pickles create arrays."""

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
    """In place of ``bytes``, with which older pickles create the content of an empty array."""

    __slots__ = ()

    def __call__(self) -> bytes:
        """Nothing; an argument could request any amount of memory."""
        return b""


SAFE: dict[tuple[str, str], Any] = {
    **{(module, "bytes"): NoBytes() for module in ("builtins", "__builtin__")},
    ("numpy", "ndarray"): ArrayType(),
    ("numpy", "dtype"): PlainType,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): Reconstruct() for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): Scalar() for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): FromBuffer() for core in ("core", "_core")},
}
"""What replaces each of NumPy's names that a pickle may ask for."""

ALLOWED = {
    ("_codecs", "encode"),
    ("collections", "OrderedDict"),
    ("builtins", "complex"),
    *((module, name) for module in ("builtins", "__builtin__") for name in ("set", "frozenset")),
}


class StandIn:
    """Takes the place of an object of another package: keeps what the pickle holds of it, and does nothing."""

    origin: ClassVar[str] = ""  # what the pickle asked for, e.g. chumpy.ch.Ch
    arguments: tuple[object, ...]
    state: object

    def __new__(cls, *arguments: object) -> StandIn:
        """Keep the arguments."""
        stand_in = super().__new__(cls)
        stand_in.arguments, stand_in.state = arguments, None
        return stand_in

    def __setstate__(self, state: object) -> None:
        """Keep the state."""
        self.state = state


@lru_cache(maxsize=256)
def _stand_in(origin: str) -> type[StandIn]:
    return type("StandIn", (StandIn,), {"origin": origin})


class _Reconstructor:
    """In place of ``copyreg._reconstructor``, with which old pickles create their objects."""

    __slots__ = ()

    def __call__(self, wanted: object, base: object, state: object) -> StandIn:
        if not (isinstance(wanted, type) and issubclass(wanted, StandIn)):
            raise pickle.UnpicklingError("it creates an object in an unknown way")
        return wanted()


FOR_STAND_INS: dict[tuple[str, str], Any] = {
    **{(module, "_reconstructor"): _Reconstructor() for module in ("copyreg", "copy_reg")},
    **{(module, "object"): object for module in ("builtins", "__builtin__")},
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

    Files written by Python 2 are read as Latin-1, as all projects of the field do.

    Args:
        path: the file.
        stand_ins: packages (``scipy.sparse``) whose objects become :class:`StandIn`.

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
