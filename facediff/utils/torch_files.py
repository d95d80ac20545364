"""Files of ``torch.save`` from elsewhere: what they declare is checked before anything is allocated.

Such a file is a zip archive with a pickle (``data.pkl``) and one entry of bytes for each storage. ``torch.load`` with
``weights_only=True`` runs no code of a file, but believes its sizes: the length of a storage comes from the pickle, not
from the archive, and reading past the end of the bytes ends the process. So the archive's directory is checked first,
then the pickle is read once with outlines in place of tensors; PyTorch sees only a file in which all sizes agree.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import sys
import warnings
import zipfile
from collections import Counter, OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, ClassVar

from facediff.errors import FaceDiffError
from facediff.utils.limits import LIMITS, check_nesting, quoted
from facediff.utils.pickles import check_program

STATE_BYTES = 17
"""Bytes of the longest whole number: 128 bits and a sign, as the states of random numbers have them."""

PICKLE_BYTES = 64 * 2**20
"""Most bytes of ``data.pkl``: names, numbers and the outlines of tensors, not their values."""

EXPECTED = "expected a .ckpt file that `facediff fit` has written"

MAGIC = b"PK\x03\x04"
LOCAL_HEADER = 30  # bytes of a zip entry's own header, without its name

STORAGES = {
    **dict.fromkeys(("DoubleStorage", "LongStorage"), 8),
    **dict.fromkeys(("FloatStorage", "IntStorage"), 4),
    **dict.fromkeys(("HalfStorage", "BFloat16Storage", "ShortStorage"), 2),
    **dict.fromkeys(("ByteStorage", "CharStorage", "BoolStorage", "UntypedStorage"), 1),
}
"""Bytes of a number in the storages that may occur; complex and quantised ones may not."""

TYPES = {
    **dict.fromkeys(("float64", "int64", "uint64"), 8),
    **dict.fromkeys(("float32", "int32", "uint32"), 4),
    **dict.fromkeys(("float16", "bfloat16", "int16", "uint16"), 2),
    **dict.fromkeys(("int8", "uint8", "bool", "float8_e4m3fn", "float8_e5m2"), 1),
}
"""Bytes of a number of the types that may occur."""


Declared = Any
"""What a file states, of whatever type."""


@dataclass(frozen=True)
class NumberType:
    """In place of a type of numbers or of the class of a storage: the bytes of one number."""

    bytes: int


@dataclass(frozen=True)
class Storage:
    """In place of a storage: its bytes, and those of one of its numbers."""

    bytes: int
    item: int


@dataclass(frozen=True)
class TensorOutline:
    """In place of a tensor: what it takes in memory."""

    bytes: int


class PlainOrderedDict(OrderedDict[Any, Any]):
    """In place of ``OrderedDict``, whose attributes a pickle may set and so hide its methods."""

    def __setstate__(self, state: object) -> None:
        """Only modules' versions, which ``state_dict()`` adds."""
        if not isinstance(state, dict) or set(state) - {"_metadata"}:
            raise pickle.UnpicklingError("it sets attributes of a dict")


