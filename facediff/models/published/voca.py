"""VOCA (Cudeiro, Bolkart, Laidlaw, Ranjan, Black: "Capture, Learning, and Synthesis of 3D Speaking Styles", 2019).

Convolutions over a window of DeepSpeech's logits around each frame, joined with the speaker as a one-hot vector, give
the coefficients of linear shapes. From top to bottom: the model, its network, the authors' checkpoint.
docs/methods.md lists the options for choices of the published code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, SpeechMotionDataModule
from facediff.errors import OptionError
from facediff.models.audio_encoders import AudioEncoderFactory
from facediff.models.deepspeech import DeepSpeechEncoder, network_of
from facediff.models.graphs import SpeechInput
from facediff.models.layers import Width, exporting, frame_mask, sliding
from facediff.models.published.base import DirectModel, SpeakerTable
from facediff.models.squared_errors import squared_errors
from facediff.speech.windows import FrameClock
from facediff.utils import SAMPLE_RATE
from facediff.utils.ranges import Range

if TYPE_CHECKING:
    from facediff.models.published.cards import AuthorFiles, Facts

PUBLISHED_RATE = 60.0
"""Frames a second of VOCA's motion and of its windows' rows."""

CHANNELS = (32, 32, 64, 64)
"""Channels of the published convolutions."""


ENCODER, SCOPES = "SpeechEncoder/", ("SpeechEncoder/", "ExpressionLayer/")
"""How the names of the authors' variables begin."""

OPTIMISER = ("/Adam", "/Adam_1", "/Momentum", "/RMSProp", "/ExponentialMovingAverage", "global_step", "_power")
"""Endings of the names of the optimiser's state."""


