"""ARTalk (Chu et al.: "ARTalk: Speech-Driven 3D Head Animation via Autoregressive Model", 2025).

A Transformer predicts the bits of 100 frames from coarse to fine, from their speech, the chunk before and a style clip;
a codec makes motion of them. From top to bottom: the model, training, generation, the generator, smoothing, the
authors' checkpoints. The codec stands in :mod:`facediff.models.published.artalk_codec`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, SpeechMotionDataModule
from facediff.errors import ArgumentError
from facediff.models.audio_encoders import AudioEncoderFactory
from facediff.models.inference import BatchMotion, Motion, Progress, SpeechStream
from facediff.models.layers import Heads, Layers, Width, check_heads
from facediff.models.published.artalk_codec import BitCodec, Bits, resized
from facediff.models.published.clip_style import read_table
from facediff.models.published.parametric import ParametricModel, window_at
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.speech.windows import WindowPlan
from facediff.utils import SAMPLE_RATE
from facediff.utils.ranges import Range

if TYPE_CHECKING:
    from facediff.models.published.cards import AuthorFiles, Facts

STYLE_FRAMES = 50
"""Frames of a style clip."""

FLIPPED_BITS = 0.3
"""Share of the given bits that are turned over in training."""

DROPPED = 0.1
"""Share of clips without style, speech or the chunk before in training, each by itself."""

WEIGHTS = {"velocity": 5.0, "head": 1.0, "commitment": 0.2}
"""Of the codec's errors of first differences and, once more, of the head, and of the distance of codes from bits."""

LARGEST_SCALE = math.log(100)
"""Of the logarithm that attention's queries are multiplied by."""


