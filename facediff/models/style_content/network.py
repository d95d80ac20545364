"""The networks of style-content disentanglement: motion to content and style, speech to content, both to motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.graphs import SpeechInput
from facediff.models.layers import Attention, FeedForward, sliding
from facediff.models.mesh_encoders import MeshEncoder
from facediff.models.speaker_encoders import StyleEncoder

SLOPE = 0.2
"""Of the leaky ReLU after each layer of the decoder."""

EPSILON = 1e-5
"""Added to the variance of the content before its root is taken."""


class DisentanglementNetwork(nn.Module):
    """Encoders of content and style, and the one decoder that motion and speech share.

    Args:
        content_encoder: motion to one feature per frame, E_C.
        style_frames: motion to one feature per frame, the first half of E_S.
        style_encoder: these features to one style vector, the second half of E_S.
        audio_encoder: speech to one feature per frame.
        speech_content: features of speech to content.
        decoder: content and style to motion, D.
        standardise_content: remove mean and spread over a clip's time from the content of motion.
        speech_rate: speech features a second; as many as motion has frames if None.
        frame_rate: motion frames a second.
        n_vertices: vertices of which :attr:`visible` says whether the encoders see them; they see all if None.
    """

    visible: Tensor | None

    def __init__(
        self,
        *,
        content_encoder: MeshEncoder,
        style_frames: MeshEncoder,
        style_encoder: StyleEncoder,
        audio_encoder: AudioEncoder,
        speech_content: WindowedTransformer,
        decoder: StyleContentDecoder,
        standardise_content: bool,
        speech_rate: float | None = None,
        frame_rate: float = 25.0,
        n_vertices: int | None = None,
    ) -> None:
        super().__init__()
        self.content_encoder = content_encoder
        self.style_frames = style_frames
        self.style_encoder = style_encoder
        self.audio_encoder = audio_encoder
        self.speech_content = speech_content
        self.decoder = decoder
        self.standardise_content = standardise_content
        self.speech_rate = frame_rate if speech_rate is None else speech_rate
        self.frame_rate = frame_rate
        # 1 for vertices that the encoders see, else 0. It follows from the corpus's regions, which a checkpoint keeps,
        # so it is not saved with the weights.
        self.register_buffer("visible", None if n_vertices is None else torch.ones(n_vertices), persistent=False)

    def content(
        self, motion: Float[Tensor, "batch frames points dims"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch frames content_dim"]:
        """Content of motion; zero on padding."""
        content = self.content_encoder(self.seen(motion)) * mask[..., None]
        if not self.standardise_content:
            return content
        # How far a speaker opens the mouth is style, not content. Removing each channel's mean and spread over the clip
        # takes it away before the decoder could rely on it.
        valid = mask[..., None].to(content.dtype)
        count = valid.sum(1, keepdim=True).clamp_min(1)
        centred = (content - content.sum(1, keepdim=True) / count) * valid
        return centred / (centred.square().sum(1, keepdim=True) / count + EPSILON).sqrt()

    def style(
        self, motion: Float[Tensor, "batch frames points dims"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vector of a motion."""
        return self.style_encoder(self.style_frames(self.seen(motion)), mask)

    def seen(self, motion: Float[Tensor, "batch frames points dims"]) -> Float[Tensor, "batch frames points dims"]:
        """The motion of the vertices that the encoders see; zero elsewhere."""
        return motion if self.visible is None else motion * self.visible[:, None]

    def content_of_speech(self, batch: Batch) -> Float[Tensor, "batch frames content_dim"]:
        """Content of a batch's speech, or of cached features of it."""
        return self.content_of(batch, batch.frame_lengths, batch.motion.shape[1])

    def content_of(
        self, speech: SpeechInput, lengths: Int[Tensor, " batch"], frames: int
    ) -> Float[Tensor, "batch frames content_dim"]:
        """Content of speech, of ``lengths`` frames each."""
        cached = speech.cached_features or ()
        # The encoder gives features at any rate, as if motion had so many frames.
        # Rounded in the same way for every clip, and at least one step, so that a clip's features do not depend on its
        # batch.
        steps = (lengths * self.ratio).round().long().clamp_min(1) if self.ratio != 1 else lengths
        features = self.audio_encoder(speech.audio, speech.audio_lengths, steps, *cached)
        content: Tensor = self.speech_content(features, frames, self.ratio, steps)
        return content

    @property
    def ratio(self) -> float:
        """Speech features a frame."""
        return self.speech_rate / self.frame_rate


