"""Pairs of lip vertices, one above the other, whose distance says how far the mouth is open."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from facediff.metrics.regions import read_indices


@dataclass(frozen=True)
class LipPairs:
    """Named pairs of an upper and a lower vertex of the inner lips, sorted and distinct.

    Make one with `LipPairs.from_pairs` or `LipPairs.from_file`. Which vertices to pair is the user's choice
    and part of every number: the released script of the MTM metric uses the one pair (3531, 3504) of FLAME,
    the middle of the outer lips.

    Args:
        name: What the pairs are called beside a score, for example ``"flame/inner lips"``.
        pairs: Two different vertex indices each, the smaller first; the pairs strictly increasing.
        duplicates: How many repeated pairs the source held.

    Raises:
        ValueError: If there is no pair, or they are not as described.
    """

    name: str
    pairs: tuple[tuple[int, int], ...] = field(repr=False)
    duplicates: int = field(default=0, compare=False)

    def __post_init__(self) -> None:
        """Check the pairs."""
        if not self.pairs:
            raise ValueError(f"lip pairs {self.name!r} are empty; give at least one pair of vertices")
        for first, second in self.pairs:
            if first < 0:
                raise ValueError(f"lip pairs {self.name!r} hold the index {first}; indices count from 0 upwards")
            if first == second:
                raise ValueError(f"lip pairs {self.name!r} pair vertex {first} with itself")
        ordered = sorted({(min(pair), max(pair)) for pair in self.pairs})
        if list(self.pairs) != ordered:
            raise ValueError(f"lip pairs {self.name!r} are not sorted and distinct; use LipPairs.from_pairs")

    def __str__(self) -> str:
        """Name, number of pairs and hash, as printed beside a score."""
        return f"{self.name} ({self.count} pairs, {self.hash})"

    @property
    def count(self) -> int:
        """How many distinct pairs there are."""
        return len(self.pairs)

    @property
    def hash(self) -> str:
        """First 8 hexadecimal digits of the SHA-256 of the pairs.

        Written like ``3504-3531`` with the smaller index first, sorted by number, joined by commas.
        """
        text = ",".join(f"{first}-{second}" for first, second in self.pairs)
        return hashlib.sha256(text.encode("ascii")).hexdigest()[:8]

    def tensor(self) -> Tensor:
        """The pairs as an int64 tensor of shape (count, 2)."""
        return torch.tensor(self.pairs, dtype=torch.int64)

    def check(self, n_vertices: int) -> None:
        """Refuse a mesh that these pairs cannot belong to.

        Raises:
            ValueError: If an index is not below ``n_vertices``.
        """
        largest = max(second for _, second in self.pairs)
        if largest >= n_vertices:
            raise ValueError(
                f"lip pairs {self} hold the index {largest}, a mesh of {n_vertices} vertices ends at "
                f"{n_vertices - 1}; use the pairs of the motion's own topology"
            )

    @classmethod
    def from_pairs(cls, name: str, pairs: Iterable[Iterable[int]] | Tensor) -> LipPairs:
        """Pairs in any order, repeated or not, either vertex first.

        Args:
            name: What to call them.
            pairs: Two integers each, or an integer tensor (pairs, 2).

        Raises:
            ValueError: If a pair is not two integers, or as for `LipPairs`.

        >>> print(LipPairs.from_pairs("middle", [(3531, 3504), (3504, 3531)]))
        middle (1 pairs, de4cd82d)
        """
        given = [list(pair) for pair in (pairs.tolist() if isinstance(pairs, Tensor) else pairs)]
        if any(len(pair) != 2 or any(type(index) is not int for index in pair) for pair in given):
            raise ValueError(f"lip pairs {name!r} must be pairs of two whole numbers, vertex indices")
        distinct = sorted({(min(pair), max(pair)) for pair in given})
        return cls(name, tuple(distinct), duplicates=len(given) - len(distinct))

    @classmethod
    def from_file(cls, path: str | PathLike[str], *, name: str | None = None) -> LipPairs:
        """Pairs of a text file: indices separated by commas, blanks or line ends, each two of them a pair.

        Args:
            path: The file.
            name: What to call them; the file's name without its ending by default.

        Raises:
            ValueError: If the file cannot be read or is not a list of pairs; the message names the file.
        """
        path = Path(path)
        indices = read_indices(path)
        if len(indices) % 2:
            raise ValueError(f"{path}: holds {len(indices)} indices, an odd number; expected two for each pair")
        try:
            return cls.from_pairs(name or path.stem, zip(indices[::2], indices[1::2], strict=True))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


LipPairsLike = LipPairs | Iterable[Iterable[int]] | Tensor
"""`LipPairs`, or bare pairs of indices, which get a general name."""


def as_lip_pairs(pairs: LipPairsLike) -> LipPairs:
    """The pairs themselves, or named ones from bare indices."""
    return pairs if isinstance(pairs, LipPairs) else LipPairs.from_pairs("lip pairs", pairs)