class OutlineReader(pickle._Unpickler):  # C's unpickler reserves whatever memory a file asks for
    """Reads ``data.pkl`` with an :class:`TensorOutline` in place of every tensor; makes nothing but plain data.

    Args:
        stream: the pickle.
        entries: bytes of every storage by its key.
    """

    names: ClassVar[dict[tuple[str, str], Any]] = {
        ("collections", "OrderedDict"): PlainOrderedDict,
        ("collections", "Counter"): Counter,
        ("builtins", "set"): set,
        ("__builtin__", "set"): set,
        ("torch", "Size"): tuple,
        ("torch", "device"): lambda *words: words,
        **{("torch", name): NumberType(size) for name, size in {**STORAGES, **TYPES}.items()},
        ("torch.storage", "UntypedStorage"): NumberType(1),
    }

    folder = ""

    def __init__(self, stream: IO[bytes], entries: Mapping[str, int]) -> None:
        super().__init__(stream)
        self._entries = entries
        self.bytes = 0
        self._rebuild = {
            "_rebuild_tensor_v2": self._tensor,
            "_rebuild_tensor_v3": self._tensor_of_type,
            "_rebuild_parameter": self._parameter,
        }

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        """The stand-in for a name; nothing is imported."""
        if module == "torch._utils" and name in self._rebuild:
            return self._rebuild[name]
        if (module, name) not in self.names:
            raise pickle.UnpicklingError(f"it asks for {quoted(f'{module}.{name}')}")
        return self.names[module, name]

    def persistent_load(self, pid: Any) -> Storage:  # noqa: ANN401
        """A storage, once its length agrees with its bytes."""
        word, kind, key, _, length = pid
        if word != "storage" or not isinstance(kind, NumberType) or not isinstance(key, str) or not is_size(length):
            raise pickle.UnpicklingError("it holds numbers in an unknown form")
        if length and length * kind.bytes != self._entries.get(key, -1):
            raise pickle.UnpicklingError(f"its numbers {quoted(key)} are fewer or more than it declares")
        return Storage(length * kind.bytes, kind.bytes)

    def _tensor(self, storage: Storage, *form: Declared) -> TensorOutline:
        offset, shape, stride, _, hooks, *metadata = form
        return self._outline(storage, storage.item, offset, shape, stride, [hooks, *metadata])

    def _tensor_of_type(self, storage: Storage, *form: Declared) -> TensorOutline:
        offset, shape, stride, _, hooks, kind, *metadata = form
        return self._outline(storage, kind.bytes, offset, shape, stride, [hooks, *metadata])

    def _outline(
        self, storage: Storage, item: int, offset: Declared, shape: Declared, stride: Declared, more: list[Any]
    ) -> TensorOutline:
        plain = isinstance(storage, Storage) and isinstance(shape, tuple) and isinstance(stride, tuple)
        if not plain or any(more) or len(shape) != len(stride):
            raise pickle.UnpicklingError("it holds a tensor in an unknown form")
        if not all(map(is_size, (offset, *shape, *stride))):
            raise pickle.UnpicklingError("it holds a tensor of an impossible size")
        count = math.prod(shape)
        last = offset + sum((size - 1) * step for size, step in zip(shape, stride, strict=True)) + 1 if count else 0
        # A tensor that repeats its numbers is small here and huge wherever it is copied.
        if max(count, last) * item > storage.bytes:
            raise pickle.UnpicklingError("it holds a tensor that is larger than its numbers")
        self.bytes += count * item
        return TensorOutline(count * item)

    @staticmethod
    def _parameter(data: object, gradient: object, hooks: object) -> object:
        if not isinstance(data, TensorOutline) or hooks:
            raise pickle.UnpicklingError("it holds a parameter in an unknown form")
        return data


