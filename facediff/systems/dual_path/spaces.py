"""Where the reverse process runs: on vertices, or folded into the width of the model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.diffusion.folding import Fold, FoldCache
from facediff.diffusion.samplers import Sampler
from facediff.errors import FaceDiffError
from facediff.systems.dual_path.network import Conditions, DualPathNetwork
from facediff.systems.dual_path.seam import unchanged

SamplingSpace = Literal["folded", "vertices"]

Blend = Callable[[Tensor], Tensor]
"""From the features that the network gave in a step to those that are used."""


class Space(Protocol):
    """A linear image of motion in which a sampler runs, none the wiser; made anew for every run.

    Attributes:
        width: numbers in a frame.
    """

    width: int

    def noise(self, unit: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        """From independent unit Gaussian noise to the image of unit Gaussian noise on vertices."""
        ...

    def predict(
        self, state: Float[Tensor, "batch frames width"], step: Int[Tensor, " batch"], conditions: Conditions
    ) -> Float[Tensor, "batch frames width"]:
        """The image of the predicted clean motion."""
        ...

    def motion(self, sample: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames coordinates"]:
        """Scaled motion of the sampler's result."""
        ...


class VertexSpace:
    """Motion itself; needs nothing of the network or the sampler.

    Args:
        network: the network.
        width: coordinates of a frame, 3V.
        blend: changes the features of every step.
    """

    def __init__(self, network: DualPathNetwork, width: int, blend: Blend = unchanged) -> None:
        self.network = network
        self.width = width
        self.blend = blend

    def noise(self, unit: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        """Unit noise as it is."""
        return unit

    def predict(
        self, state: Float[Tensor, "batch frames width"], step: Int[Tensor, " batch"], conditions: Conditions
    ) -> Float[Tensor, "batch frames width"]:
        """M̂⁰."""
        return self.network.leave(self.blend(self.network.core(self.network.embed(state), step, conditions)))

    def motion(self, sample: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames coordinates"]:
        """The sample as it is."""
        return sample


class FoldedSpace:
    """y = E x, the noisy motion as the network sees it, without its bias; the same samples at the width's cost.

    The last step of a linear sampler returns the last prediction E M̂⁰, and that is M̂⁰ = U h + b of the features h
    which the network gave last: they are kept, since y alone does not say where the vertices are.

    Args:
        network: a network whose ``embed`` and ``unembed`` are linear.
        fold: their products.
        blend: changes the features of every step.
    """

    def __init__(self, network: DualPathNetwork, fold: Fold, blend: Blend = unchanged) -> None:
        self.network = network
        self.fold = fold
        self.blend = blend
        self.width = len(fold.offset)
        self._features: Tensor | None = None
        self._prediction: Tensor | None = None

    def noise(self, unit: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        """Noise with the covariance E Eᵀ, independent over frames; zero where ``unit`` is."""
        with torch.autocast(unit.device.type, enabled=False):
            return unit @ self.fold.root

    def predict(
        self, state: Float[Tensor, "batch frames width"], step: Int[Tensor, " batch"], conditions: Conditions
    ) -> Float[Tensor, "batch frames width"]:
        """E M̂⁰ = E U h + E b."""
        bias = self.network.embed.bias
        features = self.blend(self.network.core(state if bias is None else state + bias, step, conditions))
        with torch.autocast(features.device.type, enabled=False):
            prediction = nn.functional.linear(features.to(state.dtype), self.fold.product, self.fold.offset)
        self._features, self._prediction = features, prediction
        return prediction

    def motion(self, sample: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames coordinates"]:
        """U h + b, the only step over the vertices.

        Raises:
            FaceDiffError: if the sampler did not end at the last prediction.
        """
        features, prediction = self._features, self._prediction
        if (
            features is None
            or prediction is None
            or not torch.allclose(sample, prediction, rtol=1e-3, atol=1e-4, equal_nan=True)
        ):
            raise FaceDiffError(
                "sampler: it says that it is linear, but its last step does not return the last prediction; "
                "choose --model.sampling_space=vertices"
            )
        return self.network.leave(features)


def choose_space(
    network: DualPathNetwork, wanted: SamplingSpace, sampler: Sampler, cache: FoldCache, blend: Blend = unchanged
) -> Space:
    """The folded space where it is wanted and exact, else the vertices.

    Args:
        network: the network; it can be folded if both ends are linear.
        wanted: the space asked for.
        sampler: the sampler that will run; it can be folded if it is linear.
        cache: the network's fold from earlier.
        blend: changes the features that the network gives in every step.
    """
    first, last = network.embed, network.unembed
    if wanted == "folded" and sampler.linear and isinstance(first, nn.Linear) and isinstance(last, nn.Linear):
        return FoldedSpace(network, cache.get(first.weight, last.weight, last.bias), blend)
    return VertexSpace(network, network.coordinates, blend)
