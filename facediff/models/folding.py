"""Where the reverse process runs: on the vertices, or folded into the width of the model.

If motion enters a network by a linear map E x + e and leaves it by U h + b, every linear update of a sampler,
x_{n−1} = a x_n + c x̂₀ + s z, can be followed through E: y_n = E x_n obeys

    y_{n−1} = a y_n + c (E U h + E b) + s E z,    E z ~ N(0, E Eᵀ).

Nothing in it has as many dimensions as x, and nothing is approximated. A step of ``ddpm`` on a mesh of 23 370 vertices
takes 47 ms instead of 398 ms (tools/benchmarks/RESULTS.md).

A sampler sees a :class:`Space`, made once for each run by a network's ``prepare_for_inference``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.errors import FaceDiffError
from facediff.models.layers import Frames, exporting
from facediff.models.motion_space import Preconditioning

SamplingSpace = Literal["folded", "vertices"]

State = Float[Tensor, "batch frames width"]
"""Noisy or clean motion in a space, as a sampler sees it."""

ScaledMotion = Float[Tensor, "batch frames coordinates"]
"""Motion on the vertices, in the scale of the network."""

WantedMotion = Float[Tensor, "batch wanted coordinates"]
"""The same of the frames from a first one on."""

Step = int | Int[Tensor, " batch"]
"""A step counted from 0: one for all clips, or one for each."""

Blend = Callable[[Tensor], Tensor]
"""From the features that the network gave in a step to those that are used."""


def unchanged(features: Tensor) -> Tensor:
    """The blend of motion that continues no other."""
    return features


def each_step(step: Step, rows: Tensor) -> Int[Tensor, " batch"]:
    """The step of each row."""
    return step if isinstance(step, Tensor) else torch.full((len(rows),), step, device=rows.device)


@runtime_checkable
class Network(Protocol):
    """What a space needs of a denoising network.

    Attributes:
        coordinates: numbers in a frame of motion, 3V.
        embed: the first map, from noisy motion to the network's width.
        unembed: the last map, from features to clean motion.
    """

    coordinates: int
    embed: nn.Linear
    unembed: nn.Linear

    def core(
        self,
        motion: Frames,
        step: Int[Tensor, " batch"],
        conditions: Any,  # noqa: ANN401 - the network's own
    ) -> Frames:
        """Everything between the two maps."""
        ...

    def clean_motion(self, features: Frames) -> ScaledMotion:
        """The last map in the weights' own precision."""
        ...


class Space(ABC):
    """A linear image of motion in which a sampler runs without knowing which; made for one run.

    Args:
        network: predicts clean motion.
        conditions: what it is conditioned on, with everything else that is constant over the denoising steps. Under
            guidance, all clips with their conditions, then all clips with some of them hidden, and so on.
        width: numbers in a frame of the image.
        blend: changes the features that the network gives in every step.
        shares: what each of these predictions contributes to the guided one; they add up to one.
    """

    def __init__(
        self,
        network: Network,
        conditions: object,
        width: int,
        blend: Blend = unchanged,
        shares: Sequence[float] = (1.0,),
    ) -> None:
        self.network = network
        self.conditions = conditions
        self.width = width
        self.blend = blend
        self.shares = shares

    def features(self, embedded: Frames, step: Step) -> Frames:
        """The network's last features of embedded noisy motion, guided, at a step counted from 0."""
        views = len(self.shares)
        rows = embedded if views == 1 else embedded.repeat(views, 1, 1)
        steps = each_step(step, rows)
        features = self.network.core(rows, steps, self.conditions)
        if views == 1:
            return features
        # A combination of features is the same one of predictions, since the last map is affine and the shares add up
        # to one. In 16 bits, a large difference of near numbers would be mostly rounding.
        wide = features.to(torch.promote_types(features.dtype, torch.float32))
        return torch.stack([share * part for share, part in zip(self.shares, wide.chunk(views), strict=True)]).sum(0)

    @abstractmethod
    def noise(self, unit: State) -> State:
        """From independent unit Gaussian noise to the image of unit Gaussian noise on vertices."""

    @abstractmethod
    def denoise(self, state: State, step: Step) -> State:
        """The image of the predicted clean motion."""

    @abstractmethod
    def motion(self, sample: State, first: int = 0) -> WantedMotion:
        """Scaled motion of the sampler's result, from a first frame on."""


