"""Opening pickles from elsewhere without letting them run code."""

from __future__ import annotations

import pickle  # noqa: S403 - only through the restricted unpickler below
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

from facediff.errors import FaceDiffError
from facediff.plain_arrays import SAFE

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
