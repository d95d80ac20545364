"""DiffSpeaker (Ma et al.: "DiffSpeaker: Speech-Driven 3D Facial Animation with Diffusion Transformer", 2024).

Diffusion over offsets from the template, with one Transformer layer in which the speaker and the denoising step are
tokens that every frame attends to. From top to bottom: the model, its sampler, its network, its graphs.
docs/methods.md says which choices of the published code are options here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch
from facediff.errors import check_known
from facediff.models.audio_encoders import AudioEncoderFactory
from facediff.models.base import Decay
from facediff.models.folding import Fold, SamplingSpace, WeightCache
from facediff.models.graphs import Graphs, ModelPart, SpeechInput
from facediff.models.inference import BatchMotion, Progress
from facediff.models.layers import AttentionContext, Heads, Layers, Share, Width, check_heads, frame_mask
from facediff.models.published.autoregressive import Period, SpeechDecoderLayer
from facediff.models.published.base import TRAINED_NETWORK, LongSpeech, SpeakerTable, still_map
from facediff.models.published.diffusion import DiffusionModel, diffusion_graphs
from facediff.models.published.positions import distance_bias, periodic_positions
from facediff.models.samplers import NoiseProcess, NoiseSource, Sampler
from facediff.models.squared_errors import squared_errors
from facediff.utils.ranges import Range

Scheduler = Literal["published", "ddim"]
"""The published scheduler's update of DDIM, or the paper's."""

TRAINING_STEPS = 1000
"""Noising steps of the process that the sampler's steps are taken from."""


