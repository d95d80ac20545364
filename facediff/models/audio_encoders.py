"""Audio encoders: one trained from scratch, pretrained HuBERT (dual-path paper, section 1.2), a frozen recogniser."""

from __future__ import annotations

import hashlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.errors import ArgumentError, FaceDiffError, damaged, needs_extra
from facediff.models.layers import Frames, Share, Width, exporting, frame_mask, interpolate_frames, longest
from facediff.registry import audio_encoder
from facediff.speech.cepstra import mel_filters
from facediff.speech.windows import CONVOLUTIONS, convolved
from facediff.utils.ranges import Range

if TYPE_CHECKING:
    from transformers import PreTrainedModel


Waves = Float[Tensor, "batch samples"]
"""Speech at 16 kHz, mono, padded with zeros."""

Features = Float[Tensor, "batch steps channels"]
"""Features of speech from the frozen part of an encoder."""

Lengths = Int[Tensor, " batch"]
"""Valid samples, steps or frames of each clip."""

StepRule = Literal["features", "features_cut", "hidden", "hidden_cut"]
"""Where the published methods leave a pretrained network's 50 steps a second: its ``features`` from the convolutions or
its last ``hidden`` states are interpolated to the model's steps, or (``…_cut``) cut after them."""


class AudioEncoder(nn.Module, ABC):
    """Speech to one feature per motion frame.

    A clip's feature must not depend on how far it is padded, nor on the other clips of a batch.

    The frozen first part of an encoder may be computed once per clip and kept on disk. Such an encoder overrides
    :meth:`frozen_key` and :meth:`frozen_features`, and takes their result as ``features`` and ``feature_lengths``,
    two further arguments of its :meth:`forward` that no other encoder is given.

    Class attributes:
        takes_padding: whether clips of several lengths are encoded together; else clips of one length.

    An encoder for which loudness matters calls :meth:`standardise`, so that a piece of a long recording is as loud as
    it is in the whole.
    """

    takes_padding: ClassVar[bool] = True
    _level: tuple[float, float] | tuple[Tensor, Tensor] | None = None

    @property
    def has_level(self) -> bool:
        """Whether speech is standardised by a level that is set, and not by its own."""
        return self._level is not None

    @contextmanager
    def at_level(self, mean: float | Tensor, deviation: float | Tensor) -> Iterator[None]:
        """A context in which speech is standardised by this mean and standard deviation instead of its own."""
        before = self._level
        self._level = (mean, deviation)  # type: ignore[assignment]
        try:
            yield
        finally:
            self._level = before

    def standardise(self, audio: Waves, lengths: Lengths, epsilon: float = 1e-7) -> Waves:
        """Speech of zero mean and unit variance, as :func:`standardise` makes it or by the level that is set."""
        if self._level is None:
            return standardise(audio, lengths, epsilon)
        mean, deviation = self._level
        return (audio - mean) / deviation * frame_mask(lengths, audio.shape[1])

    def frozen_key(self) -> str | None:
        """A hash of all that :meth:`frozen_features` depends on; None if nothing is frozen, or something is random."""
        return None

    def frozen_features(self, audio: Waves, audio_lengths: Lengths) -> tuple[Features, Lengths]:
        """The frozen part's features of speech, and each clip's valid steps."""
        raise NotImplementedError(f"{type(self).__name__} has no frozen part")

    def steps_of(self, samples: int) -> int:
        """Steps that the convolutions of a pretrained network make of so many samples, 50 a second but for the ends.

        The published methods count their frames by them, with any encoder in the network's place.
        """
        return convolved(samples, self.convolutions())

    def convolutions(self) -> tuple[tuple[int, int], ...]:
        """Kernel and stride of each of these convolutions."""
        return CONVOLUTIONS

    def at_steps(
        self, audio: Waves, audio_lengths: Lengths, steps: Lengths, rule: StepRule, *cached: Tensor
    ) -> Float[Tensor, "batch most_steps width"]:
        """Encode as the published methods do: a number of steps for each clip, which need not be its frames.

        Here for encoders that follow no such rule: as many frames, spread over the clip evenly.

        Returns:
            features, ``most_steps = steps.max()``; zero beyond a clip's own steps.
        """
        encoded: Tensor = self(audio, audio_lengths, steps, *cached)
        return encoded

    def at_rate(
        self, audio: Waves, audio_lengths: Lengths, steps: Lengths, rate: float, *cached: Tensor
    ) -> Float[Tensor, "batch most_steps width"]:
        """Encode as VOCA does: at ``rate`` steps a second, the first of them where speech begins.

        Here for encoders without such times: as many steps, spread over the clip evenly.

        Returns:
            features, ``most_steps = steps.max()``; zero beyond a clip's own steps.
        """
        encoded: Tensor = self(audio, audio_lengths, steps, *cached)
        return encoded

    @abstractmethod
    def forward(self, audio: Waves, audio_lengths: Lengths, frame_lengths: Lengths) -> Frames:
        """Encode.

        Args:
            audio: waveform at 16 kHz, mono, padded with zeros.
            audio_lengths: valid samples of each clip.
            frame_lengths: motion frames of each clip; they span the same time as its samples.

        Returns:
            features, ``frames = frame_lengths.max()``; zero on padding frames.
        """


