"""What the published diffusion methods share: their noise, their sampler, and where their reverse process runs.

FaceDiffuser and DiffSpeaker take noisy vertices in by one linear map and give clean ones by another, so that the
reverse process may run on the vertices, as published, or in the width of the first map; see
:mod:`facediff.models.folding` for why.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.errors import FaceDiffError
from facediff.models.folding import Fold, FoldedSpace, SamplingSpace, VertexSpace, WeightCache, fold
from facediff.models.graphs import BATCH, FRAMES, Axes, Graph, Speech, Spoken, speech_graph
from facediff.models.inference import BatchMotion, Progress
from facediff.models.published.base import PublishedModel, zeros
from facediff.models.samplers import NoiseProcess, NoiseSource, Sampler


class DiffusionModel(PublishedModel):
    """Base of the published methods that sample by diffusion.

    Class attributes:
        samplers: names that :meth:`choose_sampler` takes; the methods have samplers of their own.

    Args:
        options: those of :class:`PublishedModel`.
    """

    samples: ClassVar[bool] = True
    samplers: ClassVar[tuple[str, ...]] = ()

    def has_sampler(self, name: str | None) -> bool:
        """Whether it is one of the method's own."""
        return name in self.samplers

    def choose_expressivity(self, expressivity: object) -> None:
        """Samples as they are (1); the method knows no mean around which they lie, so that all else is refused."""
        if isinstance(expressivity, Tensor) or expressivity != 1:
            raise FaceDiffError(f"expressivity: {type(self).__name__} predicts no mean of its samples; omit the option")

    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """The reverse process; a clip's noise depends on its seed alone."""
        return self.sample(batch, frames, SeededNoise(frames.tolist(), seeds, self.device), progress)

    @abstractmethod
    def hear(self, heard: Spoken, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames width"]:
        """Speech features of each frame."""

    @abstractmethod
    def sample(
        self, batch: Batch, frames: Int[Tensor, " batch"], noise: NoiseSource, progress: Progress | None = None
    ) -> BatchMotion:
        """The reverse process with a given source of noise.

        Args:
            batch: clips.
            frames: how many each gets.
            noise: its random numbers, in the order in which the published code draws them.
            progress: wraps the iteration over steps.
        """


# The reverse process.


class PosteriorSampler(Sampler):
    """Ancestral sampling over all steps, by the process's own variances (Ho et al. 2020, eq. 7), without clipping.

    It is ``ddpm`` over all steps but for rounding: where hardly any noise is left, a variance that is computed back
    from ᾱ has lost its digits.

    Args:
        process: the noise process to reverse.
        skipped: noisiest steps that are left out.
    """

    linear: ClassVar[bool] = True

    def __init__(self, process: NoiseProcess, skipped: int = 0) -> None:
        super().__init__(process, process.steps)
        self.steps -= skipped
        self.timesteps, self.signal = self.timesteps[skipped:], self.signal[skipped:]

    def update(self, i: int, noisy: Tensor, predictions: Sequence[Tensor], noise: NoiseSource) -> Tensor:
        """The mean of q(xₙ₋₁ | xₙ, x̂₀), and noise but for the last step, where nothing but the prediction is left."""
        if i == self.steps - 1:
            return predictions[-1]
        beta, now, then = float(self.process.variances[self.timesteps[i]]), self.signal[i], self.signal[i + 1]
        of_clean, of_noisy = beta * math.sqrt(then) / (1 - now), (1 - then) * math.sqrt(1 - beta) / (1 - now)
        return of_clean * predictions[-1] + of_noisy * noisy + math.sqrt(beta * (1 - then) / (1 - now)) * noise(noisy)


class SeededNoise:
    """Unit Gaussian noise as a generator with a clip's seed gives it, zero on the clip's padding.

    Unlike that of the other models, it does not depend on the clip's name: so a seed gives the published code's noise.

    Args:
        frames: of each clip.
        seeds: one for each clip.
        device: where the noise is drawn.
    """

    def __init__(self, frames: Sequence[int], seeds: Sequence[int], device: torch.device) -> None:
        self.frames = list(frames)
        self.streams = [torch.Generator(device).manual_seed(seed) for seed in seeds]

    def __call__(self, like: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        """The next noise of the shape of ``like``."""
        noise = torch.zeros_like(like)
        for row, stream, frames in zip(noise, self.streams, self.frames, strict=True):
            row[:frames] = torch.randn((frames, like.shape[2]), device=like.device, dtype=like.dtype, generator=stream)
        return noise


class LinearEnds(Protocol):
    """A network between two linear maps.

    Attributes:
        audio_map: from features of speech to the network's width.
        motion_in: E x + e, from noisy motion x (3V) to the network's width.
        motion_out: U h + b, from features h to clean motion.
        of_weights: the products of both.
    """

    audio_map: nn.Linear
    motion_in: nn.Linear
    motion_out: nn.Linear
    of_weights: WeightCache[Fold]


def space_of(
    network: LinearEnds, space: SamplingSpace, rest: Tensor, *, fresh_noise: bool = True
) -> VertexSpace | FoldedSpace:
    """The space of the reverse process.

    Args:
        network: the network.
        space: ``vertices``, or ``folded`` into the width of the network's first map.
        rest: added to every prediction of clean motion, on the vertices.
        fresh_noise: whether noise is drawn in the space, and not on the vertices.
    """
    first, last = network.motion_in, network.motion_out
    if space == "vertices":
        return VertexSpace(first, last, first.in_features, rest)
    weights = (first.weight, last.weight, last.bias)
    products = network.of_weights.get(weights, fresh_noise, lambda: fold(*weights, noise=fresh_noise))
    return FoldedSpace(first, products, rest)


# The methods as graphs, without PyTorch; see facediff.models.graphs.

CONDITIONS: dict[str, Axes] = {"features": FRAMES, "identity": BATCH, "template": BATCH}


def conditions_of(features: Tensor, model: PublishedModel) -> dict[str, Tensor]:
    """Example values of what every step is given."""
    batch = features.shape[0]
    return {
        "features": features,
        "identity": zeros(batch),
        "template": torch.zeros(batch, model.n_vertices, model.dims),
    }


def features_graph(model: DiffusionModel, network: LinearEnds, steps: int) -> Graph:
    """Speech to features in the network's width.

    Args:
        model: whose audio encoder is used.
        network: the model's.
        steps: of the audio encoder for each frame.
    """

    def hear(heard: Speech, frames: Int[Tensor, " batch"], _: int) -> Tensor:
        features: Tensor = network.audio_map(model.hear(heard, frames))
        return features

    return speech_graph(model, hear, lambda frames: steps * frames)
