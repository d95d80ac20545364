"""Where the reverse process runs: on the vertices, or folded into the width of the model.

If motion enters a network by a linear map E x + e and leaves it by U h + b, every linear update of a sampler,
x_{n−1} = a x_n + c x̂₀ + s z, can be followed through E: y_n = E x_n obeys

    y_{n−1} = a y_n + c (E U h + E b) + s E z,    E z ~ N(0, E Eᵀ).

Nothing in it has as many dimensions as x, and nothing is approximated. A step of ``ddpm`` on a mesh of 23 370 vertices
takes 47 ms instead of 398 ms (tools/benchmarks/RESULTS.md).

:class:`VertexSpace` and :class:`FoldedSpace` are the two spaces, for every method with linear ends.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.models.layers import Frames, exporting

SamplingSpace = Literal["folded", "vertices"]

State = Float[Tensor, "batch frames width"]
"""Noisy or clean motion in a space, as a sampler sees it."""

ScaledMotion = Float[Tensor, "batch frames coordinates"]
"""Motion on the vertices, in the scale of the network."""

WantedMotion = Float[Tensor, "batch wanted coordinates"]
"""The same of some frames."""

Step = int | Int[Tensor, " batch"]
"""A step counted from 0: one for all clips, or one for each."""

Blend = Callable[[Tensor], Tensor]
"""From the features that the network gave in a step to those that are used."""


def unchanged(features: Tensor) -> Tensor:
    """The blend of motion that continues no other."""
    return features


def step_of_rows(step: Step, rows: Tensor) -> Int[Tensor, " batch"]:
    """The step of each row."""
    return step if isinstance(step, Tensor) else torch.full((len(rows),), step, device=rows.device)


# The two spaces.


class VertexSpace:
    """Motion itself."""

    def __init__(
        self,
        embed: Callable[[Tensor], Tensor],
        unembed: Callable[[Tensor], Tensor],
        coordinates: int,
        rest: Tensor | None = None,
    ) -> None:
        self._embed, self._unembed, self._rest = embed, unembed, rest
        self.width = coordinates

    def project(self, motion: ScaledMotion) -> State:
        """Motion as a state."""
        return motion

    def noise(self, unit: State) -> State:
        """From independent unit Gaussian noise to the image of unit Gaussian noise on vertices."""
        return unit

    def embed(self, state: State) -> Frames:
        """Noisy motion as the network sees it."""
        return self._embed(state)

    def clean(self, features: Frames) -> State:
        """Predicted clean motion as a state, from the network's last features."""
        motion = self._unembed(features)
        return motion if self._rest is None else motion + self._rest


class FoldedSpace:
    """y = E x, the noisy motion as the network sees it, without its bias; the same samples at the width's cost.

    Args:
        embed: the network's first map.
        fold: the products of both maps.
        rest: as :class:`VertexSpace` takes it, on the vertices.
    """

    def __init__(self, embed: nn.Linear, fold: Fold, rest: Tensor | None = None) -> None:
        self._embed, self._fold = embed, fold
        self.width = embed.out_features
        # Terms added on the vertices must be mapped too: E (U h + b + rest) = E U h + E b + E rest.
        self._offset = None if rest is None else fold.offset + self.project(rest)

    def project(self, motion: ScaledMotion) -> State:
        """E x: the bias e is no part of y, which would not obey the recursion with it."""
        with torch.autocast(motion.device.type, enabled=False):
            return nn.functional.linear(motion.to(self._embed.weight), self._embed.weight)

    def noise(self, unit: State) -> State:
        """Noise with the covariance E Eᵀ, independent over frames; zero where ``unit`` is."""
        assert self._fold.root is not None, "folded without noise"  # noqa: S101 - a mistake of a model's author
        with torch.autocast(unit.device.type, enabled=False):
            # S is symmetric, so that unit noise in rows has the covariance S Sᵀ = E Eᵀ from the right as well.
            return unit @ self._fold.root

    def embed(self, state: State) -> Frames:
        """E x + e."""
        return state if self._embed.bias is None else state + self._embed.bias

    def clean(self, features: Frames) -> State:
        """E U h + E b."""
        fold = self._fold
        # In the weights' own precision: errors of the state add up over the steps.
        with torch.autocast(features.device.type, enabled=False):
            if self._offset is None:
                return nn.functional.linear(features.to(fold.product), fold.product, fold.offset)
            return nn.functional.linear(features.to(fold.product), fold.product) + self._offset


