"""Opening pickles of unknown origin without letting them run code.

A pickle is a program: it names functions and classes and has them called. :func:`load_pickle` resolves a fixed list of
names only, and puts harmless objects in the place of NumPy's own, because NumPy trusts the state that a pickle gives
its types: a crafted dtype turns bytes into object pointers. The objects that are called have no attributes, because a
pickle could set those of a function.

A pickle can also be a bomb: what it remembers under a number is repeated by two bytes. :func:`check_program` walks
through the program before any of it runs, what its calls copy is counted against the budget, and what comes out is
walked through once more.
"""

from __future__ import annotations

import mmap
import pickle  # noqa: S403 - for its exception only
import re
from collections import OrderedDict
from collections.abc import Collection
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from facediff.errors import FaceDiffError
from facediff.utils.limits import LIMITS, brief, check_array, check_nesting, quoted

PLAIN = re.compile(r"[<>|=]?(?:[biufc]\d{1,2}|[SU]\d+|\?)")
"""Types that arrays may have: plain numbers and text."""

OPCODES_PER_ENTRY = 8
"""Opcodes that a pickle may have for each entry of the budget; a number in a dict takes two to six."""

LONG_BYTES = 9
"""Bytes of the longest whole number, 64 bits and a sign; equal hashes of longer ones make a dict take hours."""

LINE = 40
"""Characters of the longest number or memo index in old pickles, which write them as text."""

_COPIED: ContextVar[list[int]] = ContextVar("_COPIED")
"""Bytes that the calls of the pickle being read have copied so far."""


def spend(count: int) -> None:
    """Count bytes that a call copies: calls can repeat, in a few bytes each, the largest thing in a pickle."""
    spent = _COPIED.get()
    spent[0] += count
    LIMITS.check("bytes", spent[0], "the pickle")


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
        spend(len(data))
        data = data.encode("latin1") if isinstance(data, str) else data
        dtype = real_type(kind)
        check_array("an array", tuple(shape), dtype.itemsize)
        super().__setstate__((version, shape, dtype, fortran, data))

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
        dtype = real_type(kind)
        check_array("an array", tuple(shape), dtype.itemsize)
        return np.frombuffer(buffer, dtype).reshape(shape, order="F" if order == "F" else "C")


class Scalar:
    """In place of NumPy's ``scalar``."""

    __slots__ = ()

    def __call__(self, kind: object, data: object) -> object:
        """One plain number or text."""
        if not isinstance(data, bytes | str):
            raise pickle.UnpicklingError("it holds a number in an unknown form")
        spend(len(data))
        data = data.encode("latin1") if isinstance(data, str) else data
        return np.frombuffer(data, real_type(kind), count=1)[0]


class NoBytes:
    """In place of ``bytes``, with which older pickles create the content of an empty array."""

    __slots__ = ()

    def __call__(self) -> bytes:
        """Nothing; an argument could request any amount of memory."""
        return b""


class Encode:
    """In place of ``_codecs.encode``, with which pickles of protocol 2 hold bytes."""

    __slots__ = ()

    def __call__(self, text: object, encoding: object) -> bytes:
        """Bytes from Latin-1; other codecs take long, or open modules."""
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError("it holds bytes in an unknown form")
        spend(len(text))
        return text.encode("latin1")


class PlainDict(OrderedDict[Any, Any]):
    """In place of ``collections.OrderedDict``; a pickle could copy a dict into the attributes of each of those."""

    __slots__ = ()

    def __init__(self, entries: Collection[Any] = ()) -> None:
        spend(HELD * len(entries))
        super().__init__(entries)

    def __setstate__(self, state: object) -> None:
        """None is known."""
        raise pickle.UnpicklingError("it holds a dict in an unknown form")


HELD = 64
"""Bytes that a dict or a set takes for an entry, at least."""


class MakeSet:
    """In place of ``set``."""

    __slots__ = ()

    def __call__(self, entries: Collection[Any] = ()) -> set[Any]:
        """The set of some entries."""
        spend(HELD * len(entries))
        return set(entries)


class MakeFrozenSet:
    """In place of ``frozenset``."""

    __slots__ = ()

    def __call__(self, entries: Collection[Any] = ()) -> frozenset[Any]:
        """The set of some entries."""
        spend(HELD * len(entries))
        return frozenset(entries)


SAFE: dict[tuple[str, str], Any] = {
    ("_codecs", "encode"): Encode(),
    ("collections", "OrderedDict"): PlainDict,
    **{(module, "set"): MakeSet() for module in ("builtins", "__builtin__")},
    **{(module, "frozenset"): MakeFrozenSet() for module in ("builtins", "__builtin__")},
    **{(module, "bytes"): NoBytes() for module in ("builtins", "__builtin__")},
    ("numpy", "ndarray"): ArrayType(),
    ("numpy", "dtype"): PlainType,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): Reconstruct() for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): Scalar() for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): FromBuffer() for core in ("core", "_core")},
}
"""What replaces each of NumPy's names that a pickle may ask for."""

