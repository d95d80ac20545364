"""The reverse process in few dimensions, for models whose first and last maps are linear.

If motion enters a model by E x + e and leaves it by U h + b, every linear update of a sampler,
x_{n−1} = a x_n + c x̂₀ + s z, can be followed through E: y_n = E x_n obeys
y_{n−1} = a y_n + c (E U h + E b) + s E z with E z ~ N(0, E Eᵀ). Nothing in it has as many dimensions as x.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

CHUNK = 8192
"""Coordinates that are widened to float64 at a time."""


@dataclass(frozen=True)
class Fold:
    """What the reverse process of y = E x needs of the two linear maps.

    Attributes:
        product: E U, from the last features to the folded prediction.
        offset: E b.
        root: the symmetric square root S of E Eᵀ: S ξ with unit Gaussian ξ is distributed like E z.
    """

    product: Float[Tensor, "dim dim"]
    offset: Float[Tensor, " dim"]
    root: Float[Tensor, "dim dim"]


def fold(
    first: Float[Tensor, "dim coordinates"],
    last: Float[Tensor, "coordinates dim"],
    bias: Float[Tensor, " coordinates"] | None,
) -> Fold:
    """Multiply the two maps out, in float64; the result has the type and the device of ``first``.

    The square root is taken by eigenvectors, so that E may have any rank. The symmetric one is used because it is
    unique: it depends neither on the signs and the order of eigenvectors, which libraries choose as they like, nor
    jumps while a model trains, so that equal seeds give comparable motion.

    Args:
        first: E.
        last: U.
        bias: b; zero if None.
    """
    # Not every accelerator knows float64.
    device = torch.device("cpu") if first.device.type == "mps" else first.device
    dim, coordinates = first.shape
    product = torch.zeros(dim, dim, dtype=torch.float64, device=device)
    covariance = torch.zeros_like(product)
    offset = torch.zeros(dim, dtype=torch.float64, device=device)
    for begin in range(0, coordinates, CHUNK):
        part = slice(begin, begin + CHUNK)
        e = first[:, part].to(device, torch.float64)
        product.addmm_(e, last[part].to(device, torch.float64))
        covariance.addmm_(e, e.T)
        if bias is not None:
            offset.addmv_(e, bias[part].to(device, torch.float64))
    values, vectors = torch.linalg.eigh(covariance)
    # A covariance has no negative eigenvalues; those that appear are rounding.
    root = (vectors * values.clamp_min(0).sqrt()) @ vectors.T
    return Fold(product.to(first), offset.to(first), root.to(first))


class FoldCache:
    """Keeps the fold of a model until its weights change.

    Changes are found by looking at the weights, through a random projection of each: a version counter does not see
    writes through ``.data``, by which weight averages are swapped in and out. A change that is lost in the rounding of
    the projections is lost in the fold as well.
    """

    def __init__(self) -> None:
        self._seen: list[Tensor] = []
        self._fold: Fold | None = None

    def get(
        self,
        first: Float[Tensor, "dim coordinates"],
        last: Float[Tensor, "coordinates dim"],
        bias: Float[Tensor, " coordinates"] | None,
    ) -> Fold:
        """The fold of these maps, as :func:`fold` makes it; it carries no gradient."""
        # Without inference mode, whose tensors could not be used outside of it later.
        with torch.inference_mode(False), torch.no_grad(), torch.autocast(first.device.type, enabled=False):
            looks = self._look(first, last, bias)
            if self._fold is None or not _same(looks, self._seen):
                self._fold, self._seen = fold(first, last, bias), looks
        return self._fold

    @staticmethod
    def _look(first: Tensor, last: Tensor, bias: Tensor | None) -> list[Tensor]:
        generator = torch.Generator().manual_seed(0)
        long = torch.randn(first.shape[1], generator=generator).to(first)
        short = torch.randn(first.shape[0], generator=generator).to(first)
        looks = [first @ long, last @ short]
        return looks if bias is None else [*looks, bias.clone()]


def _same(some: list[Tensor], others: list[Tensor]) -> bool:
    if len(some) != len(others):
        return False
    return all(
        a.shape == b.shape and a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)
        for a, b in zip(some, others, strict=True)
    )