def is_size(value: object) -> bool:
    """Whether a value can be a size, a stride or an offset."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 62


@contextmanager
def open_checkpoint(file: str | os.PathLike[str] | IO[bytes]) -> Iterator[tuple[IO[bytes], str]]:
    """Open a checkpoint once, for reading it more than once; an open one is left open.

    Yields:
        the open file, and its name for messages.
    """
    if not isinstance(file, str | os.PathLike):
        yield file, str(getattr(file, "name", "checkpoint"))
        return
    if not os.path.isfile(file):  # noqa: PTH113 - also of a name with a NUL, which pathlib raises for
        raise FaceDiffError(f"{file}: no such checkpoint; {EXPECTED}")
    try:
        stream = Path(file).open("rb")  # noqa: SIM115 - closed below; only opening is guarded
    except OSError as error:
        raise FaceDiffError(f"{file}: cannot be read ({error.strerror}); {EXPECTED}") from error
    with stream:
        yield stream, str(file)


def load_tensors(stream: IO[bytes], source: object) -> Any:  # noqa: ANN401
    """The tensors and plain data of a file that ``torch.save`` wrote, on the CPU.

    Args:
        stream: the open file. It is read twice, so that both readings see the same file even if a running training
            replaces it.
        source: the file's name, for messages.
    """
    import torch

    try:
        outline = read_outline(stream, source)
        check_nesting(outline, source)
        check_numbers(outline)
        stream.seek(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.load(stream, map_location="cpu", weights_only=True)
    except FaceDiffError:
        raise
    except Exception as error:
        # Whatever a damaged or hostile file makes the readers raise, the reason is the file.
        reason = next(iter(str(error).strip().splitlines()), "") if isinstance(error, pickle.UnpicklingError) else ""
        detail = reason if 0 < len(reason) < 120 else "damaged, or more than tensors and plain values"
        raise FaceDiffError(f"{source}: not a checkpoint that can be loaded safely ({detail}); {EXPECTED}") from error


def read_outline(stream: IO[bytes], source: object, kind: type[OutlineReader] | None = None) -> object:
    """The content with outlines in place of tensors; see the module's docstring.

    Args:
        stream: the open file.
        source: the file's name, for messages.
        kind: what reads the pickle; :class:`OutlineReader` if None.

    Raises:
        FaceDiffError: if it needs more than the budget.
        pickle.UnpicklingError: if the archive or the pickle is none that ``torch.save`` writes.
    """
    stream.seek(0)
    if stream.read(len(MAGIC)) != MAGIC:
        # PyTorch's formats of before 2020 are pickles whose sizes stand nowhere before the numbers.
        raise pickle.UnpicklingError("it is no zip archive")
    length = stream.seek(0, io.SEEK_END)
    LIMITS.check("bytes", length, source)
    with zipfile.ZipFile(stream) as archive:
        entries = archive.infolist()
        LIMITS.check("entries", len(entries), source)
        check_directory(archive, entries, length)
        folder = entries[0].filename.partition("/")[0]
        sizes = {entry.filename: entry.file_size for entry in entries}
        name = f"{folder}/data.pkl"
        if sizes.get(name, PICKLE_BYTES) >= PICKLE_BYTES:
            raise pickle.UnpicklingError("its plain values are missing or too long")
        program = archive.read(name)
        # An opcode may declare any length, which the reader reserves before it finds that the file is shorter.
        check_program(program, source, long_bytes=STATE_BYTES)
        reader = (kind or OutlineReader)(
            io.BytesIO(program),
            {name.removeprefix(f"{folder}/data/"): size for name, size in sizes.items() if "/data/" in name},
        )
        reader.folder = folder
        outline: object = reader.load()
    LIMITS.check("bytes", reader.bytes, source)
    return outline


def check_directory(archive: zipfile.ZipFile, entries: list[zipfile.ZipInfo], length: int) -> None:
    """Refuse an archive that another reader could understand in another way, or that expands.

    ``torch.save`` compresses nothing, writes one entry after the other from the first byte on, and one of each name.

    Raises:
        pickle.UnpicklingError: if this archive is different.
    """
    end = 0
    for entry in sorted(entries, key=lambda entry: entry.header_offset):
        stored = entry.compress_type == zipfile.ZIP_STORED and entry.file_size == entry.compress_size
        if not stored or entry.header_offset < end or entry.flag_bits & 1:
            raise pickle.UnpicklingError("its archive is compressed or its entries overlap")
        end = entry.header_offset + LOCAL_HEADER + len(entry.filename) + entry.file_size
    names = {entry.filename.lower() for entry in entries}  # PyTorch's reader does not distinguish capitals
    if end > length or len(names) < len(entries) or archive.comment or min(e.header_offset for e in entries) > 0:
        raise pickle.UnpicklingError("its archive is none that PyTorch writes")


def check_numbers(value: object) -> None:
    """Refuse plain data with whole numbers of more than 64 bits, which nothing can use and few can print.

    Raises:
        pickle.UnpicklingError: if there is one.
    """
    # The nesting and the number of entries are known to be within the budget.
    waiting = [value]
    while waiting:
        item = waiting.pop()
        if isinstance(item, Mapping):
            waiting += [*item.keys(), *item.values()]
        elif isinstance(item, list | tuple | set):
            waiting += item
        elif isinstance(item, int) and item.bit_length() > 64:
            raise pickle.UnpicklingError("it holds a whole number of more than 64 bits")
        elif not isinstance(item, TensorOutline | bool | int | float | str | bytes | NumberType | None):
            raise pickle.UnpicklingError(f"it holds a {type(item).__name__}")


# Checkpoints of other projects: their tensors alone, whatever else the file holds.

AUTHORS = "expected a checkpoint as its authors distribute it (.pth, .pth.tar, .ckpt), written by torch.save"


def read_state_dict(path: Path) -> dict[str, Any]:
    """The tensors of another project's checkpoint by name, on the CPU, without a leading ``module.``.

    A state dict may lie in the file as it is, or under ``state_dict``, ``model`` or ``encoder``. Files with more than
    tensors and plain data (optimisers, options of a library) are read too: of these objects nothing is imported or run.
    A file that asks for a function to be called is refused, wherever it asks.

    Args:
        path: the file.
    """
    import torch

    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; {AUTHORS}")
    try:
        with path.open("rb") as stream:
            outline = read_outline(stream, path, ForeignReader)
            outlines = state_of(outline)
            if not outlines:
                raise FaceDiffError(f"{path}: holds no tensors by name; {AUTHORS}")
            with zipfile.ZipFile(stream) as archive:
                contents = {stored.key: archive.read(stored.entry) for stored in outlines.values()}
    except FaceDiffError:
        raise
    except Exception as error:  # whatever a damaged or hostile file makes the readers raise, the reason is the file
        reason = next(iter(str(error).strip().splitlines()), "") if isinstance(error, pickle.UnpicklingError) else ""
        detail = reason if 0 < len(reason) < 120 else "it is damaged or cut short"
        raise FaceDiffError(f"{path}: not a checkpoint that can be read safely ({detail}); {AUTHORS}") from error
    tensors: dict[str, Any] = {}
    for name, stored in outlines.items():
        content, kind = bytearray(contents[stored.key]), getattr(torch, stored.type)
        numbers = torch.frombuffer(content, dtype=kind) if content else torch.zeros(0, dtype=kind)
        tensors[name.removeprefix("module.")] = numbers.as_strided(stored.shape, stored.stride, stored.offset).clone()
    return tensors


def read_arguments(path: Path) -> dict[str, Any]:
    """The options that another project's checkpoint keeps next to its tensors, as an ``argparse.Namespace`` or a dict.

    Nothing of the file is imported or run. Numbers, texts, lists of these and paths are kept, paths as texts; other
    values are left out.

    Args:
        path: a file that :func:`read_state_dict` reads.

    Returns:
        options by name; empty if the file holds none.
    """
    try:
        with path.open("rb") as stream:
            content = read_outline(stream, path, ArgumentReader)
    except FaceDiffError:
        raise
    except Exception as error:  # as in read_state_dict
        raise FaceDiffError(f"{path}: not a checkpoint that can be read safely; {AUTHORS}") from error
    options = content.get("args") if isinstance(content, Mapping) else None
    options = options.state if isinstance(options, StoredNamespace) else options
    if not isinstance(options, Mapping):
        return {}
    return {key: value for key, value in options.items() if isinstance(key, str) and is_plain(value)}


def is_plain(value: object) -> bool:
    """Whether it is a number, a text, None, or a list of such."""
    if isinstance(value, list | tuple):
        return all(is_plain(item) and not isinstance(item, list | tuple) for item in value)
    return value is None or isinstance(value, bool | int | float | str)


def state_of(content: object) -> dict[str, StoredTensor]:
    """The tensors by name of a state dict, or of what wraps one."""
    if not isinstance(content, Mapping):
        return {}
    own = {name: value for name, value in content.items() if isinstance(name, str) and isinstance(value, StoredTensor)}
    if own:
        return own
    for wrapper in ("state_dict", "model", "model_state_dict", "encoder"):
        if inner := state_of(content.get(wrapper)):
            return inner
    return {}


@dataclass(frozen=True)
class StoredTensor(TensorOutline):
    """In place of a tensor: where its numbers lie in the archive."""

    key: str
    entry: str
    type: str
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]


@dataclass(frozen=True)
class StoredNumbers(Storage):
    """In place of a storage: its key, and the type of its numbers."""

    key: str
    type: str


@dataclass(frozen=True)
class NamedType(NumberType):
    """In place of the class of a storage: the bytes of one number, and what PyTorch calls its type."""

    name: str


MAKERS = {
    **dict.fromkeys(("collections",), {"Counter", "OrderedDict", "defaultdict", "deque"}),
    **dict.fromkeys(("copyreg", "copy_reg"), {"_reconstructor", "__newobj__", "__newobj_ex__"}),
    **dict.fromkeys(("builtins", "__builtin__"), {"bytearray", "bytes", "complex", "frozenset", "range", "slice"}),
    **dict.fromkeys(("numpy.core.multiarray", "numpy._core.multiarray"), {"_reconstruct", "scalar"}),
    **dict.fromkeys(("pathlib", "pathlib._local"), {"Path", "PosixPath", "PurePath", "PurePosixPath", "WindowsPath"}),
    "_codecs": {"encode"},
    "argparse": {"Namespace"},
    "datetime": {"date", "datetime", "time", "timedelta", "timezone"},
    "functools": {"partial"},
    "numpy": {"dtype", "ndarray"},
    "torch.serialization": {"_get_layout"},
    "types": {"SimpleNamespace"},
}
"""What a pickle calls to make plain objects, by module."""


def may_be_called(module: str, name: str) -> bool:
    """Whether a pickle of a library's objects calls this: a maker of plain objects, or a class of another package."""
    if name in MAKERS.get(module, ()) or (module == "torch._utils" and name.startswith("_rebuild_")):
        return True
    # Members of enumerations are made by calling their class; functions have small letters.
    root = module.partition(".")[0]
    return root not in sys.stdlib_module_names | {"__builtin__", "__main__", "nt"} and name[:1].isupper()


