"""Named sets of vertices, so that a score can say exactly which vertices it was taken over."""

from __future__ import annotations

import hashlib
import math
import operator
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor


@dataclass(frozen=True)
class Region:
    """A named set of vertex indices, sorted and distinct.

    Make one with `Region.from_indices`, `Region.from_file` or `Region.from_weights`, which sort and remove
    duplicates; the plain constructor takes indices that are sorted and distinct already and refuses others.
    ``first | second`` is the union of two regions.

    Args:
        name: What the region is called beside a score, for example ``"biwi/lve"``.
        indices: Vertex indices from 0, strictly increasing.
        n_vertices: Vertices of the mesh that the region belongs to, if known; it is then refused on others.
        duplicates: How many repeated indices the source held.

    Raises:
        ValueError: If there is no index, one is negative or not below ``n_vertices``, or they do not
            increase.
    """

    name: str
    indices: tuple[int, ...] = field(repr=False)
    n_vertices: int | None = None
    duplicates: int = field(default=0, compare=False)

    def __post_init__(self) -> None:
        """Check the indices."""
        if not self.indices:
            raise ValueError(f"region {self.name!r} holds no vertex index; give at least one")
        if any(later <= earlier for earlier, later in zip(self.indices, self.indices[1:], strict=False)):
            raise ValueError(
                f"the indices of region {self.name!r} are not sorted and distinct; use Region.from_indices"
            )
        if self.indices[0] < 0:
            raise ValueError(f"region {self.name!r} holds the index {self.indices[0]}; indices count from 0 upwards")
        if self.n_vertices is not None:
            self._check_range(self.n_vertices)

    def __str__(self) -> str:
        """Name, vertex count and hash, as printed beside a score."""
        return f"{self.name} ({self.count} vertices, {self.hash})"

    @property
    def count(self) -> int:
        """How many distinct vertices the region has."""
        return len(self.indices)

    @property
    def hash(self) -> str:
        """First 8 hexadecimal digits of the SHA-256 of the sorted distinct indices.

        The indices are written in decimal and joined by one comma without spaces, in ASCII, so the hash can
        be recomputed anywhere: ``printf 1,2,3 | sha256sum | cut -c -8``. The name does not enter.

        >>> Region.from_indices("lips", [3, 1, 2, 1]).hash
        '8a6ae151'
        """
        text = ",".join(map(str, self.indices))
        return hashlib.sha256(text.encode("ascii")).hexdigest()[:8]

    def tensor(self) -> Tensor:
        """The indices as an int64 tensor of shape (count,)."""
        return torch.tensor(self.indices, dtype=torch.int64)

    def check(self, n_vertices: int) -> None:
        """Refuse a mesh that this region cannot belong to.

        Args:
            n_vertices: Vertices of the mesh.

        Raises:
            ValueError: If the mesh has fewer vertices than an index needs, or is known to be another mesh.
        """
        if self.n_vertices is not None and n_vertices != self.n_vertices:
            raise ValueError(
                f"region {self} belongs to a mesh of {self.n_vertices} vertices, the motion has "
                f"{n_vertices}; use the region of the motion's own topology"
            )
        self._check_range(n_vertices)

    def _check_range(self, n_vertices: int) -> None:
        if self.indices[-1] >= n_vertices:
            raise ValueError(
                f"region {self} holds the index {self.indices[-1]}, a mesh of {n_vertices} vertices ends at "
                f"{n_vertices - 1}; use the region of the motion's own topology"
            )

    @classmethod
    def from_indices(cls, name: str, indices: Iterable[int] | Tensor, *, n_vertices: int | None = None) -> Region:
        """A region from indices in any order, repeated or not.

        Args:
            name: What to call the region.
            indices: Integers, or a one-dimensional integer tensor or array. Masks of booleans are refused.
            n_vertices: Vertices of the mesh, if known.

        Raises:
            ValueError: If an index is not an integer, or as for `Region`.

        >>> region = Region.from_indices("lips", [3, 1, 2, 1])
        >>> region.indices, region.duplicates
        ((1, 2, 3), 1)
        >>> print(region)
        lips (3 vertices, 8a6ae151)
        """
        to_list = getattr(indices, "tolist", None)  # tensors and arrays: plain integers are faster to check
        try:
            values = list(to_list() if to_list is not None else indices)
            found = [operator.index(value) for value in values]
        except TypeError:
            raise ValueError(f"the indices of region {name!r} must be a flat list of integers") from None
        if any(isinstance(value, bool) for value in values):  # would pass as the indices 0 and 1
            raise ValueError(f"region {name!r} was given a mask of booleans; give indices (mask.nonzero().flatten())")
        distinct = tuple(sorted(set(found)))
        return cls(name, distinct, n_vertices, duplicates=len(found) - len(distinct))

    @classmethod
    def from_file(cls, path: str | PathLike[str], *, name: str | None = None, n_vertices: int | None = None) -> Region:
        """A region from a text file of indices separated by commas, blanks or line ends, in any mixture.

        Args:
            path: The file.
            name: What to call the region; the file's name without its ending by default.
            n_vertices: Vertices of the mesh, if known.

        Raises:
            ValueError: If the file cannot be read or is not a list of indices; the message names the file.
        """
        path = Path(path)
        try:
            return cls.from_indices(name or path.stem, read_indices(path), n_vertices=n_vertices)
        except ValueError as error:
            raise ValueError(_naming(path, error)) from error

    @classmethod
    def from_weights(
        cls, weights: Tensor | str | PathLike[str], threshold: float, *, name: str | None = None
    ) -> Region:
        """The vertices whose weight is above a threshold, strictly.

        Multiface's regions are such masks: FaceDiffuser's script takes the mouth where it is above 0.1 and
        the forehead where it is above 0.4.

        Args:
            weights: One finite weight for each vertex of the mesh, (vertices,), or a text file of them, one a
                line.
            threshold: Vertices of exactly this weight are left out.
            name: What to call the region; by default the file's name without its ending, or "weights", with
                the threshold.

        Raises:
            ValueError: If the file cannot be read or holds other things, or no weight is above the threshold.

        >>> print(Region.from_weights(torch.tensor([0.0, 0.9, 0.1, 0.4]), 0.1))
        weights > 0.1 (2 vertices, ef96f1f6)
        """
        if isinstance(weights, Tensor):
            title, values = "weights", weights
        else:
            title = Path(weights).stem
            values = torch.tensor(_read_weights(Path(weights)), dtype=torch.float64)
        name = name or f"{title} > {threshold:g}"
        if values.ndim != 1 or not values.is_floating_point() or not bool(values.isfinite().all()):
            raise ValueError(f"the weights of region {name!r} must be a flat tensor of finite floating-point numbers")
        chosen = (values > threshold).nonzero().flatten()
        if not len(chosen):
            raise ValueError(f"region {name!r}: none of the {len(values)} weights is above {threshold:g}; lower it")
        return cls.from_indices(name, chosen, n_vertices=len(values))

    def union(self, *others: Region, name: str | None = None) -> Region:
        """The vertices of this region and others; vertices that they share count as duplicates.

        Args:
            *others: Regions of the same mesh.
            name: What to call the union; the names joined by " + " by default.

        Raises:
            ValueError: If the regions are known to belong to different meshes.

        >>> print(Region("forehead", (1, 2)).union(Region("eyes", (2, 3))))
        forehead + eyes (3 vertices, 8a6ae151)
        """
        parts = (self, *others)
        meshes = {part.n_vertices for part in parts} - {None}
        if len(meshes) > 1:
            told = ", ".join(f"{part} of {part.n_vertices}" for part in parts)
            raise ValueError(f"regions of different meshes cannot be united: {told} vertices")
        indices = (index for part in parts for index in part.indices)
        title = name or " + ".join(part.name for part in parts)
        return Region.from_indices(title, indices, n_vertices=meshes.pop() if meshes else None)

    def __or__(self, other: Region) -> Region:
        return self.union(other)


