"""Named sets of vertices, so that a score can say exactly which vertices it was taken over.

A :class:`Region` is a set of vertices, :class:`LipPairs` are pairs of an upper and a lower lip vertex, and a
:class:`Topology` knows which regions are in use on the meshes of the field's data sets.
"""

from __future__ import annotations

import hashlib
import operator
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, SupportsIndex

import torch
from torch import Tensor


class Vertices(ABC):
    """Named vertices of a mesh, or pairs of them: the base of regions and pairs.

    Attributes:
        name: printed next to a score.
        duplicates: how many repeated entries the source held.
    """

    name: str
    duplicates: int
    entries_in_words: ClassVar[str]

    @property
    @abstractmethod
    def entries(self) -> tuple[Any, ...]:
        """Indices, or pairs of them, strictly increasing."""

    def __str__(self) -> str:
        """Name, number of entries and hash, as printed next to a score."""
        return f"{self.name} ({self.count} {self.entries_in_words}, {self.hash})"

    @property
    def count(self) -> int:
        """How many distinct entries there are."""
        return len(self.entries)

    @property
    def hash(self) -> str:
        """First 8 hexadecimal digits of the SHA-256 of the entries.

        The sorted distinct indices are written in decimal and joined by one comma without spaces, in ASCII, so the hash
        can be recomputed anywhere: ``printf 1,2,3 | sha256sum | cut -c -8``. A pair is written like ``3504-3531`` with
        the smaller index first. The name does not enter.

        >>> Region.from_indices("lips", [3, 1, 2, 1]).hash
        '8a6ae151'
        """
        rows = (entry if isinstance(entry, tuple) else (entry,) for entry in self.entries)
        text = ",".join("-".join(map(str, row)) for row in rows)
        return hashlib.sha256(text.encode("ascii")).hexdigest()[:8]

    def tensor(self) -> Tensor:
        """The entries as an int64 tensor of shape (count,), or (count, 2)."""
        return torch.tensor(self.entries, dtype=torch.int64)

    def as_dict(self) -> dict[str, str | int]:
        """Name, number of entries, hash and repeated entries, as plain data for reports."""
        return {"name": self.name, "count": self.count, "hash": self.hash, "duplicates": self.duplicates}

    def check(self, n_vertices: int) -> None:
        """Refuse a mesh that they cannot belong to."""
        lowest, highest = self._bounds
        if lowest < 0 or highest >= n_vertices:
            raise ValueError(
                f"{self} hold the index {lowest if lowest < 0 else highest}, a mesh of {n_vertices} vertices ends at "
                f"{n_vertices - 1}; use the vertices of the motion's own topology"
            )

    @cached_property
    def _bounds(self) -> tuple[int, int]:
        """The smallest and the largest index."""
        indices = self.tensor()
        return int(indices.min()), int(indices.max())