class ForeignKind(type):
    """In place of a class or a function of another package, which is never run; some may not even be called."""

    module = name = ""

    def __call__(cls, *arguments: object, **named: object) -> Any:  # noqa: ANN401
        """Pass over a call that makes an object.

        Raises:
            pickle.UnpicklingError: for any other.
        """
        if cls.name and not may_be_called(cls.module, cls.name):
            raise pickle.UnpicklingError(f"it asks to call {quoted(f'{cls.module}.{cls.name}')}, which was not done")
        return super().__call__(*arguments, **named)


class Foreign(metaclass=ForeignKind):
    """In place of an object of another package, of which nothing is kept."""

    def __new__(cls, *arguments: object, **named: object) -> Foreign:
        """Take any arguments."""
        return super().__new__(cls)

    def __init__(self, *arguments: object, **named: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        """Forget the state."""

    def __setitem__(self, key: object, value: object) -> None:
        """Forget the entry."""

    def append(self, value: object) -> None:
        """Forget the value."""

    def extend(self, values: object) -> None:
        """Forget the values."""

    def __hash__(self) -> int:
        """By identity, as a key of a dict."""
        return id(self)

    def __eq__(self, other: object) -> bool:
        """By identity."""
        return self is other


STORED = {
    **{f"{name}Storage": kind for name, kind in (("Double", "float64"), ("Float", "float32"), ("Half", "float16"))},
    **{f"{name}Storage": kind for name, kind in (("BFloat16", "bfloat16"), ("Long", "int64"), ("Int", "int32"))},
    **{f"{name}Storage": kind for name, kind in (("Short", "int16"), ("Char", "int8"), ("Byte", "uint8"))},
    "BoolStorage": "bool",
}
"""What PyTorch calls the numbers of a storage's class."""


class ForeignReader(OutlineReader):
    """Reads ``data.pkl`` of another project; what is neither plain data nor a tensor becomes a :class:`Foreign`."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        """The stand-in for a name; nothing is imported."""
        if module in ("torch", "torch.cuda") and name in STORED:
            return NamedType(STORAGES[name], STORED[name])
        if module == "torch._utils" and name in self._rebuild:
            return self._rebuild[name]
        stand_in = self.names.get((module, name))
        return (
            stand_in if stand_in is not None else ForeignKind("Foreign", (Foreign,), {"module": module, "name": name})
        )

    def _instantiate(self, kind: Any, arguments: Any) -> None:  # noqa: ANN401 - the oldest way to call
        """Call what a pickle names."""
        self.append(kind(*arguments))  # type: ignore[attr-defined]

    def persistent_load(self, pid: Any) -> Storage:  # noqa: ANN401
        """A storage, once its length agrees with its bytes."""
        checked = super().persistent_load(pid)
        if not isinstance(pid[1], NamedType):
            raise pickle.UnpicklingError("it holds numbers in an unknown form")
        return StoredNumbers(checked.bytes, checked.item, pid[2], pid[1].name)

    def _outline(
        self, storage: Storage, item: int, offset: Declared, shape: Declared, stride: Declared, more: list[Any]
    ) -> TensorOutline:
        # Hooks and other additions are objects of nobody's here.
        checked = super()._outline(storage, item, offset, shape, stride, [])
        if not isinstance(storage, StoredNumbers):
            raise pickle.UnpicklingError("it holds a tensor in an unknown form")
        entry = f"{self.folder}/data/{storage.key}"
        return StoredTensor(checked.bytes, storage.key, entry, storage.type, offset, shape, stride)


class StoredNamespace:
    """In place of an ``argparse.Namespace``: its attributes as a dict."""

    def __init__(self) -> None:
        self.state: dict[Any, Any] = {}

    def __setstate__(self, state: object) -> None:
        """Keep the attributes, whatever they are called."""
        self.state = state if isinstance(state, dict) else {}


class ArgumentReader(ForeignReader):
    """As :class:`ForeignReader`, which also keeps the attributes of an ``argparse.Namespace``, and paths as texts."""

    names: ClassVar[dict[tuple[str, str], Any]] = {
        **ForeignReader.names,
        ("argparse", "Namespace"): StoredNamespace,
        **{
            (module, name): lambda *parts: "/".join(map(str, parts))
            for module in ("pathlib", "pathlib._local")
            for name in ("Path", "PosixPath", "PurePath", "PurePosixPath", "WindowsPath")
        },
    }
