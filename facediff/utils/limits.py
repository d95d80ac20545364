"""How much an untrusted file may expand to, checked before memory is allocated.

A file of a few kilobytes can declare sizes of terabytes. Every reader compares what a file declares with one budget,
:data:`LIMITS`, before it believes the file. Whoever needs more raises a limit by an environment variable.
"""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
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
    """

    bytes: float = 4 * 2**30
    seconds: float = 6 * 3600
    vertices: float = 2_000_000
    frames: float = 3_000_000
    identities: float = 100_000
    nesting: float = 64
    entries: float = 2_000_000

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Limits:
        """The limits, with those replaced that an environment variable states.

        Raises:
            FaceDiffError: if a variable is not a positive number.
        """
        given: dict[str, float] = {}
        for field in fields(cls):
            variable = f"FACEDIFF_MAX_{field.name.upper()}"
            text = environment.get(variable)
            if text is None:
                continue
            try:
                given[field.name] = float(text)
            except ValueError:
                given[field.name] = math.nan
            if not given[field.name] > 0:
                raise FaceDiffError(f"{variable}={text}: not a valid limit; expected a positive number")
        return cls(**given)

    def check(self, what: str, count: float, source: object) -> None:
        """Refuse a count above a limit.

        Args:
            what: the limit's name.
            count: what the file declares.
            source: the file, for the message.

        Raises:
            FaceDiffError: naming the file, the limit and the variable that raises it.
        """
        limit = getattr(self, what)
        if not 0 <= count <= limit:
            shown = f"{count:g}" if isinstance(count, float) else str(count)
            raise FaceDiffError(
                f"{source}: declares {shown} {what}; expected 0 to {limit:g}. If you trust the file, set "
                f"FACEDIFF_MAX_{what.upper()} to a larger number"
            )


LIMITS = Limits.from_environment()


def check_array(source: object, shape: tuple[int, ...], item_bytes: int) -> None:
    """Refuse a declared array that would not fit into the budget.

    Raises:
        FaceDiffError: if a size is negative, or the array is larger than :attr:`Limits.bytes`.
    """
    if any(size < 0 for size in shape):
        raise FaceDiffError(f"{source}: declares an array of shape {shape}; the file is damaged")
    LIMITS.check("bytes", math.prod(shape) * item_bytes, source)


def read_npz(path: Path, stream: IO[bytes] | None = None) -> dict[str, npt.NDArray[np.generic]]:
    """All arrays of an ``.npz`` file; every header is checked before anything is decompressed.

    Args:
        path: the file, for messages.
        stream: the open file; opened here if None.

    Raises:
        FaceDiffError: if the file is damaged, holds objects, or expands to more than the budget.
    """
    import numpy as np

    try:
        with zipfile.ZipFile(stream if stream is not None else path) as archive:
            members = archive.infolist()
            LIMITS.check("entries", len(members), path)
            LIMITS.check("bytes", sum(member.file_size for member in members), path)
            arrays: dict[str, npt.NDArray[np.generic]] = {}
            for member in members:
                with archive.open(member) as opened:
                    shape, dtype = npy_header(opened)
                name = member.filename.removesuffix(".npy")
                check_array(f"{path}: {name}", shape, dtype.itemsize)
                if dtype.hasobject or math.prod(shape) * dtype.itemsize > member.file_size:
                    raise FaceDiffError(f"{path}: {name} holds objects or is shorter than it declares; it was not read")
                with archive.open(member) as opened:
                    arrays[name] = np.lib.format.read_array(opened, allow_pickle=False)
            return arrays
    except FaceDiffError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy each have several exceptions for damaged files
        raise FaceDiffError(f"{path}: not a readable .npz file ({error}); expected one that facediff wrote") from error


def npy_header(stream: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:  # noqa: ANN401 - anything with ``read``
    """Shape and type that an ``.npy`` stream declares.

    Raises:
        ValueError: if there is no valid header.
    """
    import numpy as np

    version = np.lib.format.read_magic(stream)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"format version {version} is not supported")
    shape, _, dtype = read(stream)
    return shape, dtype


def check_nesting(value: object, source: object) -> None:
    """Refuse plain data that is nested too deeply or has too many entries; walks without recursion.

    Raises:
        FaceDiffError: naming the limit.
    """
    level, count = [value], 0
    depth = 0
    while level:
        depth += 1
        LIMITS.check("nesting", depth - 1, source)
        inner: list[object] = []
        for item in level:
            if isinstance(item, Mapping):
                inner += item.values()
            elif isinstance(item, list | tuple | set):
                inner += item
            count += 1
        LIMITS.check("entries", count, source)
        level = inner
