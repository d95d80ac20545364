"""Building blocks shared by components: frame masks, resampling over time, rotary attention, feed-forward."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence, pad_packed_sequence

from facediff.errors import ArgumentError
from facediff.utils.ranges import Range

Frames = Float[Tensor, "batch frames dim"]
"""One feature per frame of motion."""

FrameMask = Bool[Tensor, "batch frames"]
"""True on valid frames, False on padding."""

Width = Annotated[int, Range(1, 16_384)]
"""Channels of a layer."""

Layers = Annotated[int, Range(1, 256)]
"""How often a layer is repeated."""

Heads = Annotated[int, Range(1, 256)]
"""Attention heads."""

Share = Annotated[float, Range(0, 1)]
"""A probability, such as dropout's."""

Weight = Annotated[float, Range(0, 1e6)]
"""Factor of a loss term."""

Rotation = tuple[Tensor, Tensor]
"""Cosines and signed sines of a rotary embedding, both (frames, head_dim)."""


def check_heads(*, even: bool = False, rotary: bool = False, **options: int) -> None:
    """Refuse a width that its attention heads do not divide."""
    (name, width), (heads, count) = options.items()
    if width % (2 * count if rotary else count) or (even and width % 2):
        raise ArgumentError(options, f"{name} must be a multiple of {'2 ' * rotary}{heads}{', and even' * even}")


class AttentionContext(NamedTuple):
    """Keys and values of an attention's context, both (batch, heads, keys, head_dim)."""

    key: Tensor
    value: Tensor


def frame_mask(lengths: Int[Tensor, " batch"], frames: int) -> FrameMask:
    """True on valid frames, False on padding."""
    return torch.arange(frames, device=lengths.device)[None, :] < lengths[:, None]


def exporting() -> bool:
    """Whether a graph is being recorded (:mod:`facediff.models.graphs`), which cannot depend on values."""
    return torch.compiler.is_exporting()


_most_frames: ContextVar[int | None] = ContextVar("most_frames", default=None)


@contextmanager
def of_frames(count: int) -> Iterator[None]:
    """Within it, the longest clip has so many frames, or steps of the audio encoder; see :func:`longest`.

    A graph takes the number from the shape of an input, since it cannot depend on values.
    """
    token = _most_frames.set(count)
    try:
        yield
    finally:
        _most_frames.reset(token)


def longest(lengths: Int[Tensor, " batch"]) -> int:
    """The largest of some lengths; while a graph is recorded, the number that :func:`of_frames` sets."""
    count = _most_frames.get()
    return int(lengths.max()) if count is None else count


def sliding(
    x: Float[Tensor, "batch steps channels"], size: int, stride: int, count: int
) -> Float[Tensor, "batch count channels size"]:
    """So many windows over time, each ``stride`` steps after the one before; the last must end within the steps."""
    if exporting():  # graphs know no strided views
        indices = torch.arange(count, device=x.device)[:, None] * stride + torch.arange(size, device=x.device)
        return x[:, indices].transpose(2, 3)
    return x.unfold(1, size, stride)[:, :count]


def needed_mask(mask: FrameMask) -> FrameMask | None:
    """The mask, or None where nothing is padded; it looks at the values, so it waits for the device."""
    return None if not exporting() and bool(mask.all()) else mask


def interpolate_frames(
    features: Float[Tensor, "batch steps dim"], lengths: Int[Tensor, " batch"], frame_lengths: Int[Tensor, " batch"]
) -> Frames:
    """Resample each clip's own ``lengths[b]`` feature steps to ``frame_lengths[b]`` frames, linearly in time.

    Steps and frames are cells that tile the same stretch of time, so frame j lies at step
    (j + ½)·length/frames − ½, held at the ends. Padding neither enters nor is written: frames beyond a clip's
    own length are zero.
    """
    frames = longest(frame_lengths)
    ratio = lengths.float() / frame_lengths.float()
    last = (lengths - 1)[:, None].float()
    # PyTorch's own interpolation has one ratio for the whole batch; here each clip has its own, so that its features do
    # not depend on how far it is padded.
    position = (torch.arange(frames, device=features.device, dtype=torch.float32)[None, :] + 0.5) * ratio[:, None] - 0.5
    position = torch.minimum(position.clamp_min(0.0), last)
    # Held at the ends: half a step before the first cell's centre there is nothing to interpolate from.
    low = position.floor()
    weight = (position - low)[..., None].to(features.dtype)

    def at(step: Tensor) -> Tensor:
        return features.gather(1, step.long()[..., None].expand(-1, -1, features.shape[-1]))

    mixed = at(low) * (1 - weight) + at(torch.minimum(low + 1, last)) * weight
    return mixed * frame_mask(frame_lengths, frames)[..., None]