# The products of the two maps.


CHUNK = 8192
"""Coordinates that are widened to float64 at a time."""


@dataclass(frozen=True)
class Fold:
    """The two linear maps in the reverse process of y = E x.

    Attributes:
        product: E U, from the last features to the folded prediction.
        offset: E b.
        root: the symmetric square root S of E Eᵀ: S ξ with unit Gaussian ξ is distributed like E z; None where noise
            is drawn on the vertices.
    """

    product: Float[Tensor, "dim features"]
    offset: Float[Tensor, " dim"]
    root: Float[Tensor, "dim dim"] | None


def fold(
    first: Float[Tensor, "dim coordinates"],
    last: Float[Tensor, "coordinates features"],
    bias: Float[Tensor, " coordinates"] | None,
    *,
    noise: bool = True,
) -> Fold:
    """Multiply the two maps out, in float64; the result has the type and the device of ``first``.

    Args:
        first: E.
        last: U.
        bias: b; zero if None.
        noise: whether the noise's covariance is needed.
    """
    # Not every accelerator knows float64.
    device = torch.device("cpu") if first.device.type == "mps" else first.device
    dim, coordinates = first.shape
    product = torch.zeros(dim, last.shape[1], dtype=torch.float64, device=device)
    offset = product.new_zeros(dim)
    covariance = product.new_zeros(dim, dim)
    # In float64, since products over 70 000 coordinates lose digits in float32; by chunks, since both maps in float64
    # would double the memory of the model.
    for part in (slice(begin, begin + CHUNK) for begin in range(0, coordinates, CHUNK)):
        e = first[:, part].to(device, torch.float64)
        product.addmm_(e, last[part].to(device, torch.float64))
        if bias is not None:
            offset.addmv_(e, bias[part].to(device, torch.float64))
        if noise:
            covariance.addmm_(e, e.T)
    return Fold(product.to(first), offset.to(first), symmetric_root(covariance).to(first) if noise else None)


def symmetric_root(covariance: Float[Tensor, "dim dim"]) -> Float[Tensor, "dim dim"]:
    """The symmetric square root of a covariance of any rank."""
    # The symmetric root is unique: it does not depend on the signs and the order of eigenvectors, which libraries
    # choose as they like, so that equal seeds give comparable motion. A Cholesky factor would need full rank.
    values, vectors = torch.linalg.eigh(covariance)
    # A covariance has no negative eigenvalues; those that appear are rounding.
    return (vectors * values.clamp_min(0).sqrt()) @ vectors.T


T = TypeVar("T")


class WeightCache(Generic[T]):
    """Keeps tensors computed from weights until the weights change.

    The weights themselves are looked at, through a random projection of each matrix: a version counter does not see
    writes through ``.data``, by which weight averages are swapped in and out. A change that is lost in the rounding of
    the projections is lost in these tensors as well.
    """

    def __init__(self) -> None:
        self._seen: list[Tensor] = []
        self._key: Hashable = None
        self._value: T | None = None

    def get(self, weights: Sequence[Tensor], key: Hashable, compute: Callable[[], T]) -> T:
        """What ``compute`` gives for these weights, without gradient and in their own precision."""
        # Tensors made in inference mode could not be used in training later.
        if exporting() and self._value is not None:
            return self._value  # of the run before; a graph holds it as a constant
        with torch.inference_mode(False), torch.no_grad(), torch.autocast(weights[0].device.type, enabled=False):
            views = [projection(weight) for weight in weights]
            if self._value is None or key != self._key or not same(views, self._seen):
                self._value, self._key, self._seen = compute(), key, views
        return self._value


def projection(weight: Tensor) -> Tensor:
    """A matrix's product with a fixed random vector; a copy of anything else."""
    # Vectors are short enough to be kept. Of a matrix of 70 000 × 512 numbers a copy would take 140 MB, and its
    # projection takes 280 kB at most.
    if weight.dim() != 2:
        return weight.detach().clone()
    return weight @ torch.randn(weight.shape[1], generator=torch.Generator().manual_seed(0)).to(weight)


def same(first: Sequence[Tensor], second: Sequence[Tensor]) -> bool:
    """Whether tensors are equal one by one, also in type and device."""
    return len(first) == len(second) and all(
        a.dtype == b.dtype and a.device == b.device and torch.equal(a, b) for a, b in zip(first, second, strict=True)
    )
