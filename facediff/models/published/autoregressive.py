"""What FaceFormer, CodeTalker and TalkingStyle share: a Transformer decoder that makes motion frame by frame.

Each frame's token is the motion of the frame before it, plus the speaker's style and a periodic position; it attends to
all frames before it, the more the nearer they are, and to its own moment of the speech. Both masks are rows of their
own for each frame, so the keys and values of earlier frames never change, and may be kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.models.audio_encoders import StepRule
from facediff.models.inference import BatchMotion, Progress
from facediff.models.layers import AttentionContext, Heads, Layers, Share, Width, check_heads
from facediff.models.published.base import LongSpeech, PublishedModel, still_map
from facediff.models.published.positions import periodic_bias, periodic_positions
from facediff.utils.ranges import Range

Period = Annotated[int, Range(1, 100_000)]


class AutoregressiveModel(PublishedModel):
    """Base of the methods that make motion frame by frame with the decoder of FaceFormer.

    Args:
        dim: channels of the decoder.
        num_layers: its layers.
        num_heads: its attention heads.
        feed_forward_dim: channels between the two maps of its feed-forward layers; twice ``dim`` if None.
        dropout: in the decoder and on its positions.
        period: frames after which positions and the attention's bias repeat; a second's if None.
        long_speech: the treatment of more than 600 frames, for which the published tables have no rows: ``refuse``
            them, as published; animate ``windows`` of them; or ``extend`` the tables by their formula.
        options: see :class:`PublishedModel`.
    """

    table_frames: ClassVar[int | None] = 600
    network: SpeechDecoder

    def __init__(
        self,
        *,
        dim: Width | None = None,
        num_layers: Layers = 1,
        num_heads: Heads = 4,
        feed_forward_dim: Width | None = None,
        dropout: Share = 0.1,
        period: Period | None = None,
        long_speech: LongSpeech = "refuse",
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**options)
        # The projects' own widths on their two data sets.
        self.dim = dim or (128 if self.pairs else 64)
        check_heads(dim=self.dim, num_heads=num_heads, even=True)
        self.decoder_options: dict[str, Any] = {
            "dim": self.dim,
            "num_layers": num_layers,
            "num_heads": num_heads,
            "hidden_dim": feed_forward_dim or 2 * self.dim,
            "dropout": dropout,
            "period": period or max(1, round(self.frame_rate)),
            "steps": 2 if self.pairs else 1,
        }
        self.plan_long_speech(long_speech)

    def encode_speech(self, batch: Batch, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch steps width"]:
        """Speech features: as many as frames, or two for each where speech comes in pairs."""
        # At 25 frames a second two of the 50 speech steps belong to a frame and nothing is interpolated; at 30 the
        # convolutions' output is interpolated before the Transformer, which then runs at the motion's rate.
        steps = 2 * frames if self.pairs else frames
        rule: StepRule = "features_cut" if self.pairs else "features"
        return self.speech_features(batch, steps, rule)

    def conditions(
        self, batch: Batch, frames: Int[Tensor, " batch"]
    ) -> tuple[Float[Tensor, "batch dim"], Float[Tensor, "batch steps dim"]]:
        """The speaker's style and the speech of so many frames."""
        memory = self.network.audio_map(self.encode_speech(batch, frames))
        return self.network.style(self.identity_weights(batch)), memory