def interpolate_ends(features: Float[Tensor, "batch steps dim"], frames: int) -> Frames:
    """Resample clips of one length linearly in time, so that the first and last frame are the first and last step.

    Frame i lies at step i·(steps − 1)/(frames − 1), as the published methods of the field have it; see
    :func:`interpolate_frames` for the way in which frames keep their place in time.
    """
    # align_corners as in the released code of FaceFormer and its successors: the first and the last step stay at the
    # ends of the clip, and the released weights were trained on the stretched time that follows.
    return F.interpolate(features.transpose(1, 2), size=frames, mode="linear", align_corners=True).transpose(1, 2)


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """A model in evaluation mode; afterwards each part has its own mode, since train() would wake up frozen parts."""
    modes = [(module, module.training) for module in model.modules()]
    model.eval()
    try:
        yield
    finally:
        for module, training in modes:
            module.training = training


def all_states(
    network: nn.GRU | nn.LSTM, x: Float[Tensor, "batch frames dim"], lengths: Int[Tensor, " batch"] | None = None
) -> Float[Tensor, "batch frames states"]:
    """The states of a recurrent network after each frame; its input has the batch first.

    ``lengths`` are the clips' on the processor; all frames if None, and in graphs, which take clips of one length.
    """
    if exporting():
        return recurrent_nodes(network, x)
    if lengths is None:
        return network(x)[0]
    # Packed, so that the backward direction starts at a clip's own last frame and not in its padding.
    packed = pack_padded_sequence(x, lengths, batch_first=True, enforce_sorted=False)
    return pad_packed_sequence(network(packed)[0], batch_first=True, total_length=x.shape[1])[0]


def recurrent_nodes(
    network: nn.GRU | nn.LSTM, x: Float[Tensor, "batch frames dim"]
) -> Float[Tensor, "batch frames states"]:
    """The same as nodes of the ONNX format, since PyTorch would record every frame by itself, or a loop over them."""
    lstm, ends = isinstance(network, nn.LSTM), ("", "_reverse")[: 1 + network.bidirectional]
    # PyTorch's gates are i, f, g, o and r, z, n; ONNX has i, o, f, c and z, r, h.
    order = [0, 3, 1, 2] if lstm else [1, 0, 2]
    attributes: dict[str, int | str] = {
        "hidden_size": network.hidden_size,
        "direction": "bidirectional" if network.bidirectional else "forward",
        # PyTorch's GRU applies the reset gate after the product with the hidden state, the format's default before it.
        **({} if lstm else {"linear_before_reset": 1}),
    }

    def stacked(name: str) -> Tensor:
        parts = [getattr(network, f"{name}{end}").unflatten(0, (len(order), -1))[order].flatten(0, 1) for end in ends]
        return torch.stack(parts)

    x = x.transpose(0, 1)
    for layer in range(network.num_layers):
        bias = torch.cat([stacked(f"bias_ih_l{layer}"), stacked(f"bias_hh_l{layer}")], 1)
        weights = stacked(f"weight_ih_l{layer}"), stacked(f"weight_hh_l{layer}"), bias
        outputs = torch.onnx.ops.symbolic(
            "LSTM" if lstm else "GRU",
            (x, *weights),
            attributes,  # type: ignore[arg-type]
            dtype=x.dtype,
            shape=(x.shape[0], len(ends), x.shape[1], network.hidden_size),
        )
        x = outputs.transpose(1, 2).flatten(2)  # directions side by side
    return x.transpose(0, 1)