@registry.model.register("ARTalk")
class ARTalk(ParametricModel):
    """ARTalk: bits of motion from coarse to fine, chunk after chunk.

    Args:
        dim: channels of the generator.
        num_layers: its blocks.
        num_heads: its attention heads.
        feed_forward_dim: channels between the two maps of its blocks; four times ``dim`` if None.
        scales: tokens of a chunk at each rate; the first is 1, the last the frames of a chunk.
        code_dim: bits of a token.
        codec_dim: channels of the codec.
        codec_layers: layers of its encoder, and of its decoder.
        codec_heads: their attention heads.
        style_scale: how far the style goes from no style; 1 takes it as it is.
        smooth: filter the result (Savitzky–Golay), as the authors' programs do.
        still_jaw: set the jaw's rotation about y and z to zero, as they do.
        stage: train the ``codec``, the ``generator`` with the codec as it is, or ``both``; the authors train one after
            the other.
        options: see :class:`~facediff.models.published.parametric.ParametricModel`.
    """

    encodes_whole_clips: ClassVar[bool] = False  # but chunks that are cut anew in each step
    jaw_opens: ClassVar[bool] = False
    clock_rule = "up"  # as many frames as the speech touches
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        Wav2Vec2Encoder, source="facebook/wav2vec2-xls-r-300m", edges=False
    )

    style_mean: Tensor
    style_std: Tensor

    def __init__(
        self,
        *,
        dim: Width = 768,
        num_layers: Layers = 12,
        num_heads: Heads = 12,
        feed_forward_dim: Width | None = None,
        scales: Annotated[Sequence[Annotated[int, Range(1, 10_000)]], Range(items=(2, 16))] = (1, 5, 25, 50, 100),
        code_dim: Width = 32,
        codec_dim: Width = 512,
        codec_layers: Layers = 8,
        codec_heads: Heads = 8,
        style_scale: Annotated[float, Range(0, 100)] = 1.1,
        smooth: bool = True,
        still_jaw: bool = True,
        stage: Literal["codec", "generator", "both"] = "both",
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**options)
        if len(scales) < 2 or scales[0] != 1 or list(scales) != sorted(set(scales)):
            raise ArgumentError({"scales": list(scales)}, "expected growing numbers from 1, such as 1, 5, 25, 50, 100")
        check_heads(dim=dim, num_heads=num_heads)
        check_heads(codec_dim=codec_dim, codec_heads=codec_heads)
        self.scales, self.style_scale = tuple(scales), style_scale
        self.smooth, self.still_jaw, self.stage = smooth, still_jaw, stage
        channels = len(self.modelled)
        self.codec = BitCodec(channels, scales, code_dim, codec_dim, codec_layers, codec_heads)
        self.style_encoder = self.make_style_encoder()
        self.register_buffer("style_mean", torch.zeros(channels))
        self.register_buffer("style_std", torch.ones(channels))
        self.generator = BitGenerator(
            code_dim=code_dim,
            style_dim=self.style_dim,
            audio_width=self.audio_width,
            dim=dim,
            num_layers=num_layers,
            num_heads=num_heads,
            feed_forward_dim=feed_forward_dim or 4 * dim,
            scales=scales,
        )
        self.codec.requires_grad_(stage != "generator")
        if stage == "codec":
            for module in (self.generator, self.style_encoder, self.audio_encoder):
                module.requires_grad_(False)

    @classmethod
    def read_author(cls, files: AuthorFiles, facts: Facts, given_options: Mapping[str, Any]) -> dict[str, Any]:
        """The rates, and the statistics by which channels are standardised; there are no shapes of persons."""
        files.tensors |= {name: files[f"basic_vae.{name}"] for name in ("motion_mean", "motion_std")}
        files.tensors["shapes"] = torch.zeros(len(facts.identities), 0)
        return {
            "scales": torch.unique(files["lvl_idx"], return_counts=True)[1].tolist(),
            "codec_layers": files.count("basic_vae.encoder.encoder_transformer.") // 2,
            "style_rows": read_table(files, "style_encoder.PE.pe", files.size("style_cond_embed.weight", 1)),
        }

    def measure(self, data: SpeechMotionDataModule, at_least: int = 0) -> Float[Tensor, "components all"] | None:
        """Take the mean and the deviation of every channel, which codec and style encoder have as well."""
        result = super().measure(data, at_least)
        for mean, deviation in ((self.codec.motion_mean, self.codec.motion_std), (self.style_mean, self.style_std)):
            mean.copy_(self.motion_mean[list(self.modelled)])
            deviation.copy_(self.motion_std[list(self.modelled)])
        return result

    # The style of a clip.

    def encode_style(
        self, reference: Float[Tensor, "batch frames points dims"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vectors of the first 50 frames of reference motions."""
        motion = (reference.flatten(2)[:, :STYLE_FRAMES, list(self.modelled)] - self.style_mean) / self.style_std
        style: Tensor = self.style_encoder(motion, mask[:, :STYLE_FRAMES])
        return style

    def style_token(self, batch: Batch) -> Float[Tensor, "batch 1 dim"]:
        """The first token of every sequence."""
        nothing = self.generator.no_style
        if isinstance(batch.style, Tensor) and not batch.style.shape[1]:
            return nothing.expand(len(batch), -1, -1)
        style = self.generator.style_in(self.style_of(batch))[:, None]
        # By two products, as the authors compute it.
        return style * self.style_scale - nothing * (self.style_scale - 1.0)

    # Training.

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The codec's errors, and the generator's cross-entropy of the true bits of a chunk, given the chunk before."""
        motion = batch.motion.flatten(2)[..., list(self.modelled)]
        size, frames = self.scales[-1], batch.frame_lengths
        latest = max(1, int(frames.max()) - size // 2)
        first = torch.randint(0, latest, (len(batch),), device=self.device, generator=generator) % frames.clamp_min(1)
        chunk, valid = window_at(motion, frames, first, size)
        past, _ = window_at(motion, frames, (first - size).clamp_min(0), size)
        # Before the first frame there is the face at rest, as in generation.
        past = past * (first >= size)[:, None, None]
        codes = self.codec.encode(torch.cat([past, chunk], 1))
        stands_past, bits_past, _ = self.codec.quantise(codes[:, :size])
        stands, bits, distance = self.codec.quantise(codes[:, size:])
        terms: dict[str, Tensor] = {}
        total = torch.zeros((), device=self.device)
        if self.stage != "generator":
            _, decoded = self.codec.decode_codes(torch.cat([stands_past, stands], 1))
            error = (decoded - chunk) / self.codec.motion_std * valid[..., None]
            count = (valid.sum() * error.shape[2]).clamp_min(1)
            pairs = valid[:, 1:, None]
            terms["reconstruction"] = error.abs().sum() / count
            terms["velocity"] = (error.diff(dim=1) * pairs).abs().sum() / count
            terms["head"] = error[..., list(self.head_places)].abs().sum() / count
            terms["commitment"] = distance
            total = terms["reconstruction"] + sum(
                (weight * terms[name] for name, weight in WEIGHTS.items()), start=total
            )
        if self.stage != "codec":
            with torch.no_grad():
                flipped = self.codec.quantise(codes[:, size:], FLIPPED_BITS)[1] if self.training else bits
            style = self.drop(self.style_token(batch), self.generator.no_style)
            audio = torch.stack([self.encode_chunk(wave) for wave in self.chunk_waves(batch, first)])
            audio = self.drop(audio, torch.zeros((), device=self.device))
            memory = self.drop(self.tokens_of(bits_past, style), self.generator.no_style)
            logits = self.generator(self.tokens_of(flipped, style), memory, audio)
            token_mask = self.counted_tokens(valid)
            entropy = F.cross_entropy(logits.permute(0, 3, 1, 2), bits, reduction="none").mean(2)
            terms["bits"] = (entropy * token_mask).sum() / token_mask.sum().clamp_min(1)
            terms["accuracy"] = (
                (logits.argmax(3) == bits).float().mean(2) * token_mask
            ).sum() / token_mask.sum().clamp_min(1)
            total = total + terms["bits"]
        terms["loss"] = total
        return terms

    def counted_tokens(self, valid: Bool[Tensor, "batch frames"]) -> Float[Tensor, "batch tokens"]:
        """Which share of a token's frames are a clip's."""
        shares = valid.float()[..., None]
        return torch.cat([resized(shares, scale, "area") for scale in self.scales], 1)[..., 0]

    def drop(self, values: Tensor, instead: Tensor) -> Tensor:
        """In training, some clips without this condition."""
        if not self.training:
            return values
        without = torch.rand(len(values), device=values.device) < DROPPED
        return torch.where(without.view(-1, *[1] * (values.dim() - 1)), instead, values)

    def chunk_waves(self, batch: Batch, first: Int[Tensor, " batch"]) -> Float[Tensor, "batch samples"]:
        """The speech of chunks that begin at these frames, filled up with zeros."""
        unit, size = SAMPLE_RATE / self.frame_rate, self.chunk_samples
        waves = batch.audio.new_zeros(len(batch), size)
        for row, (start, length) in enumerate(zip(first.tolist(), batch.audio_lengths.tolist(), strict=True)):
            part = batch.audio[row, round(start * unit) : min(length, round(start * unit) + size)]
            waves[row, : len(part)] = part
        return waves

    # Speech.

    @property
    def chunk_samples(self) -> int:
        """Samples of a chunk's speech."""
        return int(self.scales[-1] / self.frame_rate * SAMPLE_RATE)

    def encode_chunk(self, wave: Float[Tensor, " samples"]) -> Float[Tensor, "tokens width"]:
        """Conditions of a chunk's tokens: its speech at all rates."""
        wave = (wave - wave.mean()) / (wave.std() + 1e-6)
        encoder = self.audio_encoder
        if isinstance(encoder, Wav2Vec2Encoder):
            hidden = encoder.hidden_of(wave[None])
        else:
            lengths, frames = (torch.tensor([count], device=wave.device) for count in (len(wave), self.scales[-1]))
            hidden = encoder.at_steps(wave[None], lengths, frames, "hidden")
        return torch.cat([resized(hidden, scale, "area") for scale in self.scales], 1)[0]

    # Generation.

    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """Chunk after chunk; nothing is random."""
        style, rows = self.style_token(batch), []
        for i, samples in enumerate(batch.audio_lengths.tolist()):
            motion, _ = self.animate_wave(batch.audio[i, :samples], style[i : i + 1], progress)
            rows.append(self.finished(self.placed(motion)).view(len(motion), self.n_vertices, self.dims))
        longest = int(frames.max())
        motion = nn.utils.rnn.pad_sequence(rows, batch_first=True)[:, :longest]
        return F.pad(motion, (0, 0, 0, 0, 0, longest - motion.shape[1]))

    def animate_wave(
        self, audio: Float[Tensor, " samples"], style: Float[Tensor, "1 1 dim"], progress: Progress | None = None
    ) -> tuple[Float[Tensor, "frames channels"], Float[Tensor, "chunks tokens bits 2"]]:
        """Motion of a recording before it is smoothed, and the generator's logits of every chunk's bits."""
        count = max(1, math.ceil(self.frames_of(len(audio)) / self.scales[-1]))
        size = self.chunk_samples
        filled = F.pad(audio, (0, max(0, count * size - len(audio))))
        bits, parts, logits = self.bits_at_rest(style), [], []
        for number in progress(range(count)) if progress is not None else range(count):
            motion, chunk_logits, bits = self.next_chunk(filled[number * size : (number + 1) * size], style, bits)
            parts.append(motion)
            logits.append(chunk_logits)
        return torch.cat(parts)[: self.frames_of(len(audio))], torch.stack(logits)

    def bits_at_rest(self, style: Float[Tensor, "1 1 dim"]) -> Bits:
        """Bits of zero motion, which stand before the first chunk."""
        return self.codec.bits_of(style.new_zeros(1, self.scales[-1], len(self.modelled)))

    def tokens_of(self, bits: Bits, style: Float[Tensor, "batch 1 dim"]) -> Float[Tensor, "batch tokens dim"]:
        """A chunk's tokens as far as there are bits: the style, then the coarser rates' decoded codes."""
        return torch.cat([style, self.generator.code_in(self.codec.inputs_of_next(bits))], 1)

    def next_chunk(
        self, wave: Float[Tensor, " samples"], style: Float[Tensor, "1 1 dim"], past: Bits
    ) -> tuple[Float[Tensor, "frames channels"], Float[Tensor, "tokens bits 2"], Bits]:
        """Motion of a chunk, the generator's logits of its bits, and the bits of that motion, for the next chunk."""
        audio, tokens, memory = self.encode_chunk(wave)[None], style, self.tokens_of(past, style)
        count = 0
        for number, scale in enumerate(self.scales):
            count += scale
            logits = self.generator(tokens, memory, audio[:, :count])
            # All bits are taken anew from every pass, coarser rates' too, as the authors do.
            bits = logits.argmax(3)
            if number + 1 < len(self.scales):
                tokens = self.tokens_of(bits, style)
        _, motion = self.codec.decode(past, bits)
        return motion[0], logits[0], self.codec.bits_of(motion)

    @property
    def stream_timing(self) -> tuple[float, float]:
        """A chunk and half of the longest filter, and a chunk; see the base class."""
        chunk = self.scales[-1]
        return (chunk + LONGEST_FILTER // 2 * self.smooth) / self.frame_rate, chunk / self.frame_rate

    def stream(self, *, plan: WindowPlan | None = None, **choices: Any) -> SpeechStream:  # noqa: ANN401
        """Animate speech of any length while it arrives, chunk by chunk; see the base class."""
        stream = super().stream(plan=plan, **choices)
        return ChunkStream(self, stream.clip, seeds=stream.seeds, plan=plan)

    def placed(self, motion: Float[Tensor, "frames modelled"]) -> Float[Tensor, "frames channels"]:
        """The codec's channels among all channels of the space; the others are 0."""
        frames = motion.new_zeros(len(motion), self.coordinates)
        frames[:, list(self.modelled)] = motion
        return frames

    def finished(self, motion: Float[Tensor, "frames channels"]) -> Float[Tensor, "frames channels"]:
        """Motion as the authors' programs write it: smoothed, and with a jaw that only opens."""
        if self.smooth:
            motion = torch.from_numpy(smoothed(motion.detach().cpu().numpy(), self.space.head)).to(motion)
        turned = () if self.space.is_vertices else self.space.rotations
        jaw = [channel for turn in turned if turn.joint == "jaw" for channel in turn.channels[1:]]
        if self.still_jaw and jaw:
            motion = motion.clone()
            motion[:, jaw] = 0.0
        return motion


class ChunkStream(SpeechStream):
    """Animates speech that arrives in pieces, chunk by chunk: the very frames that the whole recording gives.

    A frame is certain four seconds and four frames later at most: a chunk, and half of the longest filter.
    """

    model: ARTalk

    def __init__(
        self, model: ARTalk, clip: Batch, *, seeds: Sequence[int] = (0,), plan: WindowPlan | None = None
    ) -> None:
        super().__init__(model, clip, seeds=seeds, plan=plan)
        with torch.inference_mode():
            self._token = model.style_token(self.clip)
            self._bits = model.bits_at_rest(self._token)
        self._wave = self._token.new_zeros(0)  # speech that is not animated yet, shorter than a chunk
        self._raw = self._token.new_zeros(0, model.coordinates)  # not smoothed yet
        self._first = 0  # the frame that it begins with

    @torch.inference_mode()
    def feed(self, samples: Float[Tensor, " samples"] | npt.NDArray[np.float32]) -> Motion:
        """Take more speech at 16 kHz, and return the motion that it makes final; it may have no frames."""
        self._refuse_finished()
        self._wave, size = torch.cat([self._wave, torch.as_tensor(samples).to(self._wave)]), self.model.chunk_samples
        while len(self._wave) >= size:
            self._next(self._wave[:size], self.model.scales[-1])
            self._wave = self._wave[size:]
        end = min(self._first + len(self._raw), self._spoken)
        certain = end - LONGEST_FILTER // 2 if end >= LONGEST_FILTER else 0
        return self._given(certain if self.model.smooth else end, end)

    @torch.inference_mode()
    def finish(self, frames: int | None = None) -> Motion:
        """Give the motion that is left; arguments and errors as in the base class."""
        self._refuse_finished()
        self._finished = True
        end, size = self._first + len(self._raw), self.model.chunk_samples
        last = self._spoken
        if last > end:
            self._next(F.pad(self._wave, (0, size - len(self._wave))), last - end)
        self._raw = self._raw[: last - self._first]
        count = self._total(last, frames) - self.frames
        motion = self._given(last, last)[:, :count]
        return F.pad(motion, (0, 0, 0, 0, 0, count - motion.shape[1]))

    def _next(self, wave: Tensor, frames: int) -> None:
        """Animate a chunk, of which so many frames are wanted."""
        motion, _, self._bits = self.model.next_chunk(wave, self._token, self._bits)
        self._raw = torch.cat([self._raw, self.model.placed(motion[:frames])])

    @property
    def _spoken(self) -> int:
        """Frames of all speech: at rates such as 29.97 a chunk lasts a part of a sample less than its frames."""
        chunks = (self._first + len(self._raw)) // self.model.scales[-1]
        return self.model.frames_of(chunks * self.model.chunk_samples + len(self._wave))

    def _given(self, until: int, end: int) -> Motion:
        """The frames up to one that can be smoothed as within the whole recording, of the speech up to another one."""
        start = self.frames
        processed = self.model.finished(self._raw)[max(0, start - self._first) : max(0, until - self._first)]
        motion = processed.view(1, len(processed), self.model.n_vertices, self.model.dims)
        # Frames that later ones are smoothed with stay, and as many as the fit at the very end needs.
        first = max(0, min(until - LONGEST_FILTER // 2, end - LONGEST_FILTER))
        self._raw, self._first = self._raw[max(0, first - self._first) :], max(first, self._first)
        return self._counted([motion.expand(len(self.seeds), -1, -1, -1)])


LONGEST_FILTER = 9
"""Frames of the head's filter."""


def smoothed(motion: npt.NDArray[np.float32], head: Sequence[int]) -> npt.NDArray[np.float32]:
    """Savitzky–Golay filters over time: parabolas over 5 frames, for the head cubics over 9.

    Motion that is shorter than a filter is left as it is by it.
    """
    from scipy.signal import savgol_filter

    result = savgol_filter(motion, 5, 2, axis=0) if len(motion) >= 5 else motion.copy()
    if len(motion) >= 9 and head:
        result[:, list(head)] = savgol_filter(motion[:, list(head)], 9, 3, axis=0)
    return np.asarray(result, np.float32)


# The generator.


class PastAttention(nn.Module):
    """Attention of a chunk's tokens to the chunk before's and to each other, by the angle between them."""

    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.scale = nn.Parameter(torch.full((1, num_heads, 1, 1), math.log(4.0)))
        self.query, self.value, self.proj = nn.Linear(dim, dim), nn.Linear(dim, dim), nn.Linear(dim, dim)
        self.key = nn.Linear(dim, dim, bias=False)

    def forward(
        self, x: Float[Tensor, "batch tokens dim"], memory: Float[Tensor, "batch past dim"], mask: Tensor
    ) -> Float[Tensor, "batch tokens dim"]:
        """The layer's update of the tokens; ``mask`` is added to the scores of past and present tokens."""
        sequence = torch.cat([memory, x], 1)
        query, key, value = (
            mapped.unflatten(2, (self.num_heads, -1)).transpose(1, 2)
            for mapped in (self.query(x), self.key(sequence), self.value(sequence))
        )
        query = F.normalize(query, dim=3) * self.scale.clamp_max(LARGEST_SCALE).exp()
        mixed = F.scaled_dot_product_attention(query, F.normalize(key, dim=3), value, attn_mask=mask, scale=1.0)
        result: Tensor = self.proj(mixed.transpose(1, 2).flatten(2))
        return result


class ModulatedBlock(nn.Module):
    """Attention and a map of each token, which the token's speech scales and shifts."""

    def __init__(self, dim: int, audio_width: int, num_heads: int, hidden: int) -> None:
        super().__init__()
        self.attention = PastAttention(dim, num_heads)
        self.feed_forward = nn.Sequential(nn.Linear(dim, hidden), nn.GELU("tanh"), nn.Linear(hidden, dim))
        self.modulation = nn.Sequential(nn.SiLU(), nn.Linear(audio_width, 6 * dim))
        self.norm = nn.LayerNorm(dim, eps=1e-6, elementwise_affine=False)

    def forward(self, x: Tensor, memory: Tensor, audio: Tensor, mask: Tensor) -> Float[Tensor, "batch tokens dim"]:
        """Tokens after the block."""
        gate, gate_map, scale, scale_map, shift, shift_map = self.modulation(audio).chunk(6, 2)
        x = x + gate * self.attention(self.norm(x) * (1 + scale) + shift, memory, mask)
        mapped: Tensor = self.feed_forward(self.norm(x) * (1 + scale_map) + shift_map)
        return x + gate_map * mapped


class BitGenerator(nn.Module):
    """Bits of a chunk's tokens from the tokens, the chunk before's, and speech.

    Its sizes are options of ``ARTalk``.
    """

    mask: Tensor
    levels: Tensor

    def __init__(
        self,
        *,
        code_dim: int,
        style_dim: int,
        audio_width: int,
        dim: int,
        num_layers: int,
        num_heads: int,
        feed_forward_dim: int,
        scales: Sequence[int],
    ) -> None:
        super().__init__()
        self.code_dim = code_dim
        count, deviation = sum(scales), math.sqrt(1 / (3 * dim))
        self.code_in, self.style_in = nn.Linear(code_dim, dim), nn.Linear(style_dim, dim)
        self.no_style = nn.Parameter(torch.randn(1, 1, dim) * 0.5)
        self.positions = nn.Parameter(torch.randn(1, count, dim) * deviation)
        self.past_positions = nn.Parameter(torch.randn(1, count, dim) * deviation)
        self.level_table = nn.Parameter(torch.randn(len(scales), dim) * deviation)
        self.blocks = nn.ModuleList(
            ModulatedBlock(dim, audio_width, num_heads, feed_forward_dim) for _ in range(num_layers)
        )
        self.modulation = nn.Sequential(nn.SiLU(), nn.Linear(audio_width, 2 * dim))
        self.norm = nn.LayerNorm(dim, eps=1e-6, elementwise_affine=False)
        self.bits_out = nn.Linear(dim, 2 * code_dim)
        levels = torch.repeat_interleave(torch.arange(len(scales)), torch.tensor(list(scales)))
        # A token sees all of the past, and of its own chunk the tokens as coarse as itself or coarser.
        finer = torch.zeros(count, count).masked_fill(levels[:, None] < levels, -torch.inf)
        self.register_buffer("mask", F.pad(finer, (count, 0)), persistent=False)
        self.register_buffer("levels", levels, persistent=False)

    def forward(
        self,
        tokens: Float[Tensor, "batch tokens dim"],
        memory: Float[Tensor, "batch past dim"],
        audio: Float[Tensor, "batch tokens width"],
    ) -> Float[Tensor, "batch tokens bits 2"]:
        """Scores of either value of every bit.

        Args:
            tokens: of the rates so far: the style, then for each finer rate the coarser rates' decoded codes.
            memory: tokens of the chunk before.
            audio: speech of the tokens.
        """
        count, level = tokens.shape[1], self.level_table[self.levels]
        memory = memory + level + self.past_positions
        x = tokens + (level + self.positions)[:, :count]
        mask = self.mask[:count, : memory.shape[1] + count]
        for block in self.blocks:
            x = block(x, memory, audio, mask)
        scale, shift = self.modulation(audio).chunk(2, 2)
        scores: Tensor = self.bits_out(self.norm(x) * (1 + scale) + shift)
        return scores.view(*scores.shape[:2], self.code_dim, 2)