class OffsetModel(AutoregressiveModel):
    """Base of methods with a decoder of the offsets themselves, an :class:`AutoregressiveNetwork`.

    Args:
        teacher_forcing: train on the true motion of the frame before, in one pass, and not on the generated one; the
            published training generates.
        options: see :class:`AutoregressiveModel`.
    """

    network: AutoregressiveNetwork

    def __init__(self, *, teacher_forcing: bool = False, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        self.teacher_forcing = teacher_forcing

    def predicted_and_true(
        self, batch: Batch
    ) -> tuple[
        Float[Tensor, "batch frames coordinates"], Float[Tensor, "batch frames coordinates"], Int[Tensor, " batch"]
    ]:
        """Scaled motion, as predicted in training and true, and the frames of each clip that are compared."""
        frames = self.trained_frames(batch)
        self.check_length(frames, batch.names)
        style, memory = self.conditions(batch, frames)
        truth = self.scaled_truth(batch, frames)
        if self.teacher_forcing:
            predicted = self.network.teacher_forced(style, memory, truth)
        else:
            # The published training: every frame follows generated ones and gradients pass through the whole chain. It
            # is slow, but the network meets its own errors, as it will in inference.
            predicted = self.network.generate(style, memory)
        return predicted, truth, frames

    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """Frame by frame; nothing is random."""
        self.check_length(frames, batch.names)
        style, memory = self.conditions(batch, frames)
        motion = self.network.generate(style, memory)
        return self.offsets_of(motion)


class ProjectedAttention(nn.Module):
    """Multi-head attention with one stacked map for queries, keys and values, as in PyTorch's own layer."""

    def __init__(self, dim: int, num_heads: int, dropout: float) -> None:
        super().__init__()
        self.num_heads, self.dropout = num_heads, dropout
        # PyTorch initialises the stacked map as one matrix of 3·dim rows, which gives smaller weights than three maps
        # of their own would get; training from scratch should start where the published training did.
        self.project = nn.Linear(dim, 3 * dim)
        self.out = nn.Linear(dim, dim)
        nn.init.xavier_uniform_(self.project.weight)
        nn.init.zeros_(self.project.bias)
        nn.init.zeros_(self.out.bias)

    def queries(self, x: Float[Tensor, "batch positions dim"]) -> Float[Tensor, "batch heads positions head_dim"]:
        """The first third of the map."""
        dim = x.shape[-1]
        return self._split(F.linear(x, self.project.weight[:dim], self.project.bias[:dim]))

    def keys_values(self, x: Float[Tensor, "batch positions dim"]) -> AttentionContext:
        """The second and the last third."""
        dim = x.shape[-1]
        key, value = F.linear(x, self.project.weight[dim:], self.project.bias[dim:]).chunk(2, -1)
        return AttentionContext(self._split(key), self._split(value))

    def attend(self, query: Tensor, context: AttentionContext, bias: Tensor | None = None) -> Tensor:
        """The attention itself, with ``bias`` added to its scores, and the map of its result."""
        dropout = self.dropout if self.training else 0.0
        bias = None if bias is None else bias.to(query.dtype)
        mixed = F.scaled_dot_product_attention(query, context.key, context.value, attn_mask=bias, dropout_p=dropout)
        return self.out(mixed.transpose(1, 2).flatten(2))

    def attend_own(self, query: Tensor, context: AttentionContext) -> Tensor:
        """Each position attends to its own moment alone: the context's positions divided among the queries."""
        batch, heads, frames, width = query.shape
        # The same as a mask that leaves only these positions, without the table of all others.
        queries = query.transpose(1, 2).reshape(batch * frames, heads, 1, width)
        per_frame = AttentionContext(
            *(part.view(batch, heads, frames, -1, width).transpose(1, 2).flatten(0, 1) for part in context)
        )
        return self.attend(queries, per_frame).view(batch, frames, -1)

    def _split(self, x: Tensor) -> Tensor:
        return x.view(*x.shape[:-1], self.num_heads, -1).transpose(1, 2)


class SpeechDecoderLayer(nn.Module):
    """The parts of a layer of a decoder: self-attention, attention to the speech, feed-forward."""

    def __init__(self, dim: int, num_heads: int, hidden_dim: int, dropout: float) -> None:
        super().__init__()
        self.self_attention = ProjectedAttention(dim, num_heads, dropout)
        self.cross_attention = ProjectedAttention(dim, num_heads, dropout)
        self.first, self.second = nn.Linear(dim, hidden_dim), nn.Linear(hidden_dim, dim)
        self.norms = nn.ModuleList(nn.LayerNorm(dim) for _ in range(3))
        self.dropout = nn.Dropout(dropout)


class DecoderLayer(SpeechDecoderLayer):
    """Each part's result is added to the frames, which are normalised afterwards."""

    def forward(self, x: Tensor, speech: AttentionContext, past: AttentionContext, bias: Tensor | None) -> Tensor:
        """Frames ``x`` (B, T, dim) that see the positions of ``past`` as the ``bias`` (heads, T, P) lets them."""
        # Post-norm with a ReLU, the defaults of torch.nn.TransformerDecoderLayer when these methods were published; the
        # released weights do not fit a pre-norm layer.
        attended = self.self_attention.attend(self.self_attention.queries(x), past, bias)
        x = self.norms[0](x + self.dropout(attended))
        attended = self.cross_attention.attend_own(self.cross_attention.queries(x), speech)
        x = self.norms[1](x + self.dropout(attended))
        hidden = self.second(self.dropout(torch.relu(self.first(x))))
        return self.norms[2](x + self.dropout(hidden))


class PeriodicDecoder(nn.Module):
    """The decoder: tokens of frames, and the speech that they go with, to one vector for each frame."""

    def __init__(
        self, *, dim: int, num_layers: int, num_heads: int, hidden_dim: int, dropout: float, period: int, steps: int
    ) -> None:
        super().__init__()
        self.dim, self.num_heads, self.period, self.steps = dim, num_heads, period, steps
        self.layers = nn.ModuleList(DecoderLayer(dim, num_heads, hidden_dim, dropout) for _ in range(num_layers))
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, tokens: Float[Tensor, "batch frames dim"], memory: Float[Tensor, "batch steps dim"]
    ) -> Float[Tensor, "batch frames dim"]:
        """All frames together; positions are added to the tokens here."""
        frames, device = tokens.shape[1], tokens.device
        x = self.dropout(tokens + periodic_positions(frames, self.dim, self.period, device=device))
        bias = periodic_bias(frames, self.num_heads, self.period, device=device)
        for layer in self.layers:
            # A prefix of the frames goes with a prefix of the speech.
            speech = layer.cross_attention.keys_values(memory[:, : frames * self.steps])  # type: ignore[union-attr, operator]
            x = layer(x, speech, layer.self_attention.keys_values(x), bias)  # type: ignore[union-attr, operator]
        return x