ALLOWED = {("builtins", "complex"), ("__builtin__", "complex")}


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

    def __call__(self, kind: object, base: object, state: object) -> StandIn:
        if not (isinstance(kind, type) and issubclass(kind, StandIn)):
            raise pickle.UnpicklingError("it creates an object in an unknown way")
        return kind()


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
            raise pickle.UnpicklingError(f"it asks for {brief(f'{module}.{name}')}")
        return super().find_class(module, name)


def load_pickle(path: Path, *, stand_ins: tuple[str, ...] = ()) -> Any:  # noqa: ANN401
    """Read a pickle that holds NumPy arrays and plain containers.

    Files written by Python 2 are read as Latin-1, as all projects of the field do.

    Args:
        path: the file.
        stand_ins: packages (``scipy.sparse``) whose objects become :class:`StandIn`.

    Raises:
        FaceDiffError: if the file is missing, is no pickle, expands to more than the budget, or asks for anything else;
            nothing of it has been run.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; expected a pickle with NumPy arrays")
    token = _COPIED.set([0])
    try:
        with path.open("rb") as stream:
            with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as program:
                check_program(program, path)
            unpickler = PlainUnpickler(stream, encoding="latin1")
            unpickler.stand_ins = stand_ins
            loaded = unpickler.load()
        check_nesting(loaded, path, _held)
    except Exception as error:
        raise FaceDiffError(
            f"{path}: not a pickle of plain NumPy arrays ({brief(str(error).removeprefix(f'{path}: '))}); it was not "
            f"run. Expected the file as the data set's authors distribute it"
        ) from error
    finally:
        _COPIED.reset(token)
    return loaded


def _held(value: object) -> Collection[object] | None:
    """What a stand-in holds; None for anything else."""
    return (value.arguments, value.state) if isinstance(value, StandIn) else None


def check_program(data: bytes | mmap.mmap, source: object, *, long_bytes: int = LONG_BYTES) -> None:
    """Walk through a pickle without running it, and refuse what only bombs have.

    Refused are arguments that reach beyond the end of the file, of which the reader would allocate the declared length;
    memo indices far beyond the number of opcodes, up to which it would fill a table; numbers of too many bits; and more
    opcodes than the budget has entries for. The opcodes are those that :mod:`pickletools` knows, so that a new one is
    walked over, or refused, like the others.

    Args:
        data: the pickle.
        source: the file, for the message.
        long_bytes: of the longest whole number.

    Raises:
        UnpicklingError: if it is no pickle, or one of these.
    """
    import pickletools

    opcodes = {ord(opcode.code): opcode for opcode in pickletools.opcodes}
    lengths = {-2: 1, -3: 4, -4: 4, -5: 8}  # bytes of the length that precedes an argument
    most = OPCODES_PER_ENTRY * LIMITS.entries
    at = count = 0
    while True:
        opcode = opcodes.get(data[at]) if at < len(data) else None
        if opcode is None:
            raise pickle.UnpicklingError("it ends too early, or holds an unknown opcode")
        if opcode.code == ".":
            return
        at, count = at + 1, count + 1
        if count > most:
            LIMITS.check("entries", count // OPCODES_PER_ENTRY, source)
        argument = opcode.arg
        if argument is None:
            continue
        start = at
        if argument.n >= 0:
            at += argument.n
        elif argument.n == -1:
            for _ in range(2 if argument.name.endswith("_pair") else 1):
                at = data.find(b"\n", at) + 1 or len(data) + 1
        else:
            start = at + lengths[argument.n]
            at = start + int.from_bytes(data[at:start], "little")
        if at > len(data):
            raise pickle.UnpicklingError("it is cut short, or declares more bytes than it has")
        if opcode.name == "FRAME" and int.from_bytes(data[start:at], "little") > len(data) - at:
            raise pickle.UnpicklingError("it is cut short, or declares more bytes than it has")
        if opcode.name in ("LONG1", "LONG4") and at - start > long_bytes:
            raise pickle.UnpicklingError(f"it holds a whole number of more than {8 * (long_bytes - 1)} bits")
        if opcode.name in ("INT", "LONG", "FLOAT", "PUT", "GET") and at - start > LINE:
            raise pickle.UnpicklingError(f"it holds the number {quoted(data[start : start + LINE])}")
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT"):
            index = int(data[start:at]) if opcode.name == "PUT" else int.from_bytes(data[start:at], "little")
            if index > 2 * count + 256:
                raise pickle.UnpicklingError("it remembers under numbers that no pickle reaches")