@dataclass(frozen=True)
class Region(Vertices):
    """A named set of vertex indices, sorted and distinct.

    Make one with :meth:`Region.from_indices`, :meth:`Region.from_file` or :meth:`Region.from_weights`, which sort and
    remove duplicates; the plain constructor takes indices that are sorted and distinct already and refuses others.

    Args:
        name: printed next to a score, for example ``"biwi/lve"``.
        indices: vertex indices from 0, strictly increasing.
        n_vertices: vertices of the mesh that the region belongs to, if known; it is then refused on others.
        duplicates: how many repeated indices the source held.
    """

    name: str
    indices: tuple[int, ...] = field(repr=False)
    n_vertices: int | None = None
    duplicates: int = field(default=0, compare=False)
    entries_in_words = "vertices"

    def __post_init__(self) -> None:
        """Check the indices."""
        increasing = all(later > earlier for earlier, later in zip(self.indices, self.indices[1:], strict=False))
        if not self.indices or self.indices[0] < 0 or not increasing:
            raise ValueError(
                f"region {self.name!r} needs indices from 0 upwards, sorted and distinct; use Region.from_indices"
            )
        if self.n_vertices is not None:
            super().check(self.n_vertices)

    @property
    def entries(self) -> tuple[int, ...]:
        """The indices."""
        return self.indices

    def check(self, n_vertices: int) -> None:
        """Refuse a mesh that this region cannot belong to, or that is known to be another mesh."""
        if self.n_vertices is not None and n_vertices != self.n_vertices:
            raise ValueError(
                f"region {self} belongs to a mesh of {self.n_vertices} vertices, not of {n_vertices}; use the region "
                f"of the motion's own topology"
            )
        super().check(n_vertices)

    @classmethod
    def from_indices(cls, name: str, indices: Iterable[int] | Tensor, *, n_vertices: int | None = None) -> Region:
        """A region from indices in any order, repeated or not.

        Args:
            name: of the region.
            indices: integers, or a one-dimensional integer tensor or array. Masks of booleans are refused.
            n_vertices: vertices of the mesh, if known.

        >>> region = Region.from_indices("lips", [3, 1, 2, 1])
        >>> region.indices, region.duplicates
        ((1, 2, 3), 1)
        >>> print(region)
        lips (3 vertices, 8a6ae151)
        """
        to_list = getattr(indices, "tolist", None)  # tensors and arrays: plain integers are faster to check
        values = list(to_list() if to_list is not None else indices)
        # Booleans would pass as the indices 0 and 1.
        if not all(isinstance(value, SupportsIndex) and not isinstance(value, bool) for value in values):
            raise ValueError(f"region {name!r} needs a flat list of whole numbers; of a mask, mask.nonzero().flatten()")
        distinct = tuple(sorted(set(map(operator.index, values))))
        return cls(name, distinct, n_vertices, duplicates=len(values) - len(distinct))

    @classmethod
    def from_file(cls, path: str | PathLike[str], *, name: str | None = None, n_vertices: int | None = None) -> Region:
        """A region from a text file of indices separated by commas, blanks or line ends, in any mixture.

        Args:
            path: the file.
            name: of the region; the file's name without its ending by default.
            n_vertices: vertices of the mesh, if known.
        """
        path = Path(path)
        indices = read_indices(path)
        with errors_of(path):
            return cls.from_indices(name or path.stem, indices, n_vertices=n_vertices)

    @classmethod
    def from_weights(
        cls, weights: Tensor | str | PathLike[str], threshold: float, *, name: str | None = None
    ) -> Region:
        """The vertices with a weight strictly above a threshold.

        Multiface's regions are such masks: FaceDiffuser's script takes the mouth where it is above 0.1 and
        the forehead where it is above 0.4.

        Args:
            weights: one finite weight for each vertex of the mesh, (vertices,), or a text file of them, one per
                line.
            threshold: vertices of exactly this weight do not belong to the region.
            name: of the region; by default the file's name without its ending, or "weights", with
                the threshold.

        >>> print(Region.from_weights(torch.tensor([0.0, 0.9, 0.1, 0.4]), 0.1))
        weights > 0.1 (2 vertices, ef96f1f6)
        """
        title, values = "weights", weights
        if not isinstance(values, Tensor):
            title, path = Path(values).stem, Path(values)
            with errors_of(path, "one finite weight per line"):
                values = torch.tensor(list(map(float, read_text(path).split())), dtype=torch.float64)
        name = name or f"{title} > {threshold:g}"
        indices = (values > threshold).nonzero().flatten()
        if values.ndim != 1 or not bool(values.isfinite().all()) or not len(indices):
            raise ValueError(
                f"region {name!r} needs finite weights, one for each vertex, some of them above {threshold:g}"
            )
        return cls.from_indices(name, indices, n_vertices=len(values))


RegionLike = Region | Sequence[int] | Tensor
"""A :class:`Region`, or bare indices, which become a region with a general name."""


def as_region(region: RegionLike, name: str) -> Region:
    """The region itself, or a region called ``name`` from bare indices."""
    return region if isinstance(region, Region) else Region.from_indices(name, region)


@dataclass(frozen=True)
class LipPairs(Vertices):
    """Named pairs of an upper and a lower vertex of the inner lips, sorted and distinct.

    The distance of a pair shows how far the mouth is open. Make them with :meth:`LipPairs.from_pairs` or
    :meth:`LipPairs.from_file`. Which vertices to pair is the user's choice and part of every number: the released
    script of the MTM metric uses the one pair (3531, 3504) of FLAME, the middle of the outer lips.

    Args:
        name: printed next to a score, for example ``"flame/inner lips"``.
        pairs: two different vertex indices each, the smaller first; the pairs strictly increasing.
        duplicates: how many repeated pairs the source held.
    """

    what: ClassVar[str] = "lip pairs"

    name: str
    pairs: tuple[tuple[int, int], ...] = field(repr=False)
    duplicates: int = field(default=0, compare=False)
    entries_in_words = "pairs"

    def __post_init__(self) -> None:
        """Check the pairs."""
        distinct = sorted({(min(pair), max(pair)) for pair in self.pairs})
        if not self.pairs or list(self.pairs) != distinct or any(first == second for first, second in self.pairs):
            raise ValueError(
                f"{self.what} {self.name!r} need pairs of two different vertices, sorted and distinct; use "
                f"{type(self).__name__}.from_pairs"
            )

    @property
    def entries(self) -> tuple[tuple[int, int], ...]:
        """The pairs."""
        return self.pairs

    @classmethod
    def from_pairs(cls, name: str, pairs: Iterable[Iterable[int]] | Tensor) -> Self:
        """Pairs in any order, repeated or not, either vertex first.

        Args:
            name: of the pairs.
            pairs: two integers each, or an integer tensor or array (pairs, 2).

        >>> print(LipPairs.from_pairs("middle", [(3531, 3504), (3504, 3531)]))
        middle (1 pairs, de4cd82d)
        """
        rows = getattr(pairs, "tolist", lambda: pairs)()  # of a tensor or an array
        indices = [(operator.index(first), operator.index(second)) for first, second in rows]
        distinct = sorted({(min(pair), max(pair)) for pair in indices})
        return cls(name, tuple(distinct), duplicates=len(indices) - len(distinct))

    @classmethod
    def from_file(cls, path: str | PathLike[str], *, name: str | None = None) -> Self:
        """Pairs of a text file: indices separated by commas, blanks or line ends, each two of them a pair.

        Args:
            path: the file.
            name: of the pairs; the file's name without its ending by default.
        """
        path = Path(path)
        indices = read_indices(path)
        with errors_of(path, "two indices for each pair"):
            return cls.from_pairs(name or path.stem, zip(indices[::2], indices[1::2], strict=True))


