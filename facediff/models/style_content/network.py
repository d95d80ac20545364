"""The networks of style-content disentanglement: motion to content and style, speech to content, both to motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.errors import ArgumentError, FaceDiffError
from facediff.models.audio_encoders import AudioEncoderFactory, MelEncoder
from facediff.models.base import Decay
from facediff.models.graphs import SpeechInput
from facediff.models.layers import Attention, FeedForward, Heads, Weight, Width, sliding
from facediff.models.mesh_encoders import MeshEncoderFactory, SpiralMeshEncoder
from facediff.models.speaker_encoders import LstmStyle, StyleEncoderFactory
from facediff.utils.ranges import Range

SLOPE = 0.2
"""Of the leaky ReLU after each layer of the decoder."""

EPSILON = 1e-5
"""Added to the variance of the content before its root is taken."""


SPEECH_TERMS = ("reconstruction", "swap", "cycle", "swap_dynamics")
"""Terms that the speech network has as well, by the name ``speech_<term>``."""


@dataclass(kw_only=True)
class StyleContentOptions:
    """Options of :class:`StyleContentDisentanglement`; ablations are one override each.

    ``swap_weight=0``, ``cycle_weight=0``, ``aligned_pairs=false`` and ``speech_content_weight=0``.

    Args:
        dim: channels of speech features and of motion features before the style encoder.
        content_dim: channels of the content.
        audio_encoder: speech to features.
        mesh_encoder: motion to one feature per frame, made once for content and once for style.
        style_encoder: these features to the style vector.
        window_seconds: length of the speech window around each frame.
        speech_rate: speech features a second in the window; as many as motion has frames if None.
        speech_layers: encoder layers over the window.
        speech_heads: attention heads of these.
        decoder_channels: channels of the decoder's three convolutions.
        decoder_kernels: their taps.
        decoder_hidden: channels of its fully connected layers before the coefficients.
        basis_size: coefficients of its linear basis, which starts from the principal components of the training motion.
        content_scale: ``clip`` removes mean and spread over a clip from the content of motion, by which a speaker
            would be recognised; ``free`` leaves it as it is.
        vertices: input of the encoders and of the losses: all vertices, or the corpus's region ``face``
            (``data.face``), e.g. without FLAME's eyeballs. The decoder moves all of them.
        aligned_pairs: where two speakers say the same sentence, supervise a swap of their styles with the other's
            recording, aligned in time; else, and everywhere if False, by the encoders' consistency.
        aligned_windows: with ``data.window``, let the windows of two clips that say the same begin at the same sound,
            so that they are aligned pairs as whole clips are; else windows are never aligned.
        window_context: with ``data.window``, read the frames around a training window that the decoder's kernels and
            the speech windows reach; they are seen, and no loss counts them. Else a window is like a clip of its own.
        swap_region: the vertices where such a recording supervises.
        reconstruction_weight: of motion from its own content and style.
        swap_weight: of motion from its own content and the partner's style.
        cycle_weight: of swapping twice.
        swap_dynamics_weight: of the swapped upper face's spread over time against the partner's.
        speech_weight: factor of the same terms with content from speech.
        speech_query: what asks the window for the content of its middle frame: the ``encoded`` feature in the middle,
            or the ``input`` feature, as the patent words it.
        speech_style: the style that content from speech is decoded with in training: of another clip of the speaker,
            as in animation, or the clip's own, as content from motion is.
        content_pull: how contents are compared: their mean squared difference as a share of their variance, or as it
            is (``squared``).
        style_pull: how an identity's styles are pulled together: against all other identities' (``contrast``), or by
            their mean squared difference alone (``squared``).
        recording_content_weight: pulls the contents of two aligned recordings of a sentence together.
        identity_style_weight: pulls the styles of an identity's clips together; see ``style_pull``.
        speech_content_weight: pulls content from speech to content from motion.
        position_weight: of positions within each comparison of motions.
        velocity_weight: of velocities within it.
        lip_gap_weight: of the gap between the inner lips within it.
        weight_decay: decoupled weight decay.
    """

    dim: Width = 64
    content_dim: Width = 64
    audio_encoder: AudioEncoderFactory = MelEncoder
    mesh_encoder: MeshEncoderFactory = SpiralMeshEncoder
    style_encoder: StyleEncoderFactory = LstmStyle
    window_seconds: Annotated[float, Range(0, 10)] = 0.64
    speech_rate: Annotated[float, Range(1, 1000)] | None = None
    speech_layers: Annotated[int, Range(0, 256)] = 3
    speech_heads: Heads = 4
    decoder_channels: Annotated[Sequence[int], Range(1, 16_384, items=(0, 32))] = (64, 128, 256)
    decoder_kernels: Annotated[Sequence[int], Range(1, 1000, items=(0, 32))] = (5, 3, 3)
    decoder_hidden: Annotated[Sequence[int], Range(1, 16_384, items=(0, 32))] = (256, 256, 128)
    basis_size: Width = 50
    content_scale: Literal["clip", "free"] = "clip"
    vertices: Literal["all", "face"] = "all"
    aligned_pairs: bool = True
    aligned_windows: bool = False
    window_context: bool = False
    swap_region: Literal["lower_face", "face"] = "lower_face"
    reconstruction_weight: Weight = 1.0
    swap_weight: Weight = 3.0
    cycle_weight: Weight = 1.0
    swap_dynamics_weight: Weight = 3.0
    speech_weight: Weight = 2.0
    speech_query: Literal["encoded", "input"] = "encoded"
    speech_style: Literal["other_clip", "own"] = "other_clip"
    content_pull: Literal["relative", "squared"] = "relative"
    style_pull: Literal["contrast", "squared"] = "contrast"
    recording_content_weight: Weight = 5.0
    identity_style_weight: Weight = 10.0
    speech_content_weight: Weight = 5.0
    position_weight: Weight = 1.0
    velocity_weight: Weight = 5.0
    lip_gap_weight: Weight = 1.0
    weight_decay: Decay = 0.0

    @property
    def weights(self) -> dict[str, float]:
        """The weight of every term; the terms of (4.2) have the factor ``speech_weight``."""
        weights = {
            "reconstruction": self.reconstruction_weight,
            "swap": self.swap_weight,
            "cycle": self.cycle_weight,
            "swap_dynamics": self.swap_dynamics_weight,
            "recording_content": self.recording_content_weight,
            "identity_style": self.identity_style_weight,
            "speech_content": self.speech_content_weight,
        }
        return weights | {f"speech_{term}": self.speech_weight * weights[term] for term in SPEECH_TERMS}


class DisentanglementNetwork(nn.Module):
    """Encoders of content and style, and the one decoder that motion and speech share."""

    visible: Tensor | None

    def __init__(self, options: StyleContentOptions, *, n_vertices: int, dims: int, frame_rate: float) -> None:
        super().__init__()
        self.standardise_content = options.content_scale == "clip"
        self.frame_rate, self.speech_rate = frame_rate, options.speech_rate or frame_rate
        dim, points = options.dim, {"n_vertices": n_vertices, "dims": dims}
        style_encoder = options.style_encoder(dim=dim)  # first, since the order decides its random weights
        if not style_encoder.token_dims:
            raise FaceDiffError("style_encoder: this model needs a style; choose another style encoder, such as lstm")
        # Motion to one feature per frame: E_C, and the first half of E_S.
        self.content_encoder = options.mesh_encoder(dim=options.content_dim, **points)
        self.style_frames = options.mesh_encoder(dim=dim, **points)
        self.style_encoder = style_encoder
        self.audio_encoder = options.audio_encoder(dim=dim)
        self.speech_content = WindowedTransformer(
            in_dim=dim,
            dim=dim,
            out_dim=options.content_dim,
            window=max(1, round(options.window_seconds * self.speech_rate)),
            num_heads=options.speech_heads,
            num_layers=options.speech_layers,
            query=options.speech_query,
        )
        if len(options.decoder_channels) != len(options.decoder_kernels):
            raise ArgumentError(
                {"decoder_channels": options.decoder_channels, "decoder_kernels": options.decoder_kernels},
                "expected as many kernels as channels",
            )
        self.decoder = StyleContentDecoder(
            **points,
            content_dim=options.content_dim,
            style_dim=sum(style_encoder.token_dims),
            channels=options.decoder_channels,
            kernels=options.decoder_kernels,
            hidden=options.decoder_hidden,
            basis_size=options.basis_size,
        )
        # 1 for vertices that the encoders see, else 0. It follows from the corpus's regions, which a checkpoint keeps,
        # so it is not saved with the weights.
        visible = torch.ones(n_vertices) if options.vertices == "face" else None
        self.register_buffer("visible", visible, persistent=False)

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
        """Each frame's neighbours, zeros past the ends."""
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