def read_indices(path: Path) -> list[int]:
    """Whole numbers of a text file, separated by commas, blanks or line ends.

    Raises:
        ValueError: If the file cannot be read or holds anything else; the message names the file.
    """
    words = [word for word in re.split(r"[,\s]+", _read_text(path, "vertex indices separated by commas")) if word]
    for place, word in enumerate(words, start=1):
        if not (word.isascii() and word.isdigit()):
            raise ValueError(
                f"{path}: entry {place} is {word[:40]!r}; expected vertex indices (whole numbers from 0) "
                "separated by commas, blanks or line ends"
            )
    return list(map(int, words))


def _read_weights(path: Path) -> list[float]:
    found = []
    for place, word in enumerate(_read_text(path, "one weight a line").split(), start=1):
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(f"{path}: entry {place} is {word[:40]!r}; expected one finite weight a line")
        found.append(value)
    return found


def _read_text(path: Path, expected: str) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"cannot read the region file {path}: {reason}; check the path") from error
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not text; expected {expected}") from None


def _naming(path: Path, error: ValueError) -> str:
    """The error's message, with the file in front unless it is named already."""
    return str(error) if str(path) in str(error) else f"{path}: {error}"


RegionLike = Region | Sequence[int] | Tensor
"""A `Region`, or bare indices, which become a region with a general name."""


def as_region(region: RegionLike, name: str) -> Region:
    """The region itself, or a region called ``name`` from bare indices."""
    return region if isinstance(region, Region) else Region.from_indices(name, region)