class VertexSpace(Space):
    """Motion itself; needs nothing of the network or the sampler."""

    def __init__(
        self, network: Network, conditions: object, blend: Blend = unchanged, shares: Sequence[float] = (1.0,)
    ) -> None:
        super().__init__(network, conditions, network.coordinates, blend, shares)

    def noise(self, unit: State) -> State:
        """Unit noise as it is."""
        return unit

    def denoise(self, state: State, step: Step) -> State:
        """M̂⁰."""
        return self.network.clean_motion(self.blend(self.features(self.network.embed(state), step)))

    def motion(self, sample: State, first: int = 0) -> WantedMotion:
        """The sample as it is."""
        return sample[:, first:]


class FoldedSpace(Space):
    """y = E x, the noisy motion as the network sees it, without its bias; the same samples at the width's cost.

    Args:
        network: a network whose ``embed`` and ``unembed`` are linear.
        conditions: as :class:`Space` takes them.
        fold: the products of both maps.
        blend: as :class:`Space` takes it.
        shares: as :class:`Space` takes them.
    """

    def __init__(
        self,
        network: Network,
        conditions: object,
        fold: Fold,
        blend: Blend = unchanged,
        shares: Sequence[float] = (1.0,),
    ) -> None:
        super().__init__(network, conditions, len(fold.offset), blend, shares)
        self.fold = fold
        self._last: tuple[Tensor, Tensor] | None = None  # features and prediction of the latest step

    def noise(self, unit: State) -> State:
        """Noise with the covariance E Eᵀ, independent over frames; zero where ``unit`` is."""
        with torch.autocast(unit.device.type, enabled=False):
            return unit @ self.fold.root

    def denoise(self, state: State, step: Step) -> State:
        """E M̂⁰ = E U h + E b."""
        # The bias e of the first map is no part of y, which would not obey the recursion with it.
        bias = self.network.embed.bias
        features = self.blend(self.features(state if bias is None else state + bias, step))
        # In the weights' own precision: errors of the state add up over the steps.
        with torch.autocast(features.device.type, enabled=False):
            prediction = nn.functional.linear(features.to(state.dtype), self.fold.product, self.fold.offset)
        self._last = features, prediction
        return prediction

    def motion(self, sample: State, first: int = 0) -> WantedMotion:
        """U h + b, the only step over the vertices.

        Raises:
            FaceDiffError: if the sampler did not end at the last prediction.
        """
        # y alone does not say where the vertices are. But the last step of a linear sampler returns the last prediction
        # E M̂⁰, and M̂⁰ = U h + b of the features h that the network gave for it, which were kept.
        if self._last is None or not torch.allclose(sample, self._last[1], rtol=1e-3, atol=1e-4, equal_nan=True):
            raise FaceDiffError(
                "sampler: it is declared linear, but its last step does not return the last prediction; "
                "choose --model.sampling_space=vertices"
            )
        return self.network.clean_motion(self._last[0][:, first:])