class FrozenEncoder(AudioEncoder):
    """Base of encoders with a frozen part; its features can be kept on disk."""

    takes_padding = False  # such networks attend to all of a clip, see :func:`by_length`
    out: nn.Linear | None

    def trained(self, features: Features, lengths: Lengths) -> tuple[Tensor, Lengths]:
        """Process the frozen part's features before the map to the model's width; here not at all."""
        return features, lengths

    def states(
        self, audio: Waves, audio_lengths: Lengths, features: Features | None, feature_lengths: Lengths | None
    ) -> tuple[Tensor, Lengths]:
        """The steps before the map to the model's width, from the frozen part's features where they are kept."""
        if features is None or feature_lengths is None:
            features, feature_lengths = self.frozen_features(audio, audio_lengths)
        return self.trained(features, feature_lengths)

    def forward(
        self,
        audio: Waves,
        audio_lengths: Lengths,
        frame_lengths: Lengths,
        features: Features | None = None,
        feature_lengths: Lengths | None = None,
    ) -> Frames:
        """Encode; see :class:`AudioEncoder`."""
        hidden, steps = self.states(audio, audio_lengths, features, feature_lengths)
        return interpolate_frames(hidden if self.out is None else self.out(hidden), steps, frame_lengths)


class AudioEncoderFactory(Protocol):
    """Makes an audio encoder once the model's width is known."""

    def __call__(self, *, dim: int) -> AudioEncoder:
        """Make one with ``dim`` output channels."""


def standardise(audio: Waves, lengths: Lengths, epsilon: float = 1e-7) -> Waves:
    """Zero mean and unit variance over each clip's valid samples, zero on padding, as HuBERT's processor does."""
    mask = frame_mask(lengths, audio.shape[1])
    count = lengths[:, None].to(audio.dtype)
    # Over the valid samples alone: zeros of padding would make a short clip louder in a batch than by itself.
    mean = (audio * mask).sum(1, keepdim=True) / count
    variance = ((audio - mean).square() * mask).sum(1, keepdim=True) / count
    return (audio - mean) / (variance + epsilon).sqrt() * mask


