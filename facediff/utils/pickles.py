"""Opening other projects' pickles without letting them run code.

A pickle is a program: it names functions and classes and has them called. :func:`load_pickle` resolves a fixed list of
names only, and puts harmless objects in the place of NumPy's own, because NumPy trusts the state that a pickle gives
its types: a crafted dtype turns bytes into object pointers. The names stand for bound methods and for Python's own
types, since a pickle could set the attributes of a function or a class of ours.
"""

from __future__ import annotations

import pickle  # noqa: S403 - restricted below
import re
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from facediff.errors import damaged
from facediff.utils.limits import brief

PLAIN = re.compile(r"[<>|=]?(?:[biufc]\d{1,2}|[SU]\d+|\?)")
"""Types that arrays may have: plain numbers and text."""


class PlainType:
    """In place of a ``numpy.dtype``: its name, from which the type is created once that is known to be plain."""

    def __init__(self, name: object) -> None:
        self.name = name
        self.order: Any = "="

    def __setstate__(self, state: Any) -> None:  # noqa: ANN401
        """Version, byte order, then fields that only structured types have."""
        if state[2:5] != (None, None, None):
            raise pickle.UnpicklingError("it holds an array of a structured type")
        self.order = state[1]

    def dtype(self) -> np.dtype[Any]:
        """The type itself."""
        if not isinstance(self.name, str) or not PLAIN.fullmatch(self.name) or self.order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(f"it holds an array of the type {self.name!r}")
        plain = np.dtype(self.name)
        # The same object as NumPy's own where the order is the machine's, as in arrays that were never pickled.
        return np.dtype(plain.newbyteorder(self.order).str) if self.order in "<>" else plain


class PlainArray(np.ndarray[Any, Any]):
    """An array that takes only a state of a plain type."""

    def __setstate__(self, state: Any) -> None:  # noqa: ANN401
        """Version, shape, type, order, bytes."""
        version, shape, kind, fortran, data = state
        super().__setstate__((version, shape, kind.dtype(), fortran, as_bytes(data)))

    def __reduce_ex__(self, protocol: Any) -> Any:  # noqa: ANN401
        """Pickled again, it is an ordinary array."""
        return self.view(np.ndarray).__reduce_ex__(protocol)


def as_bytes(data: object) -> bytes:
    """Bytes, which Python 2 wrote as text; a list in their place would become an array of objects."""
    if not isinstance(data, bytes | bytearray | str):
        raise pickle.UnpicklingError("it holds an array in an unknown form")
    return data.encode("latin1") if isinstance(data, str) else bytes(data)


class Makers:
    """In place of the functions and classes with which pickles make arrays and plain containers."""

    __slots__ = ()

    def make_dtype(self, name: object, *flags: object) -> PlainType:
        """``numpy.dtype``."""
        return PlainType(name)

    def make_array(self, *arguments: object) -> PlainArray:
        """``numpy.core.multiarray._reconstruct``: an empty array, filled by its state."""
        return PlainArray((0,), np.uint8)

    def make_array_of_buffer(
        self, buffer: object, kind: PlainType, shape: tuple[int, ...], order: Literal["C", "F"], *axes: object
    ) -> np.ndarray[Any, Any]:
        """``numpy.core.numeric._frombuffer``, with which newer pickles make arrays."""
        return np.frombuffer(as_bytes(buffer), kind.dtype()).reshape(shape, order=order)

    def make_scalar(self, kind: PlainType, data: object) -> object:
        """``numpy.core.multiarray.scalar``: one plain number or text."""
        return np.frombuffer(as_bytes(data), kind.dtype(), count=1)[0]

    def make_ndarray(self) -> None:
        """``numpy.ndarray``, which pickles name as an argument but do not call."""

    def encode(self, text: str, encoding: object) -> bytes:
        """``_codecs.encode``, with which pickles of protocol 2 hold bytes; other codecs open modules."""
        return text.encode("latin1")

    def make_bytes(self) -> bytes:
        """``bytes``, with which older pickles make the content of an empty array."""
        return b""

    def make_object(self, kind: type[StandIn], *base: object) -> StandIn:
        """``copyreg._reconstructor``, with which old pickles make their objects."""
        if not issubclass(kind, StandIn):
            raise pickle.UnpicklingError("it creates an object in an unknown way")
        return kind()


class StandIn:
    """Takes the place of an object of another package: keeps the pickle's arguments and state, and does nothing."""

    origin: ClassVar[str] = ""  # the name in the pickle, e.g. chumpy.ch.Ch
    arguments: tuple[object, ...]
    state: object = None

    def __new__(cls, *arguments: object) -> StandIn:
        """Keep the arguments."""
        stand_in = super().__new__(cls)
        stand_in.arguments = arguments
        return stand_in

    def __setstate__(self, state: object) -> None:
        """Keep the state."""
        self.state = state


MAKERS = Makers()
BUILTINS = ("builtins", "__builtin__")
NAMES: dict[tuple[str, str], Any] = {
    ("_codecs", "encode"): MAKERS.encode,
    ("collections", "OrderedDict"): dict,
    ("numpy", "ndarray"): MAKERS.make_ndarray,
    ("numpy", "dtype"): MAKERS.make_dtype,
    **{(module, kind.__name__): kind for module in BUILTINS for kind in (set, frozenset, complex)},
    **{(module, "bytes"): MAKERS.make_bytes for module in BUILTINS},
    **{(f"numpy.{core}.multiarray", "_reconstruct"): MAKERS.make_array for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): MAKERS.make_scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): MAKERS.make_array_of_buffer for core in ("core", "_core")},
}
"""All names that a pickle may ask for."""

NAMES_OF_OBJECTS: dict[tuple[str, str], Any] = {
    **{(module, "_reconstructor"): MAKERS.make_object for module in ("copyreg", "copy_reg")},
    **{(module, "object"): object for module in BUILTINS},
}
"""Further names in pickles of objects that become stand-ins."""


class PlainUnpickler(pickle.Unpickler):
    """Unpickles NumPy arrays and plain containers, and nothing else."""

    stand_ins: tuple[str, ...] = ()

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        """The harmless object for a name; nothing is imported."""
        if any(module == package or module.startswith(f"{package}.") for package in self.stand_ins):
            return type("StandIn", (StandIn,), {"origin": f"{module}.{name}"})
        names = {**NAMES, **NAMES_OF_OBJECTS} if self.stand_ins else NAMES
        if (module, name) not in names:
            raise pickle.UnpicklingError(f"it asks for {brief(f'{module}.{name}')}")
        return names[module, name]


def load_pickle(path: Path, *, stand_ins: tuple[str, ...] = ()) -> Any:  # noqa: ANN401
    """Read a pickle that holds NumPy arrays and plain containers; of Python 2, as Latin-1, as the field does.

    Objects of the packages ``stand_ins`` (``scipy.sparse``) become :class:`StandIn`.
    """
    remedy = "it was not run. Expected the file as the data set's authors distribute it"
    with damaged(f"{path}: not a pickle of plain NumPy arrays", remedy, Exception), path.open("rb") as stream:
        unpickler = PlainUnpickler(stream, encoding="latin1")
        unpickler.stand_ins = stand_ins
        return unpickler.load()
