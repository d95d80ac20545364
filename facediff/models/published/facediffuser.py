"""FaceDiffuser (Stan, Haque, Yumak: "FaceDiffuser: Speech-Driven 3D Facial Animation Synthesis Using Diffusion", 2023).

Diffusion over the vertices themselves, with HuBERT's features and recurrent layers. From top to bottom: the model, its
network, its graphs. docs/methods.md says which choices of the published code are options here.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch
from facediff.errors import ArgumentError
from facediff.models.audio_encoders import AudioEncoderFactory, StepRule
from facediff.models.folding import Fold, SamplingSpace, WeightCache
from facediff.models.graphs import Graphs, ModelPart, SpeechInput
from facediff.models.inference import BatchMotion, Progress
from facediff.models.layers import Layers, Share, Width, all_states, frame_mask
from facediff.models.published.base import TRAINED_NETWORK, SpeakerTable, still_map
from facediff.models.published.diffusion import DiffusionModel, PosteriorSampler, diffusion_graphs
from facediff.models.samplers import NoiseProcess, NoiseSource, cosine_betas
from facediff.speech.windows import FrameClock, Rule
from facediff.utils import SAMPLE_RATE
from facediff.utils.ranges import Range


@registry.model.register("FaceDiffuser")
class FaceDiffuser(DiffusionModel):
    """FaceDiffuser: diffusion over vertices with HuBERT and recurrent layers.

    Args:
        dim: channels of speech, noisy motion and step, and of the recurrent layers; 512 at 25 frames a second (BIWI)
            and 256 otherwise if None.
        num_layers: recurrent layers.
        dropout: between them, in training.
        diffusion_steps: noising steps; all of them are sampled. 500 at 25 frames a second and 1000 otherwise if None.
        skip_steps: sampling starts so many steps later, from noised zeros.
        noised: ``absolute`` vertices as published, which the noise must first bring to the face's place
            and size, or ``offsets`` from the template, with noise of the motion alone.
        sampling_space: where sampling runs: on the ``vertices``, with the published code's noise for a seed, or
            ``folded`` into the first map's width, with the same distribution of motion at a cost per step that does
            not depend on the vertices.
        options: as of :class:`DiffusionModel`, and of every model.
    """

    network: FaceDiffuserNetwork
    speech_steps: ClassVar[int] = 2
    # HuBERT base as the project's copy of transformers has it; the two lowest layers are frozen.
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        TRAINED_NETWORK, source="facebook/hubert-base-ls960", frozen_layers=2, epsilon=1e-5
    )

    def __init__(
        self,
        *,
        dim: Width | None = None,
        num_layers: Layers = 2,
        dropout: Share = 0.3,
        diffusion_steps: Annotated[int, Range(1, 100_000)] | None = None,
        skip_steps: Annotated[int, Range(0, 99_999)] = 0,
        noised: Literal["absolute", "offsets"] = "absolute",
        sampling_space: SamplingSpace = "vertices",
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**options)
        self.windows = type(self.windows)(above=math.inf)  # the recurrent layers have no longest speech
        self.steps = diffusion_steps or (500 if self.pairs else 1000)
        if skip_steps >= self.steps:
            raise ArgumentError({"skip_steps": skip_steps, "diffusion_steps": self.steps}, "no step would be left")
        self.skip_steps, self.noised, self.sampling_space = skip_steps, noised, sampling_space
        self.process = NoiseProcess(variances=torch.tensor(cosine_betas(self.steps), dtype=torch.float64, device="cpu"))
        self.network = FaceDiffuserNetwork(
            audio_width=2 * self.audio_width,
            coordinates=self.coordinates,
            dim=dim or (512 if self.pairs else 256),
            steps=self.steps,
            num_layers=num_layers,
            dropout=dropout,
            n_identities=len(self.identities),
        )

    # Frames.

    @property
    def clock(self) -> FrameClock:
        """A frame less than the speech lasts; at most as many as pairs of steps."""
        rule: Rule = "seconds_or_pairs" if self.pairs else "seconds"
        return FrameClock(self.frame_rate, rule, self.audio_encoder.convolutions())

    def tested_frames(self, batch: Batch) -> list[int]:
        """As many as the truth has where speech lasts as long, as the published test does."""
        counts = []
        for samples, true_frames in zip(batch.audio_lengths.tolist(), batch.frame_lengths.tolist(), strict=True):
            count = (
                # In double precision as published: 36 480 samples at 25 frames a second give one frame less than exact
                # arithmetic.
                true_frames if int(samples / SAMPLE_RATE * self.frame_rate) >= true_frames else self.frames_of(samples)
            )
            counts.append(min(count, self.steps_of(samples) // 2) if self.pairs else count)
        return counts

    def encode_speech(self, speech: SpeechInput, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames width"]:
        """Speech features, two steps side by side for each frame."""
        rule: StepRule = "hidden_cut" if self.pairs else "hidden"
        hidden = self.speech_features(speech, 2 * frames, rule)
        return hidden.reshape(hidden.shape[0], hidden.shape[1] // 2, 2 * hidden.shape[2])

    # Training.

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Huber's loss of the predicted clean motion at a random step."""
        step = torch.randint(0, self.steps, (len(batch),), device=self.device, generator=generator)
        noise = torch.randn(batch.motion.flatten(2).shape, device=self.device, generator=generator)
        error = self.loss_at(batch, step, noise)
        return {"reconstruction": error, "loss": error}

    def loss_at(
        self, batch: Batch, step: Int[Tensor, " batch"], noise: Float[Tensor, "batch frames coordinates"]
    ) -> Float[Tensor, ""]:
        """The loss with given random numbers."""
        frames = self.trained_frames(batch)
        longest = int(frames.max())
        rest = self.rest(batch.template)
        # Published: absolute vertices are noised, the template included. The same template is added to the network's
        # output, which therefore learns offsets in either case.
        clean = self.scaled_truth(batch, frames) + rest
        noisy = self.process.add_noise(clean, noise[:, :longest], step)
        network = self.network
        audio = network.audio_map(self.encode_speech(batch, frames))
        hidden = network(network.motion_in(noisy), step, audio, network.style(self.identity_weights(batch)))
        # δ = 1 as published. Motion in raw units never has errors of that size, so that this is half the squared error.
        mask = frame_mask(frames, longest)[..., None]
        predicted = torch.where(mask, network.motion_out(hidden) + rest, clean)
        return F.huber_loss(predicted, clean, reduction="sum") / (frames.sum() * clean.shape[2])

    def rest(self, template: Float[Tensor, "batch points dims"]) -> Float[Tensor, "batch 1 coordinates"]:
        """The noised motion of a face that does not move: the template, or nothing."""
        rest = (template * self.scale).flatten(1)[:, None]
        return rest if self.noised == "absolute" else torch.zeros_like(rest)

    # Sampling.

    def graphs(self) -> Graphs:
        """All steps of the reverse process, with fresh noise in each but the last."""
        width = self.state_space().width
        return diffusion_graphs(
            self,
            DiffuserStep(self),
            LastMap(self),
            "ddpm",
            drawn=width,
            state=width,
            decoded="kept",
            starts=self.skip_steps > 0,
        )

    @property
    def sampler(self) -> PosteriorSampler:
        """All steps but the skipped ones."""
        return PosteriorSampler(self.process, self.skip_steps)

    def first_state(self, noise: Float[Tensor, "batch frames state"]) -> Float[Tensor, "batch frames state"]:
        """Noise, or noised zeros where the first steps are skipped."""
        state = self.state_space().noise(noise)
        if not self.skip_steps:
            return state
        return state * (1.0 - self.process.signal[self.steps - self.skip_steps - 1]).sqrt()

    def sample(
        self, batch: Batch, frames: Int[Tensor, " batch"], noise: NoiseSource, progress: Progress | None = None
    ) -> BatchMotion:
        """The reverse process over all steps: the first noisy motion, then new noise in each step."""
        network = self.network
        style, space = network.style(self.identity_weights(batch)), self.state_space(self.rest(batch.template))
        # The published code runs HuBERT again in each of up to 1000 steps, with the same result.
        hidden = speech = network.audio_map(self.encode_speech(batch, frames))

        def denoise(state: Tensor, step: int) -> Tensor:
            nonlocal hidden
            steps = torch.full((len(batch),), step, device=state.device)
            hidden = network(space.embed(state), steps, speech, style)
            return space.clean(hidden)

        start = self.first_state(noise(speech.new_empty(len(batch), int(frames.max()), space.width)))
        self.sampler.run(denoise, start, noise=lambda like: space.noise(noise(like)), progress=progress)
        # The last step gives the prediction itself; only its features are mapped to vertices.
        return self.offsets_of(network.motion_out(hidden))


