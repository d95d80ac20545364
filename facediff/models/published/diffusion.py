"""Shared parts of the published diffusion methods: their noise, their sampler, the space of their reverse process.

FaceDiffuser and DiffSpeaker take noisy vertices in by one linear map and give clean ones by another, so that the
reverse process may run on the vertices, as published, or in the width of the first map; see
:mod:`facediff.models.folding` for why.
"""

from __future__ import annotations

import inspect
import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.models.folding import Fold, FoldedSpace, SamplingSpace, VertexSpace, WeightCache, fold
from facediff.models.graphs import (
    BATCH,
    FRAMES,
    Axes,
    Graph,
    Graphs,
    ModelPart,
    SamplingLoop,
    Speech,
    SpeechInput,
    results_of,
    speech_graph,
    update_table,
)
from facediff.models.inference import BatchMotion, ClipNoise, Progress
from facediff.models.published.base import PublishedModel, whole_model
from facediff.models.samplers import NoiseProcess, NoiseSource, Sampler


class DiffusionModel(PublishedModel):
    """Base of the published methods that sample by diffusion.

    Class attributes:
        samplers: names that :meth:`choose_sampler` takes; the methods have samplers of their own.
        speech_steps: of the audio encoder for each frame.
        fresh_noise: whether noise is drawn in the space of the reverse process, and not on the vertices.

    Args:
        options: as of :class:`PublishedModel`.
    """

    samples: ClassVar[bool] = True
    samplers: ClassVar[tuple[str, ...]] = ()
    speech_steps: ClassVar[int] = 1
    fresh_noise: ClassVar[bool] = True
    network: LinearEnds
    sampling_space: SamplingSpace

    def has_sampler(self, name: str | None) -> bool:
        """Whether it is one of the method's own."""
        return name in self.samplers

    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """The reverse process; a clip's noise depends on its seed alone."""
        return self.sample(batch, frames, seeded_noise(frames.tolist(), seeds, self.device), progress)

    @abstractmethod
    def encode_speech(self, speech: SpeechInput, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames width"]:
        """Speech features of each frame."""

    @property
    @abstractmethod
    def sampler(self) -> Sampler:
        """The present one."""

    def state_space(self, rest: Tensor | None = None) -> VertexSpace | FoldedSpace:
        """The space of the reverse process.

        Args:
            rest: added to every prediction of clean motion, on the vertices; zeros if None.
        """
        first, last = self.network.motion_in, self.network.motion_out
        rest = last.bias.new_zeros(1, 1, self.coordinates) if rest is None else rest
        if self.sampling_space == "vertices":
            return VertexSpace(first, last, first.in_features, rest)
        weights = (first.weight, last.weight, last.bias)
        products = self.network.of_weights.get(
            weights, self.fresh_noise, lambda: fold(*weights, noise=self.fresh_noise)
        )
        return FoldedSpace(first, products, rest)

    @abstractmethod
    def first_state(self, noise: Float[Tensor, "batch frames drawn"]) -> Float[Tensor, "batch frames state"]:
        """The state that sampling starts from, of unit noise."""

    @abstractmethod
    def sample(
        self, batch: Batch, frames: Int[Tensor, " batch"], noise: NoiseSource, progress: Progress | None = None
    ) -> BatchMotion:
        """The reverse process with a given source of noise."""


# The reverse process.


class PosteriorSampler(Sampler):
    """Ancestral sampling over all steps, by the process's own variances (Ho et al. 2020, eq. 7), without clipping.

    ``ddpm`` over all steps differs by rounding alone: where hardly any noise is left, a variance that is computed back
    from ᾱ has lost its digits.
    """

    linear: ClassVar[bool] = True

    def __init__(self, process: NoiseProcess, skipped: int = 0) -> None:
        super().__init__(process, process.steps)
        self.steps -= skipped
        self.timesteps, self.signal = self.timesteps[skipped:], self.signal[skipped:]

    def update(self, i: int, noisy: Tensor, predictions: Sequence[Tensor], noise: NoiseSource) -> Tensor:
        """The mean of q(xₙ₋₁ | xₙ, x̂₀) and new noise; in the last step the prediction alone."""
        if i == self.steps - 1:
            return predictions[-1]
        beta = float(self.process.variances[self.timesteps[i]])
        signal_now, signal_after = self.signal[i], self.signal[i + 1]
        of_clean = beta * math.sqrt(signal_after) / (1 - signal_now)
        of_noisy = (1 - signal_after) * math.sqrt(1 - beta) / (1 - signal_now)
        deviation = math.sqrt(beta * (1 - signal_after) / (1 - signal_now))
        return of_clean * predictions[-1] + of_noisy * noisy + deviation * noise(noisy)


def seeded_noise(frames: Sequence[int], seeds: Sequence[int], device: torch.device) -> ClipNoise:
    """Unit Gaussian noise as a generator with a clip's seed gives it, zero on the clip's padding.

    The clip's name does not enter, unlike in the other models: so a seed gives the published code's noise.
    """
    return ClipNoise([""] * len(seeds), frames, seeds, device)


class LinearEnds(Protocol):
    """A network between two linear maps."""

    audio_map: nn.Linear
    motion_in: nn.Linear
    motion_out: nn.Linear
    of_weights: WeightCache[Fold]


# The methods as graphs, without PyTorch; see facediff.models.graphs.

AXES: dict[str, Axes] = {"features": FRAMES, "identity": BATCH, "template": BATCH, "state": FRAMES, "step": BATCH}
"""Which axes of the inputs of one denoising step have any length."""


class SamplingStart(ModelPart[DiffusionModel]):
    """Unit noise to the state that sampling starts from."""

    def forward(self, noise: Float[Tensor, "batch frames drawn"]) -> Float[Tensor, "batch frames state"]:
        """The first state."""
        return self.model.first_state(noise)


def diffusion_graphs(
    model: DiffusionModel,
    step: nn.Module,
    motion: nn.Module,
    sampler: str,
    *,
    drawn: int,
    state: int,
    decoded: Literal["sample", "kept"] = "sample",
    starts: bool = False,
    last_noise: bool = False,
) -> Graphs:
    """Speech to features, one denoising step, the last map, and the start where it is more than unit noise.

    Args:
        model: the method.
        step: from noisy to clean motion, and the features that the last map takes; its ``forward`` has arguments of
            :data:`AXES`.
        motion: from the end of sampling to offsets from the template.
        sampler: its name.
        drawn: numbers in a frame of the unit noise.
        state: numbers in a frame of the state.
        decoded: the input of ``motion``: the end of sampling, or the features of the last step.
        starts: whether the first state is more than unit noise.
        last_noise: whether ``motion`` takes the unit noise too.
    """
    network = model.network

    def encode(speech: Speech, frames: Int[Tensor, " batch"], _: int) -> Tensor:
        features: Tensor = network.audio_map(model.encode_speech(speech, frames))
        return features

    speech = speech_graph(model, encode, lambda frames: model.speech_steps * frames)
    features = results_of(speech)
    batch, frames, dim = features.shape
    examples = {
        "features": features,
        "identity": torch.zeros(batch, dtype=torch.long),
        "template": torch.zeros(batch, model.n_vertices, model.dims),
        "state": torch.zeros(batch, frames, state),
        "step": torch.zeros(batch, dtype=torch.long),
    }
    inputs = {name: examples[name] for name in inspect.signature(step.forward).parameters}
    denoising = Graph("step", step, inputs, {name: AXES[name] for name in inputs}, ("prediction", "kept"))
    noise = torch.zeros(batch, frames, drawn)
    last = {"sample": features if decoded == "kept" else examples["state"]} | ({"noise": noise} if last_noise else {})
    parts = [speech, denoising, Graph("motion", motion, last, dict.fromkeys(last, FRAMES), ("offsets",))]
    if starts:
        parts.append(Graph("start", SamplingStart(model), {"noise": noise}, {"noise": FRAMES}, ("state",)))
    results_of(denoising)  # constants that follow from the weights are computed here, not in the graph
    root = None
    if model.sampling_space == "folded" and model.fresh_noise:
        with torch.no_grad():
            root = model.state_space().noise(torch.eye(state)[None])[0]
    loop = SamplingLoop(
        state=state,
        drawn=drawn,
        kept=dim,
        sampler=sampler,
        steps=model.sampler.timesteps,
        table=update_table(model.sampler),
        last_step=-1,
        decoded=decoded,
        noise=root,
        noise_of="seed",
    )
    return whole_model(model, parts, loop)