class PreconditionedSpace(Space):
    """Coordinates of motion with known variances; the network predicts what the noisy motion leaves open.

    Args:
        network: predicts that.
        conditions: as :class:`Space` takes them.
        preconditioning: the scales around the network.
        blend: changes the predictions of every step.
        shares: as :class:`Space` takes them.
    """

    def __init__(
        self,
        network: Network,
        conditions: object,
        preconditioning: Preconditioning,
        blend: Blend = unchanged,
        shares: Sequence[float] = (1.0,),
    ) -> None:
        super().__init__(network, conditions, network.coordinates, blend, shares)
        self.preconditioning = preconditioning

    def noise(self, unit: State) -> State:
        """Unit noise as it is."""
        return unit

    def denoise(self, state: State, step: Step) -> State:
        """M̂⁰."""
        steps = each_step(step, state)
        scaled = self.preconditioning.into[steps][:, None] * state
        features = self.features(self.network.embed(scaled), step)
        # The prediction is blended, not the features: the noisy motion is a part of it.
        return self.blend(self.preconditioning.clean(state, self.network.clean_motion(features), steps))

    def motion(self, sample: State, first: int = 0) -> WantedMotion:
        """The sample as it is."""
        return sample[:, first:]


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

    Args:
        first: E.
        last: U.
        bias: b; zero if None.
    """
    product, offset = fold_maps(first, last, bias)
    return Fold(product, offset, fold_noise(first))


def fold_maps(
    first: Float[Tensor, "dim coordinates"],
    last: Float[Tensor, "coordinates features"],
    bias: Float[Tensor, " coordinates"] | None,
) -> tuple[Float[Tensor, "dim features"], Float[Tensor, " dim"]]:
    """E U and E b, in float64; the arguments are those of :func:`fold`."""
    device = fold_device(first)
    product = torch.zeros(first.shape[0], last.shape[1], dtype=torch.float64, device=device)
    offset = product.new_zeros(len(first))
    for part in fold_parts(first):
        e = first[:, part].to(device, torch.float64)
        product.addmm_(e, last[part].to(device, torch.float64))
        if bias is not None:
            offset.addmv_(e, bias[part].to(device, torch.float64))
    return product.to(first), offset.to(first)


def fold_noise(first: Float[Tensor, "dim coordinates"]) -> Float[Tensor, "dim dim"]:
    """The symmetric square root of E Eᵀ, in float64."""
    device = fold_device(first)
    covariance = torch.zeros(len(first), len(first), dtype=torch.float64, device=device)
    for part in fold_parts(first):
        e = first[:, part].to(device, torch.float64)
        covariance.addmm_(e, e.T)
    # By eigenvectors, so that E may have any rank. The symmetric root is unique: it does not depend on the signs and
    # the order of eigenvectors, which libraries choose as they like, so that equal seeds give comparable motion.
    values, vectors = torch.linalg.eigh(covariance)
    # A covariance has no negative eigenvalues; those that appear are rounding.
    return ((vectors * values.clamp_min(0).sqrt()) @ vectors.T).to(first)


def fold_parts(first: Tensor) -> list[slice]:
    """The coordinates by chunks."""
    # In float64, since products over 70 000 coordinates lose digits in float32; by chunks, since both maps in float64
    # would double the memory of the model.
    return [slice(begin, begin + CHUNK) for begin in range(0, first.shape[1], CHUNK)]


def fold_device(first: Tensor) -> torch.device:
    """Where float64 is known; not every accelerator knows it."""
    return torch.device("cpu") if first.device.type == "mps" else first.device


T = TypeVar("T")


class WeightCache(Generic[T]):
    """Keeps what was computed from weights until they are found changed.

    The weights themselves are looked at, through a random projection of each matrix: a version counter does not see
    writes through ``.data``, by which weight averages are swapped in and out. A change that is lost in the rounding of
    the projections is lost in what is computed as well.
    """

    def __init__(self) -> None:
        self._seen: list[Tensor] = []
        self._key: Hashable = None
        self._value: T | None = None

    def get(self, weights: Sequence[Tensor], key: Hashable, compute: Callable[[], T]) -> T:
        """What ``compute`` gives for these weights, without gradient and in their own precision.

        Args:
            weights: everything that the value depends on, matrices and vectors.
            key: which value is wanted; one is kept at a time.
            compute: computes it.
        """
        # Tensors made in inference mode could not be used in training later.
        if exporting() and self._value is not None:
            return self._value  # of the run before; a graph holds it as a constant
        with torch.inference_mode(False), torch.no_grad(), torch.autocast(weights[0].device.type, enabled=False):
            seen = [projection(weight) for weight in weights]
            if self._value is None or key != self._key or not same(seen, self._seen):
                self._value, self._key, self._seen = compute(), key, seen
        return self._value


def projection(weight: Tensor) -> Tensor:
    """A matrix's product with a fixed random vector; a copy of anything else."""
    if weight.dim() != 2:
        return weight.detach().clone()
    return weight @ torch.randn(weight.shape[1], generator=torch.Generator().manual_seed(0)).to(weight)


def same(some: Sequence[Tensor], others: Sequence[Tensor]) -> bool:
    """Whether tensors are equal one by one, also in type and device."""
    return len(some) == len(others) and all(
        a.dtype == b.dtype and a.device == b.device and torch.equal(a, b) for a, b in zip(some, others, strict=True)
    )