class FaceDiffuserNetwork(nn.Module):
    """Predicts clean motion from noisy motion, speech, the speaker and the step.

    Its sizes are options of ``FaceDiffuser``.
    """

    def __init__(
        self,
        *,
        audio_width: int,
        coordinates: int,
        dim: int,
        steps: int,
        num_layers: int,
        dropout: float,
        n_identities: int,
    ) -> None:
        super().__init__()
        self.audio_map = nn.Linear(audio_width, dim)
        self.motion_in = nn.Linear(coordinates, 2 * dim)
        self.smooth = nn.Conv1d(1, 1, kernel_size=9, padding=4)
        self.step = nn.Linear(steps, dim)
        self.norm = nn.LayerNorm(3 * dim)
        # Forward only, so that a frame's motion does not depend on later speech but for HuBERT's own attention.
        self.gru = nn.GRU(3 * dim, dim, num_layers, batch_first=True, dropout=dropout if num_layers > 1 else 0.0)
        self.style = SpeakerTable(n_identities, dim)
        self.motion_out = still_map(dim, coordinates)
        self.of_weights: WeightCache[Fold] = WeightCache()

    def forward(
        self,
        mapped: Float[Tensor, "batch frames twice_dim"],
        step: Int[Tensor, " batch"],
        audio: Float[Tensor, "batch frames dim"],
        style: Float[Tensor, "batch dim"],
    ) -> Float[Tensor, "batch frames dim"]:
        """From noisy motion after ``motion_in`` to the features that ``motion_out`` maps to clean motion."""
        batch, frames, width = mapped.shape
        # The convolution runs along the channels of a frame, not over time.
        motion = torch.relu(self.smooth(mapped.reshape(batch * frames, 1, width)))
        motion = torch.relu(F.max_pool1d(motion, 2)).view(batch, frames, -1)
        # A one-hot step times a matrix is one of its columns.
        embedded = F.mish(self.step.weight.T[step] + self.step.bias)[:, None].expand(-1, frames, -1)
        joined = self.norm(torch.cat([audio, motion, embedded.to(motion.dtype)], -1))
        # The style scales the recurrent states and is not added to them: as published, between the GRU and the last
        # map.
        return all_states(self.gru, joined) * style[:, None]


# The method as graphs, without PyTorch; see facediff.models.graphs.


class DiffuserStep(ModelPart[FaceDiffuser]):
    """Noisy motion to clean motion at one step, and the features that the last map makes motion of."""

    def forward(
        self,
        features: Float[Tensor, "batch frames dim"],
        identity: Int[Tensor, " batch"],
        template: Float[Tensor, "batch points dims"],
        state: Float[Tensor, "batch frames state"],
        step: Int[Tensor, " batch"],
    ) -> tuple[Tensor, Tensor]:
        """Where vertices are noised with the face, the template is a part of the prediction."""
        model, network = self.model, self.model.network
        space = model.state_space(model.rest(template))
        hidden = network(space.embed(state), step, features, network.style(model.weights_of(identity)))
        return space.clean(hidden), hidden


class LastMap(ModelPart[FaceDiffuser]):
    """The network's last features to offsets from the template."""

    def forward(self, sample: Float[Tensor, "batch frames dim"]) -> Float[Tensor, "batch frames points dims"]:
        """In the unit of the corpus."""
        return self.model.offsets_of(self.model.network.motion_out(sample))
