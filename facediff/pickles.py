"""Opening pickles from elsewhere without letting them run code."""

from __future__ import annotations

import pickle  # noqa: S403 - only through the restricted unpickler below
from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError

ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
    ("numpy._core.numeric", "_frombuffer"),
    ("_codecs", "encode"),
    ("collections", "OrderedDict"),
    ("builtins", "set"),
    ("builtins", "frozenset"),
    ("builtins", "complex"),
    ("__builtin__", "set"),
    ("__builtin__", "frozenset"),
}


class PlainUnpickler(pickle.Unpickler):
    """Unpickles NumPy arrays and plain containers, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        """Allow the names in :data:`ALLOWED` only."""
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return super().find_class(module, name)


def load_pickle(path: Path) -> Any:  # noqa: ANN401
    """Read a pickle that holds NumPy arrays and plain containers.

    Files written by Python 2 are read as Latin-1, as every project of the field does.

    Raises:
        FaceDiffError: if the file is missing, is no pickle, or asks for anything else; nothing of it has been run.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; expected a pickle with NumPy arrays")
    with path.open("rb") as stream:
        try:
            return PlainUnpickler(stream, encoding="latin1").load()
        except Exception as error:
            raise FaceDiffError(
                f"{path}: not a pickle of plain NumPy arrays ({error}); it was not run. Expected the file as the "
                f"data set's authors distribute it"
            ) from error