class Continuation:
    """A decoder that goes on frame by frame, with the keys and values of all earlier frames."""

    def __init__(self, decoder: PeriodicDecoder, memory: Float[Tensor, "batch steps dim"]) -> None:
        self.decoder, self.frame, self.frames = decoder, 0, memory.shape[1] // decoder.steps
        self._speech = [layer.cross_attention.keys_values(memory) for layer in decoder.layers]  # type: ignore[union-attr, operator]
        self._past: list[AttentionContext | None] = [None for _ in decoder.layers]
        self._positions = periodic_positions(self.frames, decoder.dim, decoder.period, device=memory.device)

    def step(self, token: Float[Tensor, "batch 1 dim"]) -> Float[Tensor, "batch 1 dim"]:
        """The next frame; its position is added to the token here."""
        decoder, at, steps = self.decoder, self.frame, self.decoder.steps
        # Masks are causal and a frame's row of the bias depends on its own number only, so that what earlier frames
        # computed stays exact; one frame then costs one token and not all tokens so far.
        x = decoder.dropout(token + self._positions[at])
        bias = periodic_bias(1, decoder.num_heads, decoder.period, start=at, device=token.device)
        for number, layer in enumerate(decoder.layers):
            past, new = self._past[number], layer.self_attention.keys_values(x)  # type: ignore[union-attr, operator]
            if past is not None:
                new = AttentionContext(*(torch.cat(parts, 2) for parts in zip(past, new, strict=True)))
            self._past[number] = new
            speech = AttentionContext(*(part[:, :, at * steps : (at + 1) * steps] for part in self._speech[number]))
            x = layer(x, speech, new, bias)
        self.frame += 1
        return x


class SpeechDecoder(nn.Module):
    """Maps of speech and of earlier motion into a decoder; what stands behind it is added by a method."""

    style: nn.Module

    def __init__(self, audio_width: int, coordinates: int, decoder: dict[str, Any]) -> None:
        super().__init__()
        dim = int(decoder["dim"])
        self.audio_map = nn.Linear(audio_width, dim)
        self.motion_in = nn.Linear(coordinates, dim)
        self.decoder = PeriodicDecoder(**decoder)

    def after_motion(
        self, style: Float[Tensor, "batch dim"], memory: Float[Tensor, "batch steps dim"], motion: Tensor
    ) -> Float[Tensor, "batch frames dim"]:
        """The decoder's result for every frame from motion (B, T, 3V) of the frame before it, zero before the first."""
        # Shifted by one frame: a frame must not see the motion that it is to predict.
        before = F.pad(motion, (0, 0, 1, 0))[:, :-1]
        features: Tensor = self.decoder(self.motion_in(before) + style[:, None], memory)
        return features


class AutoregressiveNetwork(SpeechDecoder):
    """Features of speech and a speaker's style to offsets of the vertices, frame by frame."""

    def __init__(
        self,
        *,
        audio_width: int,
        coordinates: int,
        style: nn.Module,
        decoder: dict[str, Any],
    ) -> None:
        super().__init__(audio_width, coordinates, decoder)
        self.motion_out = still_map(int(decoder["dim"]), coordinates)
        self.style = style

    def teacher_forced(
        self, style: Float[Tensor, "batch dim"], memory: Float[Tensor, "batch steps dim"], motion: Tensor
    ) -> Float[Tensor, "batch frames coordinates"]:
        """Every frame from the true motion (B, T, 3V) of the frame before it, all in one pass.

        The first frame follows one that does not move, so that it gets the bias of ``motion_in``; a frame that is
        generated does not, as published.
        """
        return self.motion_out(self.after_motion(style, memory, motion))

    def generate(
        self, style: Float[Tensor, "batch dim"], memory: Float[Tensor, "batch steps dim"]
    ) -> Float[Tensor, "batch frames coordinates"]:
        """Every frame from the frame that was generated before it."""
        # The published code computes all earlier frames again for each frame; with their keys and values kept, the same
        # frames come out. From one frame to the next, motion passes through two maps without anything between them:
        # their product has the width of the decoder, and the vertices are needed only once, at the end.
        first, last = self.motion_in, self.motion_out
        with torch.autocast(memory.device.type, enabled=False):
            # In the weights' own precision: autocast would round the product to half precision, and it is applied in
            # every frame to the result of the one before.
            turn = first.weight @ last.weight
            shift = first.weight @ last.bias + first.bias
        state, token, features = Continuation(self.decoder, memory), style[:, None], []
        for _ in range(state.frames):
            features.append(state.step(token))
            token = F.linear(features[-1], turn, shift) + style[:, None]
        return self.motion_out(torch.cat(features, 1))