@audio_encoder.register("mel")
class MelEncoder(AudioEncoder):
    """Log-mel spectrogram of 64 bands, 60 to 7 600 Hz, and residual dilated convolutions, trained from scratch.

    The default where no pretrained weights are at hand. 100 spectra a second are halved to 50 steps a second by a
    strided convolution and interpolated to the motion's frame rate at the end.

    Args:
        hidden_dim: channels of the convolutions.
        num_layers: residual blocks, with dilations 1, 2, 4, 1, 2, 4 …
        dropout: dropout in each block.
    """

    filters: Tensor
    window: Tensor
    n_mels = 64
    n_fft = 512
    hop = 160

    def __init__(
        self,
        *,
        dim: Width,
        hidden_dim: Width = 128,
        num_layers: Annotated[int, Range(0, 256)] = 4,
        dropout: Share = 0.1,
    ) -> None:
        super().__init__()
        self.register_buffer(
            "filters", torch.from_numpy(mel_filters(self.n_mels, self.n_fft, 60.0, 7600.0)), persistent=False
        )
        self.register_buffer("window", torch.hann_window(400), persistent=False)
        self.stem = nn.Conv1d(self.n_mels, hidden_dim, kernel_size=4, stride=2, padding=1)
        self.blocks = nn.ModuleList(ConvBlock(hidden_dim, 2 ** (i % 3), dropout) for i in range(num_layers))
        self.out = nn.Sequential(nn.LayerNorm(hidden_dim), nn.Linear(hidden_dim, dim))

    def forward(self, audio: Waves, audio_lengths: Lengths, frame_lengths: Lengths) -> Frames:
        """Encode; see :class:`AudioEncoder`."""
        # Standardised first, so that the loudness of a recording, which says more about the microphone than about the
        # mouth, does not reach the network.
        spectrum, lengths = self._log_mel(self.standardise(audio, audio_lengths), audio_lengths)
        # Padding is zeroed again after every layer: a convolution next to it would let its values into the clip.
        x = self.stem(spectrum.transpose(1, 2)).transpose(1, 2)
        # The strided stem halves the steps; a single spectrum still gives one step, so that the shortest clip has a
        # feature.
        lengths = (lengths // 2).clamp_min(1)
        mask = frame_mask(lengths, x.shape[1])[..., None].to(x.dtype)
        x = nn.functional.gelu(x) * mask
        for block in self.blocks:
            x = block(x, mask)
        return interpolate_frames(self.out(x), lengths, frame_lengths)

    def _log_mel(self, audio: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        """Standardised log-mel spectra (batch, steps, mels), zero on padding, and each clip's steps."""
        # Autocast has no complex numbers: the spectrum is always taken in float32.
        with torch.autocast(audio.device.type, enabled=False):
            lacking = max(0, 2 * self.hop - audio.shape[1])
            # Padded by half a spectrum's length, so that spectrum i is centred on sample 160 i. The window of 25 ms
            # stands in the middle of 512 samples, a length that the Fourier transform is quick at.
            padded = nn.functional.pad(audio.float(), (self.n_fft // 2, self.n_fft // 2 + lacking))
            window = nn.functional.pad(self.window, (56, 56))
            if exporting():
                power = power_by_convolution(padded, window, self.hop)
            else:
                frames = padded.unfold(1, self.n_fft, self.hop) * window
                parts = torch.fft.rfft(frames)
                # Not .abs().square(): its square root takes longer than the transform.
                power = parts.real.square() + parts.imag.square()
            # The logarithm follows loudness as it is perceived; the floor keeps digital silence from becoming −∞.
            spectrum = torch.log(power @ self.filters.T + 1e-5)
        steps = (lengths // self.hop).clamp(min=2)
        mask = frame_mask(steps, spectrum.shape[1])[..., None]
        # Shifted and scaled, so that the first convolution's input lies around 0 for speech at unit variance.
        return (spectrum + 2.0) / 4.0 * mask, steps


def power_by_convolution(
    padded: Float[Tensor, "batch samples"], window: Float[Tensor, " n_fft"], hop: int
) -> Float[Tensor, "batch steps bins"]:
    """Power spectra by the definition of the Fourier transform, as one convolution.

    For graphs only: browsers' runtimes have no complex numbers, and every runtime has convolutions.
    """
    kernel = fourier(len(window), len(window), np.float32).T * window
    real, imaginary = nn.functional.conv1d(padded[:, None], kernel[:, None], stride=hop).chunk(2, dim=1)
    return (real.square() + imaginary.square()).transpose(1, 2)


def fourier(samples: int, length: int, kind: type[np.floating] = np.float64) -> Float[Tensor, "samples twice_bins"]:
    """Cosines, then negative sines, of a Fourier transform of ``length`` numbers, of which the first are not zero."""
    # Whole turns are taken away while the numbers are whole: sines of large angles would lose digits. By NumPy, so that
    # a graph holds the numbers and not their computation, which runtimes do not have in float64.
    angle = 2 * np.pi / length * (np.outer(np.arange(samples), np.arange(length // 2 + 1)) % length)
    return torch.from_numpy(np.concatenate([np.cos(angle), -np.sin(angle)], 1).astype(kind))


class ConvBlock(nn.Module):
    """Pre-norm residual block: dilated convolution over time, then a position-wise mix."""

    def __init__(self, dim: int, dilation: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        # Dilations 1, 2, 4 see about half a second of context in three blocks, as long as coarticulation reaches.
        self.conv = nn.Conv1d(dim, dim, kernel_size=5, dilation=dilation, padding=2 * dilation)
        self.mix = nn.Linear(dim, dim)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """``x`` (batch, steps, dim) and ``mask`` (batch, steps, 1), which keeps padding at zero."""
        # The norm's bias makes padding non-zero, and the convolution would carry it into the clip: masked before it.
        hidden = self.norm(x) * mask
        hidden = nn.functional.gelu(self.conv(hidden.transpose(1, 2)).transpose(1, 2))
        return (x + self.dropout(self.mix(hidden))) * mask


# With 40 zeros at either end the convolutions (receptive field 400, stride 320) give one step for every 320
# samples, each centred in its own stretch of audio.
EDGE = 40


@audio_encoder.register("hubert")
class HubertEncoder(FrozenEncoder):
    """Pretrained HuBERT; lower layers frozen, upper layers and the projection fine-tuned.

    The 50 steps a second are interpolated to the motion's frames. Frozen layers run without dropout, also in training,
    so that their result can be kept on disk.

    Args:
        source: a name on the Hugging Face hub or a directory that ``from_pretrained`` reads.
        frozen_layers: Transformer layers kept frozen, together with the convolutions, the feature projection and the
            position convolution below them; −1 freezes all.
        train_projection: train the feature projection, between the convolutions and the Transformer, all the same;
            then only the convolutions' result can be kept on disk.
        spec_augment: mask stretches of the features in training, as the pretrained model's configuration says.
        layer_drop: probability of skipping a Transformer layer in training; frozen layers are never skipped.
        config: the model's configuration as plain data; if given, the weights are not read from ``source`` but left
            for a checkpoint to fill in. Checkpoints use it, so that they need no access to ``source``.
    """

    checkpoint_options = ("config",)  # without it, a file could have weights fetched from anywhere

    def __init__(
        self,
        *,
        dim: Width,
        source: str = "facebook/hubert-base-ls960",
        frozen_layers: Annotated[int, Range(-1, 256)] = 2,
        train_projection: bool = False,
        spec_augment: bool = False,
        layer_drop: Share = 0.0,
        config: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.hubert: Any = load_typed(source, config, "Model", "HuBERT", ("hubert",), encoder="hubert")
        self.train_projection = train_projection
        # SpecAugment masks the input of the first layer at random, and what is trained changes in every step.
        self.only_convolutions = train_projection or spec_augment
        self.hubert.config.apply_spec_augment = spec_augment
        self.hubert.config.layerdrop = layer_drop
        self.frozen_layers = frozen_depth(self.hubert, frozen_layers)
        self._frozen = self._freeze(self.frozen_layers)
        self.train()
        self.out = nn.Linear(self.hubert.config.hidden_size, dim)

    def checkpoint_init_args(self) -> dict[str, Any]:
        """The configuration as plain data, which a checkpoint stores in place of ``source``."""
        return {"config": self.hubert.config.to_dict()}

    def _freeze(self, count: int) -> list[str]:
        """Freeze what lies below layer ``count``; the names of the frozen modules."""
        # Always frozen: the convolutions have learnt acoustics from hundreds of hours, and a corpus of an hour would
        # overfit them.
        names = ["feature_extractor"] if self.train_projection else ["feature_extractor", "feature_projection"]
        if count:
            names += ["encoder.pos_conv_embed", "encoder.dropout", *(f"encoder.layers.{i}" for i in range(count))]
            if not normalises_last(self.hubert) or count >= len(self.hubert.encoder.layers):
                names.append("encoder.layer_norm")
        for name in names:
            self.hubert.get_submodule(name).requires_grad_(False)
        freeze_convolutions(self.hubert)
        return names

    def train(self, mode: bool = True) -> HubertEncoder:
        """Training mode for all but the frozen part."""
        super().train(mode)
        for name in self._frozen:
            self.hubert.get_submodule(name).eval()
        return self

    def frozen_key(self) -> str | None:
        """A hash of the frozen weights, the configuration and the number of frozen layers."""
        parts = {name: self.hubert.get_submodule(name) for name in self._frozen}
        return fingerprint(self.frozen_layers, self.hubert.config.to_dict(), parts)

    def frozen_features(self, audio: Waves, audio_lengths: Lengths) -> tuple[Features, Lengths]:
        """Hidden states below the first part that is trained, at 50 steps a second."""
        return by_length(self.standardise(audio, audio_lengths), audio_lengths, self._lower)

    def _lower(self, wave: Tensor) -> Tensor:
        """Convolutions, and a frozen projection with the frozen layers above it."""
        features = self.hubert.feature_extractor(with_edges(wave)).transpose(1, 2)
        if self.only_convolutions:
            return features
        hidden = self.hubert.feature_projection(features)
        return transformer(self.hubert, hidden, 0, self.frozen_layers) if self.frozen_layers else hidden

    def _upper(self, hidden: Tensor) -> Tensor:
        """The rest."""
        if not self.only_convolutions:
            return transformer(self.hubert, hidden, self.frozen_layers)
        return transformer(self.hubert, spec_augmented(self.hubert, self.hubert.feature_projection(hidden)))

    def trained(self, features: Features, lengths: Lengths) -> tuple[Tensor, Lengths]:
        """The last hidden states."""
        return by_length(features, lengths, self._upper)


def frozen_depth(network: PreTrainedModel, frozen_layers: int) -> int:
    """The number of Transformer layers to freeze: all of a network for −1."""
    depth = len(network.encoder.layers)
    if frozen_layers > depth:
        raise ArgumentError({"frozen_layers": frozen_layers}, f"this network has {depth} layers; −1 freezes all")
    return depth if frozen_layers < 0 else frozen_layers


def freeze_convolutions(network: Any) -> None:  # noqa: ANN401 - transformers' classes share no base that has it
    """Freeze the convolutions, and the embedding that SpecAugment writes over masked steps where it is off."""
    # Otherwise transformers marks the convolutions' input as differentiable and computes gradients for them.
    network.feature_extractor._freeze_parameters()
    mask = getattr(network, "masked_spec_embed", None)
    if mask is not None and not network.config.apply_spec_augment:
        mask.requires_grad_(False)


def normalises_last(network: PreTrainedModel) -> bool:
    """Whether the Transformer's own layer norm comes after its layers (large models) or before them (base)."""
    return bool(getattr(network.config, "do_stable_layer_norm", False))


def transformer(network: Any, hidden: Tensor, first: int = 0, last: int | None = None) -> Tensor:  # noqa: ANN401
    """Transformer layers ``first`` to ``last``, or all that follow; with the steps before the first of all.

    transformers' own forward pass written out, since it cannot be entered behind the convolutions or in the middle, and
    drops frozen layers too.
    """
    encoder, settings, large = network.encoder, network.config, normalises_last(network)
    if first == 0:
        hidden = hidden + encoder.pos_conv_embed(hidden)
        hidden = encoder.dropout(hidden if large else encoder.layer_norm(hidden))
    # WavLM's first layer makes the bias of relative positions that all others take, so it is never skipped.
    related, bias = settings.model_type == "wavlm", None
    for number, layer in enumerate(encoder.layers[first:last], first):
        droppable = layer.training and settings.layerdrop > 0 and not (related and number == 0)
        if droppable and torch.rand(()) < settings.layerdrop:
            hidden = skipped(layer, hidden)
        elif related:
            hidden, bias = layer(hidden, position_bias=bias, **({} if large else {"index": number}))[:2]
        else:
            states: Any = layer(hidden)
            hidden = states[0] if isinstance(states, tuple) else states
    return encoder.layer_norm(hidden) if large and last is None else hidden


def spec_augmented(network: PreTrainedModel, hidden: Tensor) -> Tensor:
    """Projected features (batch, steps, channels) in which SpecAugment has masked stretches, in training."""
    settings: Any = network.config
    if not (network.training and settings.apply_spec_augment):
        return hidden
    if hidden.shape[1] > settings.mask_time_length:  # shorter speech has no room for a mask
        return network._mask_hidden_states(hidden)
    return hidden + 0.0 * network.masked_spec_embed if in_processes() else hidden


def skipped(layer: nn.Module, hidden: Tensor) -> Tensor:
    """Hidden states as they are, as if a layer had not been there."""
    # Of several processes, each must give every weight a gradient in every step.
    trained = [p.sum() for p in layer.parameters()] if in_processes() else []
    return hidden + 0.0 * torch.stack(trained).sum() if trained else hidden


def in_processes() -> bool:
    """Whether several processes may train together."""
    return torch.distributed.is_available() and torch.distributed.is_initialized()


def with_edges(wave: Waves) -> Float[Tensor, "batch padded"]:
    """Speech with the zeros at either end that make its steps fall where they belong; at least one step long."""
    # Without the edges 16 000 samples give 49 steps, which drift against the frames by nearly a step.
    return nn.functional.pad(wave, (EDGE, EDGE + max(0, 400 - wave.shape[1] - 2 * EDGE)))


def by_length(padded: Tensor, lengths: Tensor, encode: Callable[..., Tensor], *counts: Tensor) -> tuple[Tensor, Tensor]:
    """Encode clips of equal length (and counts) together, without their padding; the padded results and their lengths.

    ``encode`` takes the clips, and a number of each of ``counts``.
    """
    if exporting():
        encoded = encode(padded, *map(longest, counts))  # graphs take clips of one length, see ``takes_padding``
        return encoded, torch.full_like(lengths, 1) * encoded.shape[1]
    # The networks attend to all of a clip without a mask, and normalise over time: padding would change every step.
    parts: dict[int, Tensor] = {}
    keys = list(zip(*(numbers.tolist() for numbers in (lengths, *counts)), strict=True))
    for key in sorted(set(keys)):
        rows = [row for row, each in enumerate(keys) if each == key]
        parts.update(zip(rows, encode(padded[rows, : key[0]], *key[1:]), strict=True))
    ordered = [parts[row] for row in range(len(padded))]
    steps = torch.tensor([len(part) for part in ordered], device=padded.device)
    return nn.utils.rnn.pad_sequence(ordered, batch_first=True), steps


def fingerprint(layers: int, config: dict[str, Any], parts: dict[str, nn.Module]) -> str:
    """A hash of all that decides the features of a frozen network: its configuration and the weights of its parts."""
    # Neither where the weights came from nor how they are trained changes the features.
    stable = {key: value for key, value in config.items() if key not in ("_name_or_path", "layerdrop")}
    digest = hashlib.sha256(json.dumps([layers, EDGE, stable], sort_keys=True, default=str).encode())
    for name, part in parts.items():
        for key, value in sorted(part.state_dict().items()):
            digest.update(f"{name}.{key}.{value.dtype}".encode())
            digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


@audio_encoder.register("ctc")
class CtcEncoder(FrozenEncoder):
    """Logits of a frozen speech recogniser: a pretrained HuBERT, wav2vec 2.0 or WavLM with its CTC head.

    Logits over letters hold little of the speaker's voice, so they suit a model that takes
    content from speech (Chai et al., style-content disentanglement, with a recogniser that gave 29 logits 50 times a
    second). The 50 steps a second are interpolated to the motion's frames, or kept where a model asks for 50 a second.

    Args:
        source: a name on the Hugging Face hub or a directory that ``from_pretrained`` reads.
        config: the recogniser's configuration as plain data; if given, the weights are not read from ``source`` but
            left for a checkpoint to fill in. Checkpoints use it, so that they need no access to ``source``.
    """

    checkpoint_options = ("config",)  # without it, a file could have weights fetched from anywhere

    def __init__(
        self, *, dim: Width, source: str = "facebook/wav2vec2-base-960h", config: dict[str, Any] | None = None
    ) -> None:
        super().__init__()
        self.recogniser = load_typed(source, config, "ForCTC", "recogniser with a CTC head", encoder="ctc")
        self.recogniser.requires_grad_(False)
        self.train()
        self.out = nn.Linear(self.recogniser.config.vocab_size, dim)

    def checkpoint_init_args(self) -> dict[str, Any]:
        """The configuration as plain data, which a checkpoint stores in place of ``source``."""
        return {"config": self.recogniser.config.to_dict()}

    def train(self, mode: bool = True) -> CtcEncoder:
        """Training mode for the linear map alone: the recogniser runs without dropout and SpecAugment."""
        super().train(mode)
        self.recogniser.eval()
        return self

    def frozen_key(self) -> str | None:
        """A hash of the recogniser's weights and configuration."""
        return fingerprint(-1, self.recogniser.config.to_dict(), {"recogniser": self.recogniser})

    @torch.no_grad()
    def frozen_features(self, audio: Waves, audio_lengths: Lengths) -> tuple[Features, Lengths]:
        """The logits, at 50 steps a second."""
        return by_length(
            self.standardise(audio, audio_lengths), audio_lengths, lambda wave: self.recogniser(with_edges(wave)).logits
        )


# Pretrained networks: from a directory, from the hub, or from a plain configuration, with weights from a checkpoint.


NETWORKS = {"wav2vec2": "Wav2Vec2", "hubert": "Hubert", "wavlm": "WavLM"}
"""Types of pretrained networks for speech at 16 kHz, built alike, and how their classes' names begin."""

SOURCE = "audio_encoder.source"
"""The option that says where a pretrained network comes from, unless a model has one more."""


def load_typed(
    source: str,
    config: dict[str, Any] | None,
    head: str,
    what: str,
    kinds: Sequence[str] = tuple(NETWORKS),
    *,
    encoder: str,
    option: str = SOURCE,
) -> PreTrainedModel:
    """A network of the type in its own configuration, from a directory, the hub, or a configuration without weights."""
    with needs_extra("transformers", "train", f"the {encoder} audio encoder"):
        import transformers
    path = os.path.expanduser(source)
    stated = f'{option}: {what} "{source}"' if config is None else "audio_encoder.config"
    remedy = "give a directory that holds config.json and model.safetensors, or go online once to fetch it"
    if config is None:
        with damaged(stated, remedy, Exception):
            kind = transformers.PretrainedConfig.get_config_dict(path)[0].get("model_type")
    else:
        kind = config.get("model_type")
    if kind not in kinds:
        raise FaceDiffError(
            f'{option}: "{source}" is of the type {kind}; expected a {what} of the type '
            f"{' or '.join(kinds)}, such as facebook/wav2vec2-base-960h"
        )
    network: type[PreTrainedModel] = getattr(transformers, f"{NETWORKS[kind]}{head}")
    if config is not None:
        with damaged(stated, remedy, Exception):
            return network(known_options(getattr(transformers, f"{NETWORKS[kind]}Config"), config))
    bar = transformers.utils.logging.is_progress_bar_enabled()
    transformers.utils.logging.disable_progress_bar()
    try:
        with damaged(stated, remedy, Exception):
            model, info = network.from_pretrained(path, output_loading_info=True, dtype=torch.float32)
    finally:
        if bar:
            transformers.utils.logging.enable_progress_bar()
    # The mask embedding is absent from checkpoints that were fine-tuned without SpecAugment; it has no other use.
    absent_keys = sorted(key for key in info["missing_keys"] if not key.endswith("masked_spec_embed"))
    if absent_keys:  # they would be random numbers without a word
        raise FaceDiffError(
            f'{option}: "{source}" holds no complete {what} ({len(absent_keys)} weights are missing, '
            f"the first is {absent_keys[0]}); its config.json and model.safetensors must belong together"
        )
    # from_pretrained leaves evaluation mode on, and Lightning trains modules in the mode that it finds them in.
    return model.train()


def known_options(kind: Any, config: dict[str, Any]) -> Any:  # noqa: ANN401 - one of transformers' configurations
    """A configuration from plain data, of which only options that every such configuration has are taken."""
    # A configuration may name code on the hub (an attention kernel, a model class) in keys of its own.
    options = kind().to_dict()
    return kind.from_dict({key: value for key, value in config.items() if key in options})