class RotaryEmbedding(nn.Module):
    """Rotary position embedding: rotates channel pairs by an angle proportional to the frame number.

    The inner product of a rotated query and a rotated key depends on their distance in frames only
    (Su et al. 2021, RoFormer, eq. 16 and 34).

    Args:
        head_dim: channels of one attention head; must be even.
        base: wavelengths run geometrically from 2π to 2π·base frames.
    """

    frequencies: Tensor

    def __init__(self, head_dim: int, base: float = 10_000.0) -> None:
        super().__init__()
        exponent = torch.arange(0, head_dim, 2, dtype=torch.float32) / head_dim
        # Not saved: it follows from the options, so a checkpoint need not repeat it.
        self.register_buffer("frequencies", base**-exponent, persistent=False)

    def table(self, frames: int) -> Rotation:
        """What :meth:`forward` needs for ``frames`` frames or fewer."""
        positions = torch.arange(frames, device=self.frequencies.device, dtype=torch.float32)
        angle = positions[:, None] * self.frequencies
        cos, sin = angle.cos(), angle.sin()
        return torch.cat([cos, cos], dim=-1), torch.cat([-sin, sin], dim=-1)

    def forward(
        self, x: Float[Tensor, "batch heads frames head_dim"], table: Rotation | None = None
    ) -> Float[Tensor, "batch heads frames head_dim"]:
        """Rotate channel pair (i, i + head_dim/2) of frame t by t·frequency_i."""
        frames = x.shape[-2]
        cos, sin = (part[:frames].to(x.dtype) for part in (self.table(frames) if table is None else table))
        # (a, b) → (a cos − b sin, b cos + a sin): the halves change places, and the table's sines carry the signs.
        # Pairs are (i, i + head_dim/2) and not neighbours as in the paper: the same rotation up to a permutation of
        # channels, without strided access.
        first, second = x.chunk(2, dim=-1)
        return x * cos + torch.cat([second, first], dim=-1) * sin


class Attention(nn.Module):
    """Multi-head attention from ``dim`` to ``dim`` channels with optional rotary positions.

    :meth:`forward` is :meth:`queries`, :meth:`keys_values` and :meth:`attend`, which may be called one by one where one
    side does not change.

    Args:
        dim: channels of the query and of the result.
        context_dim: channels of keys and values.
        num_heads: heads; ``dim`` must be a multiple.
        rotary: rotate queries and keys by their frame number.
        dropout: dropout on the attention weights in training.
    """

    def __init__(
        self, dim: int, context_dim: int, num_heads: int, *, rotary: bool = False, dropout: float = 0.0
    ) -> None:
        super().__init__()
        check_heads(dim=dim, num_heads=num_heads, rotary=rotary)
        self.num_heads = num_heads
        self.dropout = dropout
        self.query = nn.Linear(dim, dim)
        self.key_value = nn.Linear(context_dim, 2 * dim)
        self.out = nn.Linear(dim, dim)
        self.rotary = RotaryEmbedding(dim // num_heads) if rotary else None

    def forward(
        self,
        x: Frames,
        context: Float[Tensor, "batch keys context_dim"],
        context_mask: Bool[Tensor, "batch keys"] | None = None,
        rotation: Rotation | None = None,
    ) -> Frames:
        """Attend from ``x`` to the valid positions of ``context``."""
        return self.attend(self.queries(x, rotation), self.keys_values(context, rotation), context_mask)

    def rotation(self, frames: int) -> Rotation | None:
        """The table of rotary positions for so many frames and keys; None without such positions."""
        return None if self.rotary is None else self.rotary.table(frames)

    def queries(self, x: Frames, rotation: Rotation | None = None) -> Float[Tensor, "batch heads frames head_dim"]:
        """All that ``x`` is needed for."""
        # Rotated after the split: every head has all wavelengths, so that each may look near or far.
        query = self._split(self.query(x))
        return query if self.rotary is None else self.rotary(query, rotation)

    def keys_values(
        self, context: Float[Tensor, "batch keys context_dim"], rotation: Rotation | None = None
    ) -> AttentionContext:
        """All that ``context`` is needed for."""
        key, value = (self._split(part) for part in self.key_value(context).chunk(2, dim=-1))
        return AttentionContext(key if self.rotary is None else self.rotary(key, rotation), value)

    def attend(
        self,
        query: Float[Tensor, "batch heads frames head_dim"],
        context: AttentionContext,
        context_mask: Bool[Tensor, "batch keys"] | None = None,
    ) -> Frames:
        """The attention itself, and the map of its result."""
        key, value = context
        # Keys are masked, queries are not: what padding frames attend to is zeroed later, and a row without any valid
        # key would be NaN.
        # One mask for all heads and queries. None where possible, since masks rule out the quickest kernels.
        mask = None if context_mask is None else context_mask[:, None, None, :]
        dropout = self.dropout if self.training else 0.0
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=mask, dropout_p=dropout)
        return self.out(mixed.transpose(1, 2).flatten(2))

    def _split(self, x: Tensor) -> Tensor:
        return x.view(*x.shape[:-1], self.num_heads, -1).transpose(1, 2)


class FeedForward(nn.Sequential):
    """Two linear maps with a GELU between, ``dim`` to ``dim``."""

    def __init__(self, dim: int, hidden_dim: int, dropout: float = 0.0) -> None:
        super().__init__(nn.Linear(dim, hidden_dim), nn.GELU(), nn.Dropout(dropout), nn.Linear(hidden_dim, dim))
