"""Pretrained wav2vec 2.0, HuBERT and WavLM, base and large, as the published methods of the field use them.

The methods differ in where they leave the network's 50 steps a second for the motion's frames
(:data:`~facediff.models.audio_encoders.StepRule`), in the constant by which speech is standardised, and in the frozen
part; the network is the same. Its convolutions are frozen in all of them.
"""

from __future__ import annotations

from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from facediff.models.audio_encoders import (
    Features,
    FrozenEncoder,
    Lengths,
    StepRule,
    Waves,
    by_length,
    fingerprint,
    freeze_convolutions,
    frozen_depth,
    load_typed,
    spec_augmented,
    transformer,
    with_edges,
)
from facediff.models.layers import Share, Width, exporting, interpolate_ends
from facediff.registry import audio_encoder
from facediff.utils.ranges import Range


@audio_encoder.register("wav2vec2")
class Wav2Vec2Encoder(FrozenEncoder):
    """Pretrained wav2vec 2.0, HuBERT or WavLM, base or large; all but its convolutions are fine-tuned.

    The published methods that facediff has (FaceFormer and others) encode speech by it; a model of facediff's own
    may as well. ``hubert`` is the encoder that keeps more of the network frozen; frozen layers run once a clip.

    Args:
        dim: channels of the result, by a linear map of the hidden states; the hidden states as they are if None. Given
            by the model.
        source: a name on the Hugging Face hub or a directory that ``from_pretrained`` reads.
        frozen_layers: Transformer layers kept frozen, together with the feature projection; 0 freezes the convolutions
            alone, −1 the whole network.
        spec_augment: mask stretches of the features in training, as the pretrained model's configuration says.
        layer_drop: probability of skipping a Transformer layer in training.
        epsilon: added to the variance by which speech is standardised: 1e-7 as transformers has it today, 1e-5 as it
            had in 2021.
        edges: add 40 zeros at either end of speech, so that every step is centred in its own stretch of it; the
            published methods do not.
        do_normalize: standardise speech first; without it, the network takes the waveform as it is.
        config: the network's configuration as plain data; if given, the weights are not read from ``source`` but left
            for a checkpoint to fill in. Checkpoints use it, so that they need no access to ``source``.
    """

    checkpoint_options = ("config",)  # without it, a file could have weights fetched from anywhere

    def __init__(
        self,
        *,
        dim: Width | None,
        source: str = "facebook/wav2vec2-base-960h",
        frozen_layers: Annotated[int, Range(-1, 256)] = 0,
        spec_augment: bool = False,
        layer_drop: Share = 0.0,
        epsilon: Annotated[float, Range(0, 1, above=True)] = 1e-7,
        edges: bool = True,
        do_normalize: bool = True,
        config: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.network: Any = load_typed(source, config, "Model", "network", encoder="wav2vec2")
        settings = self.network.config
        settings.apply_spec_augment, settings.layerdrop = spec_augment, layer_drop
        self.epsilon, self.edges, self.do_normalize = epsilon, edges, do_normalize
        self._freeze(frozen_depth(self.network, frozen_layers), everything=frozen_layers < 0)
        self.out = None if dim is None else nn.Linear(settings.hidden_size, dim)
        self.width: int = settings.hidden_size if dim is None else dim

    def checkpoint_init_args(self) -> dict[str, Any]:
        """The configuration as plain data, which a checkpoint stores in place of ``source``."""
        return {"config": self.network.config.to_dict()}

    def _freeze(self, layers: int, *, everything: bool) -> None:
        """Freeze the convolutions, so many layers with the feature projection, or everything."""
        network = self.network
        freeze_convolutions(network)
        if layers:
            network.feature_projection.requires_grad_(False)
        network.encoder.layers[:layers].requires_grad_(False)
        if everything:
            network.requires_grad_(False)

    def convolutions(self) -> tuple[tuple[int, int], ...]:
        """Kernels and strides in the network's configuration."""
        settings = self.network.config
        return tuple(zip(settings.conv_kernel, settings.conv_stride, strict=True))

    def frozen_key(self) -> str | None:
        """A hash of the convolutions' weights, the configuration, and how speech is standardised."""
        parts = {"feature_extractor": self.network.feature_extractor}
        facts = {**self.network.config.to_dict(), "epsilon": self.epsilon, "edges": self.edges}
        if not self.do_normalize:
            facts["do_normalize"] = False
        return fingerprint(0, facts, parts)

    @torch.no_grad()
    def frozen_features(self, audio: Waves, audio_lengths: Lengths) -> tuple[Features, Lengths]:
        """Output of the convolutions, at 50 steps a second."""
        wave = self.standardise(audio, audio_lengths, self.epsilon) if self.do_normalize else audio
        return by_length(wave, audio_lengths, self._convolve)

    def _convolve(self, wave: Tensor) -> Tensor:
        # At least one step, however short the speech is.
        padded = with_edges(wave) if self.edges else nn.functional.pad(wave, (0, max(0, 400 - wave.shape[1])))
        features: Tensor = self.network.feature_extractor(padded).transpose(1, 2)
        return features

    def trained(self, features: Features, lengths: Lengths) -> tuple[Tensor, Lengths]:
        """The hidden states."""
        return by_length(features, lengths, self.hidden_states)

    def at_steps(
        self, audio: Waves, audio_lengths: Lengths, steps: Lengths, rule: StepRule, *cached: Tensor
    ) -> Float[Tensor, "batch most_steps width"]:
        """Encode as the published methods do; see :meth:`AudioEncoder.at_steps`."""
        features, lengths = cached or self.frozen_features(audio, audio_lengths)
        # FaceFormer, CodeTalker and TalkingStyle resample between the convolutions and the Transformer, which then runs
        # at the motion's rate; FaceDiffuser and DiffSpeaker resample its result. The weights fit one order only.
        early = rule.startswith("features")

        def resampled(x: Tensor, count: int) -> Tensor:
            # The speech of one frame may have a single step in place of a pair.
            cut = rule.endswith("cut") and (exporting() or x.shape[1] >= count)
            return x[:, :count] if cut else interpolate_ends(x, count)

        def encode(x: Tensor, count: int) -> Tensor:
            return self.hidden_states(resampled(x, count)) if early else resampled(self.hidden_states(x), count)

        hidden, _ = by_length(features, lengths, encode, steps)
        return hidden if self.out is None else self.out(hidden)

    def hidden_of(
        self, wave: Waves, steps: int | None = None, *, max_steps: int | None = None
    ) -> Float[Tensor, "batch steps width"]:
        """Hidden states of waves that the caller has standardised and filled up, all of one length.

        Args:
            wave: speech at 16 kHz.
            steps: the convolutions' output is interpolated to so many steps before the Transformer runs, each in its
                own stretch of time; as many as they give if None.
            max_steps: steps of theirs that are used before that; all if None.
        """
        features = self.network.feature_extractor(wave).transpose(1, 2)[:, :max_steps]
        if steps is not None and features.shape[1] != steps:
            features = nn.functional.interpolate(features.transpose(1, 2), size=steps, mode="linear").transpose(1, 2)
        hidden = self.hidden_states(features)
        return hidden if self.out is None else self.out(hidden)

    def hidden_states(self, features: Tensor) -> Tensor:
        """Hidden states of the last layer, of clips of one length."""
        hidden = self.network.feature_projection(features)
        hidden = hidden[0] if isinstance(hidden, tuple) else hidden  # wav2vec 2.0 gives its normalised input as well
        return transformer(self.network, spec_augmented(self.network, hidden))