@registry.model.register("Voca")
class Voca(DirectModel):
    """VOCA: a window of speech around each frame, convolved to the coefficients of linear shapes.

    Args:
        dim: channels of the dense layer after the convolutions.
        components: linear shapes.
        channels: of the convolutions, each of which halves the window.
        speech_window: rows of speech around each frame, half of them before it.
        velocity_weight: of the error of differences between frames, next to the error of the frames.
        shapes: how the linear shapes start: as ``principal`` components of the training motion as published, or
            ``random``.
        options: see :class:`~facediff.models.published.base.PublishedModel`, and of every model.
    """

    published_encoder: ClassVar[AudioEncoderFactory] = DeepSpeechEncoder

    def __init__(
        self,
        *,
        dim: Width = 128,
        components: Width = 50,
        channels: Annotated[Sequence[Width], Range(items=(1, 16))] = CHANNELS,
        speech_window: Annotated[int, Range(1, 1024)] = 16,
        velocity_weight: Annotated[float, Range(0, 1e9)] = 10.0,
        shapes: Literal["principal", "random"] = "principal",
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**options)
        # Frames do not see one another, so that cutting long speech into windows would only cost overlap.
        self.windows = type(self.windows)(above=math.inf)
        self.speech_window, self.velocity_weight, self.shapes = speech_window, velocity_weight, shapes
        # Rows of speech from one frame to the next, as close to the published 60 a second as whole numbers come.
        self.speech_steps = max(1, round(PUBLISHED_RATE / self.frame_rate))
        self.network = VocaNetwork(
            audio_width=self.audio_width,
            coordinates=self.coordinates,
            n_identities=len(self.identities),
            window=speech_window,
            channels=channels,
            dim=dim,
            components=components,
        )

    @classmethod
    def read_author(cls, files: AuthorFiles, facts: Facts, given_options: Mapping[str, Any]) -> dict[str, Any]:
        """TensorFlow's layouts, the speaker's rows of two layers, and DeepSpeech's graph."""
        if PUBLISHED_RATE % facts.frame_rate:
            raise OptionError.naming(
                f"{{option}} frame_rate={facts.frame_rate:g}: VOCA gives {PUBLISHED_RATE:g} frames a second; expected "
                f"a rate that divides it, such as 30, which takes every second frame"
            )
        for name in list(files.tensors):
            if name.endswith(OPTIMISER):
                files.ignore(name, "of the optimiser")
        graph = {name: files.tensors.pop(name) for name in list(files.tensors) if not name.startswith(SCOPES)}
        if not graph:
            raise OptionError.naming(
                f"{files.source}: holds VOCA without DeepSpeech, whose logits are its input; give the graph of "
                f"DeepSpeech 0.1.0, converted by tools/convert_tensorflow.py, as a further file"
            )
        state, sizes, left = network_of(graph, files.source)
        files.ignored |= dict.fromkeys(left, "not of VOCA, nor of DeepSpeech's network")
        count, dense, logits = len(facts.identities), files[f"{ENCODER}fc1/weights"], sizes["logits"]
        tensors: dict[str, Tensor] = {f"audio_encoder.network.{name}": value for name, value in state.items()}
        tensors["network.norm.num_batches_tracked"] = torch.tensor(0)
        tensors["network.dense.weight"], tensors["network.late_style.weight"] = dense[:-count].T, dense[-count:]
        channels: list[int] = []
        while (name := f"{ENCODER}conv{len(channels) + 1}/weights") in files.tensors:
            kernel, to = files.tensors.pop(name)[:, 0], f"network.convolutions.{len(channels)}."
            if not channels:  # (taps, identities, channels) as one row for each identity
                tensors["network.early_style.weight"] = kernel[:, logits:].transpose(0, 1).flatten(1)
                kernel = kernel[:, :logits]
            tensors[f"{to}weight"] = kernel.permute(2, 1, 0)
            tensors[f"{to}bias"] = files.tensors.pop(f"{ENCODER}conv{len(channels) + 1}/biases")
            channels.append(kernel.shape[2])
        dim = files.size(f"{ENCODER}fc1/weights", 1)
        del files.tensors[f"{ENCODER}fc1/weights"]
        files.tensors |= tensors
        return {"audio_encoder": partial(DeepSpeechEncoder, config=sizes), "channels": channels, "dim": dim}

    def personal_modules(self) -> list[nn.Module]:
        """The two tables of speakers."""
        return [self.network.early_style, self.network.late_style]

    def measure(self, data: SpeechMotionDataModule, at_least: int = 0) -> Float[Tensor, "components all"] | None:
        """The linear shapes start as principal components of the training motion, without an offset."""
        components = self.network.expression.in_features if self.shapes == "principal" else 0
        principal = super().measure(data, max(at_least, components))
        if principal is not None and components:
            with torch.no_grad():
                weight, count = self.network.expression.weight, min(components, len(principal))
                weight[:, :count] = principal[:count].T.to(weight)
                self.network.expression.bias.zero_()
        return principal

    # Frames.

    @property
    def clock(self) -> FrameClock:
        """At the published 60 frames a second, as many as rows; else every so many of them, from the first on."""
        return FrameClock(self.frame_rate, "rows", rows=self.speech_steps)

    def trained_frames(self, batch: Batch) -> Int[Tensor, " batch"]:
        """Frames of each clip for which there is speech."""
        counts = torch.tensor([self.frames_of(int(n)) for n in batch.audio_lengths], device=batch.frame_lengths.device)
        return torch.minimum(batch.frame_lengths, counts.clamp_min(1))

    def encode_speech(
        self, speech: SpeechInput, frames: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames channels rows"]:
        """The window of speech around each frame; what lies before or after the speech is zero."""
        step, rows = self.speech_steps, self.row_counts(speech.audio_lengths)
        cached = speech.cached_features or ()
        features = self.audio_encoder.at_rate(speech.audio, speech.audio_lengths, rows, self.frame_rate * step, *cached)
        # Zeros of logits past the ends, as published, and not the logits of silence.
        before, longest = self.speech_window // 2, int(frames.max()) if not exporting() else features.shape[1] // step
        # A graph has as many rows for each frame, of which the last ones may not be valid; they are zero.
        padding = (longest - 1) * step - features.shape[1] if not exporting() else -step
        after = max(0, padding + self.speech_window - before)
        return sliding(F.pad(features, (0, 0, before, after)), self.speech_window, step, longest)

    def row_counts(self, samples: Int[Tensor, " batch"]) -> Int[Tensor, " batch"]:
        """Rows of speech of clips, at least one."""
        if exporting():  # the clock's rule in the same floating point, without leaving the graph
            rate = self.frame_rate * self.speech_steps
            return (samples.double() / SAMPLE_RATE * rate).round().long().clamp_min(1)
        counts = [max(1, self.clock.row_count(count)) for count in samples.tolist()]
        return torch.tensor(counts, device=samples.device)

    def coefficients(
        self,
        windows: Float[Tensor, "batch frames channels rows"],
        weights: Float[Tensor, "batch identities"],
        frames: Int[Tensor, " batch"] | None,
    ) -> Float[Tensor, "batch frames components"]:
        """Coefficients of the linear shapes for each frame, mixed by the speakers' weights.

        The published code mixes vertices. They are linear in the coefficients and the weights sum to 1, so a mixture of
        coefficients is the same.
        """
        if frames is not None and bool(((weights == 0) | (weights == 1)).all()):
            # The batch norm must not see padding, so frames stand in one row without it.
            mask = frame_mask(frames, windows.shape[1])
            valid = self.network(windows[mask], weights[mask.nonzero()[:, 0]])
            padded = valid.new_zeros(*mask.shape, valid.shape[-1])
            padded[mask] = valid
            return padded
        # The network is not linear in the speaker: mixing one-hot vectors at its input would be another speaker
        # altogether. So every speaker is computed and the results are mixed; nothing depends on the values of weights.
        count, flat = weights.shape[1], windows.flatten(0, 1)
        speakers = torch.eye(count, device=weights.device)[:, None].expand(-1, flat.shape[0], -1)
        mixed = self.network(flat.repeat(count, 1, 1), speakers.flatten(0, 1)).view(count, *windows.shape[:2], -1)
        return torch.einsum("bk,kbtc->btc", weights, mixed)

    # Training and inference.

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Squared distances of vertices, and of their differences between frames."""
        frames = self.trained_frames(batch)
        coefficients = self.coefficients(self.encode_speech(batch, frames), self.identity_weights(batch), frames)
        truth = self.scaled_truth(batch, frames)
        # Distances are sums over the three coordinates; the first frame is its own frame before, so that changes count
        # in as many frames as positions.
        count = frames.sum() * self.n_vertices
        position, change = squared_errors(self.network.expression(coefficients), truth, frames)
        reconstruction, velocity = position / count, change / count
        loss = reconstruction + self.velocity_weight * velocity
        return {"reconstruction": reconstruction, "velocity": velocity, "loss": loss}

    def decode(self, features: Tensor, weights: Tensor, frames: Int[Tensor, " batch"] | None) -> Tensor:
        """Each frame from its own window."""
        offsets: Tensor = self.network.expression(self.coefficients(features, weights, frames))
        return offsets


class VocaNetwork(nn.Module):
    """From a window of speech and a speaker to coefficients of linear shapes.

    In the published network, the speaker's one-hot vector is a constant stretch of channels next to the speech, and is
    joined to the result of the convolutions once more. Both times it picks columns of a matrix, which are the rows of
    two tables here.

    Its sizes are options of ``Voca``.
    """

    TAPS = 3

    def __init__(
        self,
        *,
        audio_width: int,
        coordinates: int,
        n_identities: int,
        window: int,
        channels: Sequence[int],
        dim: int,
        components: int,
    ) -> None:
        super().__init__()
        # One mean and one variance over all 16 × 29 numbers of a window, as TensorFlow's batch norm has it for an image
        # of one channel; ε 1e-5, where TensorFlow's default is 1e-3.
        self.norm = nn.BatchNorm1d(1, eps=1e-5, momentum=0.1)
        widths = [audio_width, *channels]
        self.convolutions = nn.ModuleList(
            nn.Conv1d(into, out, self.TAPS, stride=2) for into, out in zip(widths[:-1], widths[1:], strict=True)
        )
        self.early_style = SpeakerTable(n_identities, self.TAPS * widths[1])
        left = window
        for _ in channels:
            left = -(-left // 2)
        self.dense = nn.Linear(left * widths[-1], dim)
        self.late_style = SpeakerTable(n_identities, dim)
        self.coefficients = nn.Linear(dim, components)
        self.expression = nn.Linear(components, coordinates)

    def forward(
        self, windows: Float[Tensor, "frames channels rows"], speaker: Float[Tensor, "frames identities"]
    ) -> Float[Tensor, "frames components"]:
        """The coefficients, which ``expression`` makes offsets of."""
        count, channels, rows = windows.shape
        x = self.norm(windows.reshape(count, 1, channels * rows)).view(count, channels, rows)
        for number, convolution in enumerate(self.convolutions):
            ones = padded_same(x.new_ones(x.shape[2]), self.TAPS)
            inside = sliding(ones[None, :, None], self.TAPS, 2, (len(ones) - self.TAPS) // 2 + 1)[0, :, 0]
            x = convolution(padded_same(x, self.TAPS))
            if number == 0:
                # The speaker's channels are padded with zeros as well: at the ends not all taps meet them.
                taps = self.early_style(speaker).view(count, self.TAPS, -1)
                x = x + torch.einsum("pt,ntc->ncp", inside, taps.to(inside)).to(x)
            x = torch.relu(x)
        # Row by row, as TensorFlow lays it out.
        flat = x.transpose(1, 2).flatten(1)
        coefficients: Tensor = self.coefficients(torch.tanh(self.dense(flat) + self.late_style(speaker)))
        return coefficients


def padded_same(x: Float[Tensor, "*channels rows"], taps: int) -> Float[Tensor, "*channels padded"]:
    """Zeros for a convolution of stride 2 that halves the rows, rather after than before, as TensorFlow's ``SAME``.

    >>> padded_same(torch.ones(4), 3)
    tensor([1., 1., 1., 1., 0.])
    """
    rows = x.shape[-1]
    # ⌈rows / 2⌉ results must come out. An odd zero goes behind; PyTorch's symmetric padding would put it in front and
    # shift all 16 rows by one.
    padding = max(0, (-(-rows // 2) - 1) * 2 + taps - rows)
    return F.pad(x, (padding // 2, padding - padding // 2))