@registry.model.register("DiffSpeaker")
class DiffSpeaker(DiffusionModel):
    """DiffSpeaker: a diffusion Transformer with the speaker and the step as tokens, and biased attention.

    Args:
        dim: channels of the Transformer; 1024 at 25 frames a second (BIWI) and 512 otherwise if None.
        num_layers: its layers.
        num_heads: its attention heads.
        feed_forward_dim: channels between the two maps of its feed-forward layers; twice ``dim`` if None.
        dropout: in the Transformer and on its positions, in training.
        period: frames after which positions and the attention's bias repeat; one second if None.
        scheduler: ``published`` is DDIM as diffusers 0.11 had it, which takes the predicted clean motion for the
            predicted noise where it goes to the next step; ``ddim`` computes that noise, as the paper of DDIM does.
        sampling_steps: denoising steps, at most 1000.
        smooth: take the mean of each frame, the one before and the one after it; at 30 frames a second (VOCASET) if
            None, as published.
        long_speech: for more than 3000 frames the published tables have no rows: ``refuse``
            them, as published; animate ``windows`` of them; or ``extend`` the tables by their formula.
        weight_decay: AdamW's, as PyTorch has it.
        options: as of :class:`DiffusionModel`, and of every model.
    """

    chosen: ClassVar[tuple[str, ...]] = (*DiffusionModel.chosen, "scheduler", "sampling_steps")
    samplers: ClassVar[tuple[str, ...]] = ("ddim",)
    table_frames: ClassVar[int | None] = 3000
    interpolates: ClassVar[bool] = True
    network: DiffSpeakerNetwork
    fresh_noise: ClassVar[bool] = False
    sampling_space: SamplingSpace = "folded"  # the same motion for the same noise as on vertices, to rounding
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        TRAINED_NETWORK, source="facebook/hubert-base-ls960", epsilon=1e-7
    )

    def __init__(
        self,
        *,
        dim: Width | None = None,
        num_layers: Layers = 1,
        num_heads: Heads = 4,
        feed_forward_dim: Width | None = None,
        dropout: Share = 0.1,
        period: Period | None = None,
        scheduler: Scheduler = "published",
        sampling_steps: Annotated[int, Range(1, TRAINING_STEPS)] = 50,
        smooth: bool | None = None,
        long_speech: LongSpeech = "refuse",
        weight_decay: Decay = 0.01,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(weight_decay=weight_decay, **options)
        self.dim = dim or (1024 if self.frame_rate == 25.0 else 512)
        check_heads(dim=self.dim, num_heads=num_heads, even=True)
        self.scheduler: Scheduler = scheduler
        self.sampling_steps = sampling_steps
        self.smooth = self.frame_rate == 30.0 if smooth is None else smooth
        self.plan_long_speech(long_speech)
        # Scaled-linear variances from 0.00085 to 0.012, the latent-diffusion schedule that the authors' configuration
        # names, in single precision as published.
        variances = torch.linspace(0.00085**0.5, 0.012**0.5, TRAINING_STEPS, device="cpu") ** 2
        self.process = NoiseProcess(variances=variances)
        self.network = DiffSpeakerNetwork(
            audio_width=self.audio_width,
            coordinates=self.coordinates,
            dim=self.dim,
            num_layers=num_layers,
            num_heads=num_heads,
            hidden_dim=feed_forward_dim or 2 * self.dim,
            dropout=dropout,
            period=period or max(1, round(self.frame_rate)),
            n_identities=len(self.identities),
        )

    def choose_sampler(self, name: str | None = None, steps: int | None = None) -> None:
        """Change the number of denoising steps, or correct the published scheduler.

        Args:
            name: ``ddim`` for DDIM as its paper has it; the present scheduler if None.
            steps: denoising steps; the present number if None.
        """
        check_known("{sampler}", "sampler of DiffSpeaker", [] if name is None else [name], self.samplers)
        self.scheduler = "ddim" if name == "ddim" else self.scheduler
        self.sampling_steps = self.sampling_steps if steps is None else steps
        _ = self.sampler  # refuses a number of steps that the process has not

    # Frames, speech and the speaker.

    def tested_frames(self, batch: Batch) -> list[int]:
        """As many as the truth has, as in the published test."""
        return [int(frames) for frames in batch.frame_lengths]

    def unknown_weights(self) -> Float[Tensor, " identities"]:
        """Of identity 0, which the published test takes for a subject that was not trained on."""
        return torch.eye(len(self.identities))[0]

    def encode_speech(self, speech: SpeechInput, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames width"]:
        """Hidden states, interpolated to the frames."""
        return self.speech_features(speech, frames, "hidden")

    def conditions(self, batch: Batch, frames: Int[Tensor, " batch"]) -> SpeakerConditions:
        """The conditions of every step."""
        valid = frame_mask(frames, int(frames.max())) if bool((frames != frames.max()).any()) else None
        speech = self.network.audio_map(self.encode_speech(batch, frames))
        return self.network.conditions(speech, self.identity_weights(batch), valid)

    # Training.

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The mean squared error of the predicted clean motion at a random step, and of its first differences."""
        step = torch.randint(0, TRAINING_STEPS, (len(batch),), device=self.device, generator=generator)
        noise = torch.randn(batch.motion.flatten(2).shape, device=self.device, generator=generator)
        return self.losses_at(batch, step, noise)

    def losses_at(
        self, batch: Batch, step: Int[Tensor, " batch"], noise: Float[Tensor, "batch frames coordinates"]
    ) -> dict[str, Tensor]:
        """The losses with given random numbers."""
        frames = batch.frame_lengths
        self.check_length(frames, batch.names)
        mask = frame_mask(frames, batch.motion.shape[1])[..., None]
        clean = (batch.motion * self.scale).flatten(2) * mask
        noisy = self.process.add_noise(clean, noise * mask, step)
        predicted = self.network.motion_out(
            self.network(self.network.motion_in(noisy), step, self.conditions(batch, frames))
        )
        # Published: the mean over all entries, padding included, in which errors are zero. A short clip next to a long
        # one counts less.
        position, velocity = squared_errors(predicted * mask, clean, torch.full_like(frames, clean.shape[1]))
        position = position / clean.numel()
        velocity = velocity / max(1, clean[:, 1:].numel())
        return {"reconstruction": position, "velocity": velocity, "loss": position + velocity}

    # Sampling.

    def graphs(self) -> Graphs:
        """The present scheduler, and the last map with the smoothing; noise is drawn once, on the vertices."""
        return diffusion_graphs(
            self,
            SpeakerStep(self),
            SpeakerMotion(self),
            f"{self.scheduler} DDIM" if self.scheduler == "published" else "ddim",
            drawn=self.coordinates,
            state=2 * self.dim + 2,
            starts=True,
            last_noise=not self.sampler.literal,
        )

    @property
    def sampler(self) -> SpeakerSampler:
        """The present one."""
        return SpeakerSampler(self.process, self.sampling_steps, literal=self.scheduler == "published")

    def sample(
        self, batch: Batch, frames: Int[Tensor, " batch"], noise: NoiseSource, progress: Progress | None = None
    ) -> BatchMotion:
        """The reverse process from noise that is drawn once."""
        self.check_length(frames, batch.names)
        conditions = self.conditions(batch, frames)
        initial_noise = noise(batch.template.new_empty(len(batch), int(frames.max()), self.coordinates))

        def denoise(state: Tensor, step: int) -> Tensor:
            return self.predict(state, torch.full((len(batch),), step, device=state.device), conditions)[0]

        state = self.sampler.run(denoise, self.first_state(initial_noise), progress=progress)
        motion = self.motion_of(state, initial_noise)
        return smoothed(motion, frames) if self.smooth else motion

    # In the folded space, noisy motion is a sum of maps of the network's features, of a bias and of the first noise,
    # each with a factor that the sampler makes, so that the vertices are not needed before the end. A frame of the
    # state is: noisy motion as the network sees it, the sum of the network's features, the bias's factor, the first
    # noise's factor.

    def first_state(self, noise: Float[Tensor, "batch frames coordinates"]) -> Float[Tensor, "batch frames state"]:
        """Noise alone, without features and bias."""
        state = self.state_space().project(noise)
        ones = torch.ones_like(state[..., :1])
        return torch.cat([state, torch.zeros_like(state), torch.zeros_like(ones), ones], -1)

    def predict(
        self, state: Float[Tensor, "batch frames state"], step: Int[Tensor, " batch"], conditions: SpeakerConditions
    ) -> tuple[Tensor, Tensor]:
        """Clean motion as a state, and the features that it is a map of."""
        space = self.state_space()
        hidden = self.network(space.embed(state[..., : space.width]), step, conditions)
        ones = torch.ones_like(hidden[..., :1])
        return torch.cat([space.clean(hidden), hidden, ones, torch.zeros_like(ones)], -1), hidden

    def motion_of(self, state: Float[Tensor, "batch frames state"], noise: Tensor | None) -> BatchMotion:
        """Offsets at the end of sampling; ``noise`` is the unit noise of the start, if anything is left of it."""
        features, last = state[..., self.dim : -2], self.network.motion_out
        coordinates = F.linear(features, last.weight) + state[..., -2:-1] * last.bias
        return self.offsets_of(coordinates if noise is None else coordinates + state[..., -1:] * noise)


class SpeakerSampler(Sampler):
    """DDIM (Song et al. 2021, eq. 12, with η = 0) over evenly spaced steps with the published offset of 1.

    It goes from noisy motion x to √ᾱ' x̂₀ + √(1 − ᾱ') ε̂, where the predicted noise is ε̂ = (x − √ᾱ x̂₀)/√(1 − ᾱ). It ends
    at the first step of the process and not at clean motion.

    Args:
        process: the noise process.
        steps: denoising steps.
        literal: as diffusers 0.11 had it, which took x̂₀ for ε̂ where a network predicts x̂₀; so the authors' networks
            were tested.
    """

    linear: ClassVar[bool] = True

    def __init__(self, process: NoiseProcess, steps: int, *, literal: bool) -> None:
        super().__init__(process, steps)
        self.stride, self.literal = process.steps // steps, literal
        self.timesteps = [min(number * self.stride + 1, process.steps - 1) for number in reversed(range(steps))]

    def update(self, i: int, noisy: Tensor, predictions: Sequence[Tensor], noise: NoiseSource) -> Tensor:
        """One step; nothing is drawn."""
        step, signal = self.timesteps[i], self.process.signal
        signal_now, signal_after = float(signal[step]), float(signal[max(step - self.stride, 0)])
        if self.literal:
            return (math.sqrt(signal_after) + math.sqrt(1 - signal_after)) * predictions[-1]
        of_noisy = math.sqrt(1 - signal_after) / math.sqrt(1 - signal_now)
        return (math.sqrt(signal_after) - of_noisy * math.sqrt(signal_now)) * predictions[-1] + of_noisy * noisy


def smoothed(motion: BatchMotion, frames: Int[Tensor, " batch"] | None = None) -> BatchMotion:
    """The mean of each frame and its two neighbours; a clip's first and last frame, and padding, stay as they are."""
    # Published for VOCASET alone, and of the result only: training and the sampler do not see it. By indices and not by
    # slices: a graph takes clips of any length, and slices of one or two frames would be empty.
    longest = motion.shape[1]
    indices = torch.arange(longest, device=motion.device)
    before, after = motion[:, (indices - 1).clamp_min(0)], motion[:, (indices + 1).clamp_max(longest - 1)]
    last = longest - 1 if frames is None else frames[:, None] - 1
    return torch.where(((indices > 0) & (indices < last))[..., None, None], (before + motion + after) / 3, motion)


@dataclass(frozen=True, eq=False)
class SpeakerConditions:
    """The conditions of a clip's motion, and other constants of the denoising steps.

    Attributes:
        style: the speaker's tokens of all layers, side by side.
        speech: keys and values of the speech for each layer.
        positions: of the frames.
        bias: of the attention between frames, with two columns of zeros for the tokens; −∞ where there is padding.
    """

    style: Tensor
    speech: list[AttentionContext]
    positions: Tensor
    bias: Float[Tensor, "... frames keys"]


class AdaptedLayer(SpeechDecoderLayer):
    """Each part is of the normalised frames and added to them.

    Frames attend to two further tokens in both attentions, one of the speaker and one of the step.
    """

    def forward(
        self,
        x: Float[Tensor, "batch frames dim"],
        tokens: Float[Tensor, "batch 2 dim"],
        speech: AttentionContext,
        bias: Tensor,
    ) -> Float[Tensor, "batch frames dim"]:
        """Frames after the layer."""
        # Pre-norm with GELU, unlike FaceFormer's layer. The two tokens join keys and values as they are, before any
        # norm, and get no query: nothing reads a result of theirs.
        normed, attention = self.norms[0](x), self.self_attention
        frames = AttentionContext(*map(joined, attention.keys_values(tokens), attention.keys_values(normed)))
        # Normalised before each part, and not after it as in FaceFormer's decoder.
        x = x + self.dropout(attention.attend(attention.queries(normed), frames, bias))
        cross, count = self.cross_attention, x.shape[1]
        # Each frame has the two tokens and one moment of speech to attend to, side by side.
        moments = AttentionContext(
            *(
                torch.cat([token[:, :, None].expand(-1, -1, count, -1, -1), part[:, :, :, None]], 3).flatten(2, 3)
                for token, part in zip(cross.keys_values(tokens), speech, strict=True)
            )
        )
        x = x + self.dropout(cross.attend_own(cross.queries(self.norms[1](x)), moments))
        return x + self.dropout(self.second(self.dropout(F.gelu(self.first(self.norms[2](x))))))


def joined(first: Tensor, second: Tensor) -> Tensor:
    """Positions of two tensors (batch, heads, positions, head_dim), one after the other."""
    return torch.cat([first, second.to(first.dtype)], 2)


class DiffSpeakerNetwork(nn.Module):
    """Predicts clean motion from noisy motion, speech, the speaker and the step.

    Its sizes are options of ``DiffSpeaker``.
    """

    def __init__(
        self,
        *,
        audio_width: int,
        coordinates: int,
        dim: int,
        num_layers: int,
        num_heads: int,
        hidden_dim: int,
        dropout: float,
        period: int,
        n_identities: int,
    ) -> None:
        super().__init__()
        self.dim, self.num_heads, self.period = dim, num_heads, period
        self.time_dim = audio_width  # sinusoids of the step; even
        self.audio_map = nn.Linear(audio_width, dim)
        self.motion_in = nn.Linear(coordinates, dim)
        # Each layer has tokens of its own.
        self.style = SpeakerTable(n_identities, num_layers * dim, "embedding")
        self.time = nn.Sequential(
            nn.Linear(audio_width, num_layers * dim), nn.SiLU(), nn.Linear(num_layers * dim, num_layers * dim)
        )
        self.layers = nn.ModuleList(AdaptedLayer(dim, num_heads, hidden_dim, dropout) for _ in range(num_layers))
        self.motion_out = still_map(dim, coordinates)
        self.dropout = nn.Dropout(dropout)
        self.of_weights: WeightCache[Fold] = WeightCache()

    def conditions(
        self,
        memory: Float[Tensor, "batch frames dim"],
        identities: Float[Tensor, "batch identities"],
        valid: Bool[Tensor, "batch frames"] | None,
    ) -> SpeakerConditions:
        """Constants of the denoising steps."""
        frames = memory.shape[1]
        speech = [layer.cross_attention.keys_values(memory) for layer in self.layers]  # type: ignore[union-attr, operator]
        positions = periodic_positions(frames, self.dim, self.period, device=memory.device)
        # Two columns of zeros in front: the speaker and the step are equally near to every frame.
        bias = F.pad(mutual_bias(frames, self.num_heads, self.period, device=memory.device), (2, 0))
        if valid is not None:
            bias = bias.masked_fill(~F.pad(valid, (2, 0), value=True)[:, None, None], -torch.inf)
        return SpeakerConditions(self.style(identities), speech, positions, bias)

    def forward(
        self, mapped: Float[Tensor, "batch frames dim"], step: Int[Tensor, " batch"], conditions: SpeakerConditions
    ) -> Float[Tensor, "batch frames dim"]:
        """From noisy motion after ``motion_in`` to the features that ``motion_out`` maps to clean motion."""
        x = self.dropout(mapped + conditions.positions)
        time = self.time(step_sinusoids(step, self.time_dim))
        tokens = torch.stack([part.unflatten(1, (-1, self.dim)) for part in (conditions.style.to(time), time)], 2)
        for number, layer in enumerate(self.layers):
            x = layer(x, tokens[:, number], conditions.speech[number], conditions.bias)
        return x


def step_sinusoids(step: Int[Tensor, " batch"], dim: int) -> Float[Tensor, "batch dim"]:
    """cos(n·w_k), then sin(n·w_k), w_k = 10000^(−k/(dim/2)), of the step n."""
    exponents = -math.log(10_000.0) * torch.arange(dim // 2, device=step.device).float() / (dim // 2)
    angle = step[:, None].float() * exponents.exp()
    # Cosines first, as diffusers' flip_sin_to_cos does, with which the authors trained; swapped halves are an error
    # that no shape check finds.
    return torch.cat([angle.cos(), angle.sin()], 1)


def mutual_bias(
    frames: int, heads: int, period: int, *, device: torch.device | None = None
) -> Float[Tensor, "heads frames frames"]:
    """−2^(−8(h+1)/heads)·⌊(i − j)/period⌋ for head h, frame i and j ≤ i, and of ⌊(j − i − 1)/period⌋ for j > i.

    The published table is the later frames' turned about, so that both sides differ by one frame.
    """
    frames_range = torch.arange(frames, device=device)
    distance = frames_range[:, None] - frames_range
    # The authors flip a causal table to make the other half, which leaves later frames one nearer than earlier ones.
    return distance_bias(torch.where(distance < 0, -distance - 1, distance), heads, period)


# The method as graphs, without PyTorch; see facediff.models.graphs.


class SpeakerStep(ModelPart[DiffSpeaker]):
    """Noisy motion to clean motion at one step."""

    def forward(
        self,
        features: Float[Tensor, "batch frames dim"],
        identity: Int[Tensor, " batch"],
        state: Float[Tensor, "batch frames state"],
        step: Int[Tensor, " batch"],
    ) -> tuple[Tensor, Tensor]:
        """The prediction, and the features that it is a map of."""
        conditions = self.model.network.conditions(features, self.model.weights_of(identity), None)
        return self.model.predict(state, step, conditions)


class SpeakerMotion(ModelPart[DiffSpeaker]):
    """The end of sampling to offsets from the template, smoothed where the model does so."""

    def forward(
        self,
        sample: Float[Tensor, "batch frames state"],
        noise: Float[Tensor, "batch frames coordinates"] | None = None,
    ) -> Float[Tensor, "batch frames points dims"]:
        """In the unit of the corpus."""
        motion = self.model.motion_of(sample, noise)
        return smoothed(motion) if self.model.smooth else motion