class StyleContentDecoder(nn.Module):
    """Causal convolutions over time, each fed with the style next to the features, then fully connected layers.

    The sequence is padded with zeros at its front, so that its length is kept and no future frame is seen. The last of
    the fully connected layers is a trainable linear basis of the vertices.

    Args:
        n_vertices: points V.
        dims: numbers that each point has.
        content_dim: channels of the content.
        style_dim: channels of the style vector.
        channels: of the convolutions.
        kernels: taps of the convolutions.
        hidden: channels of the fully connected layers before the coefficients.
        basis_size: coefficients, i.e. shapes of the basis.
    """

    def __init__(
        self,
        *,
        n_vertices: int,
        dims: int,
        content_dim: int,
        style_dim: int,
        channels: Sequence[int] = (64, 128, 256),
        kernels: Sequence[int] = (5, 3, 3),
        hidden: Sequence[int] = (256, 256, 128),
        basis_size: int = 50,
    ) -> None:
        super().__init__()
        widths = [content_dim, *channels]
        self.kernels = list(kernels)
        self.convolutions = nn.ModuleList(
            nn.Conv1d(width + style_dim, out, kernel)
            for width, out, kernel in zip(widths[:-1], channels, kernels, strict=True)
        )
        steps = [widths[-1], *hidden]
        self.connected = nn.Sequential(
            *(
                layer
                for width, out in zip(steps[:-1], hidden, strict=True)
                for layer in (nn.Linear(width, out), nn.LeakyReLU(SLOPE))
            ),
            nn.Linear(steps[-1], basis_size),
        )
        self.basis = nn.Linear(basis_size, dims * n_vertices)

    @property
    def past_frames(self) -> int:
        """Frames before a frame that its motion depends on."""
        return sum(kernel - 1 for kernel in self.kernels)

    def start_from(self, mean: Float[Tensor, " coordinates"], shapes: Float[Tensor, "shapes coordinates"]) -> None:
        """Let the basis start from principal components, each scaled by its standard deviation.

        Where there are fewer of them than the basis has, the rest stay as they are but small.
        """
        with torch.no_grad():
            # Small, not zero: shapes past the given ones still get gradients.
            self.basis.weight.mul_(0.01)
            self.basis.weight[:, : len(shapes)] = shapes[: self.basis.in_features].T
            self.basis.bias.copy_(mean)

    def forward(
        self,
        content: Float[Tensor, "batch frames content_dim"],
        style: Float[Tensor, "batch style_dim"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames coordinates"]:
        """Motion, flattened to 3V coordinates; what stands on padding frames has no meaning and no effect."""
        x = content
        # Before every convolution and not only the first: a deep decoder would otherwise forget who speaks.
        repeated = style[:, None].expand(-1, content.shape[1], -1)
        valid = mask[..., None].to(content.dtype)
        for conv, kernel in zip(self.convolutions, self.kernels, strict=True):
            # Padding is zeroed again before each convolution: its own bias would otherwise fill it.
            columns = (torch.cat([x, repeated], dim=-1) * valid).transpose(1, 2)
            # Zeros at the front alone keep the length and show no future frame, which a stream does not have yet.
            columns = nn.functional.pad(columns, (kernel - 1, 0))
            x = nn.functional.leaky_relu(conv(columns).transpose(1, 2), SLOPE)
        coefficients = self.connected(x)
        # The last map is not of half precision in mixed precision: differences over time of such motion are noise.
        with torch.autocast(x.device.type, enabled=False):
            return self.basis(coefficients.to(self.basis.weight.dtype))


class WindowedTransformer(nn.Module):
    """For every frame an encoder over the features around it, and a decoder that asks with the middle one.

    There may be more speech features a second than frames: the middle of frame t's window is the feature m that falls
    on the frame's centre, m = ⌊(t + ½) · features a frame⌋. The window holds features m − ⌊W/2⌋ … m − ⌊W/2⌋ + W − 1,
    with zeros past the ends of the clip; the query is feature m (style-content disentanglement, "speech animation
    network").

    Args:
        in_dim: channels of the speech features.
        dim: channels inside.
        out_dim: channels of the content.
        window: features W around each frame.
        num_heads: attention heads.
        num_layers: encoder layers; one decoder layer follows.
        dropout: dropout everywhere.
        query: the middle feature as the ``encoded`` sequence has it, or as it is the ``input`` of the encoder.
    """

    def __init__(
        self,
        *,
        in_dim: int,
        dim: int = 64,
        out_dim: int,
        window: int,
        num_heads: int = 4,
        num_layers: int = 3,
        dropout: float = 0.0,
        query: Literal["encoded", "input"] = "encoded",
    ) -> None:
        super().__init__()
        self.query_encoded = query == "encoded"
        self.window = window
        self.before = window // 2
        self.embed = nn.Linear(in_dim, dim)
        self.positions = nn.Parameter(torch.randn(window, dim) * 0.02)
        self.layers = nn.ModuleList(WindowLayer(dim, num_heads, dropout) for _ in range(num_layers))
        self.query = WindowLayer(dim, num_heads, dropout)
        self.out = nn.Sequential(nn.LayerNorm(dim), nn.Linear(dim, out_dim))

    def windows(
        self,
        features: Float[Tensor, "batch steps dim"],
        frames: int | None = None,
        ratio: float = 1.0,
        lengths: Int[Tensor, " batch"] | None = None,
    ) -> Float[Tensor, "batch frames window dim"]:
        """Each frame's neighbours, zeros past the ends.

        Args:
            features: of the speech.
            frames: frames of motion; as many as features if None.
            ratio: features a frame.
            lengths: valid features of each clip; as many as the longest has if None.
        """
        after = self.window - 1 - self.before
        padded = nn.functional.pad(features, (0, 0, self.before, after))
        around = sliding(padded, self.window, 1, features.shape[1])
        if ratio != 1 or frames not in (None, features.shape[1]):
            count = features.shape[1] if frames is None else frames
            middles = ((torch.arange(count, device=features.device) + 0.5) * ratio).floor().long()
            # Rounding may leave a clip one feature short of its last frame's.
            last = middles.new_tensor([features.shape[1]]) if lengths is None else lengths
            clips = torch.arange(features.shape[0], device=features.device)[:, None]  # not len(), a constant in graphs
            around = around[clips, torch.minimum(middles, last[:, None] - 1)]
        return around.transpose(2, 3)

    def forward(
        self,
        features: Float[Tensor, "batch steps in_dim"],
        frames: int | None = None,
        ratio: float = 1.0,
        lengths: Int[Tensor, " batch"] | None = None,
    ) -> Float[Tensor, "batch frames out_dim"]:
        """Content of every frame; features are zero on padding, which then is like the silence past a clip's end.

        Args:
            features: of the speech.
            frames: frames of motion; as many as features if None.
            ratio: features a frame.
            lengths: valid features of each clip; as many as the longest has if None.
        """
        # Every frame's window is a sequence of its own, so that long clips cost time in proportion to their length.
        windows = self.windows(features, frames, ratio, lengths)
        embedded = x = self.embed(windows.flatten(0, 1)) + self.positions
        for layer in self.layers:
            x = layer(x, x)
        # The middle feature alone asks, so that the decoder layer costs one query a frame and not a whole window.
        middle = (x if self.query_encoded else embedded)[:, self.before : self.before + 1]
        return self.out(self.query(middle, x)).view(*windows.shape[:2], -1)


class WindowLayer(nn.Module):
    """Pre-norm attention from ``x`` to ``context``, then a feed-forward part."""

    def __init__(self, dim: int, num_heads: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        self.attention = Attention(dim, dim, num_heads, dropout=dropout)
        self.feed_forward = nn.Sequential(nn.LayerNorm(dim), FeedForward(dim, 2 * dim, dropout))
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        """``x`` (batch, queries, dim), ``context`` (batch, keys, dim)."""
        x = x + self.dropout(self.attention(self.norm(x), self.norm(context)))
        return x + self.dropout(self.feed_forward(x))