class EyelidPairs(LipPairs):
    """Named pairs of an upper and a lower eyelid vertex, of one eye or of both.

    Their distance shows how far the eyes are open.
    """

    what: ClassVar[str] = "eyelid pairs"


LipPairsLike = LipPairs | Iterable[Iterable[int]] | Tensor
""":class:`LipPairs`, or bare pairs of indices, which get a general name."""


# Files of indices and of weights.


@contextmanager
def errors_of(path: Path, expected: str = "") -> Iterator[None]:
    """Name the file and its expected content in errors of reading it."""
    try:
        yield
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(f"{path}: {reason}" + (f"; expected {expected}" if expected else "")) from error


def read_indices(path: Path) -> list[int]:
    """Whole numbers of a text file, separated by commas, blanks or line ends; errors name the file."""
    with errors_of(path, "vertex indices, separated by commas, blanks or line ends"):
        return list(map(int, read_text(path).replace(",", " ").split()))


def read_text(path: Path) -> str:
    """The text of a regular file: a device or a pipe may never end."""
    if path.exists() and not path.is_file():
        raise OSError("not a regular file")
    return path.read_text(encoding="utf-8-sig")


# How many vertices the usual regions of the usual meshes have, to tell a usual region from another. Counts are facts
# about files that circulate; the files themselves belong to their data sets and are not bundled.

Part = Literal["lips", "upper"]


@dataclass(frozen=True)
class Topology:
    """The mesh of a data set, and its usual ``lips`` and ``upper`` face regions by their number of vertices."""

    name: str
    n_vertices: int
    lips: dict[int, str]
    upper: dict[int, str]

    def bind(self, region: Region) -> Region:
        """The region as one of this mesh, so that motion of another mesh is refused."""
        region.check(self.n_vertices)
        return replace(region, n_vertices=self.n_vertices)

    def remark(self, part: Part, region: Region) -> str:
        """A remark on a region by its vertex count: the script that uses it, or that it is not a usual one.

        >>> TOPOLOGIES["biwi"].remark("lips", Region.from_indices("mine", [1, 2]))
        'lips of 2 vertices are not usual on biwi (4996: lve.txt of BIWI)'
        """
        counts = self.lips if part == "lips" else self.upper
        verb = "are" if part == "lips" else "is"
        if region.count in counts:
            return f"{part} of {region.count} vertices {verb} usual on {self.name}: {counts[region.count]}"
        meanings = "; ".join(f"{count}: {meaning}" for count, meaning in counts.items())
        return f"{part} of {region.count} vertices {verb} not usual on {self.name} ({meanings})"


_FLAME_LIPS = {
    250: "lips of FLAME's masks, as DiffSpeaker",
    428: "lve.txt of FaceDiffuser and ProbTalk3D",
    648: "lip.txt of TalkingStyle",
}
_FLAME_UPPER = {
    827: "forehead and eye region of FLAME's masks, as DiffSpeaker",
    1501: "fdd.txt of FaceDiffuser and ProbTalk3D",
}
_MULTIFACE_LIPS = {1438: "mouth weights above 0.1, as FaceDiffuser's script", 1035: "lve.txt of FaceDiffuser"}
_MULTIFACE_UPPER = {656: "forehead weights above 0.4, as FaceDiffuser's script", 1529: "fdd.txt of FaceDiffuser"}

TOPOLOGIES: dict[str, Topology] = {
    "biwi": Topology("biwi", 23370, {4996: "lve.txt of BIWI"}, {7784: "fdd.txt of BIWI"}),
    "vocaset": Topology("vocaset", 5023, _FLAME_LIPS, _FLAME_UPPER),
    "mead3d": Topology("mead3d", 5023, _FLAME_LIPS, _FLAME_UPPER),
    "multiface": Topology("multiface", 6172, _MULTIFACE_LIPS, _MULTIFACE_UPPER),
}
"""Every known mesh by the name of its data set."""
