"""Pretrained HuBERT as audio encoder (dual-path style diffusion paper, section 1.2)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.components.audio_encoder.base import AudioEncoder, standardise
from facediff.components.layers import interpolate_frames
from facediff.errors import FaceDiffError, MissingExtraError
from facediff.registry import audio_encoder

if TYPE_CHECKING:
    from transformers import HubertModel

# With 40 zeros at either end the convolutions (receptive field 400, stride 320) give one step for every 320
# samples, each centred in its own stretch of audio.
EDGE = 40


@audio_encoder.register("hubert")
class HubertEncoder(AudioEncoder):
    """Pretrained HuBERT; lower layers frozen, upper layers and the projection fine-tuned.

    Clips are encoded one by one, or together where their lengths are equal: HuBERT normalises over time, so padding
    would change its features. The 50 steps a second are interpolated to the motion's frames.

    Args:
        dim: channels of the result; given by the system.
        source: a name on the Hugging Face hub or a directory that ``from_pretrained`` reads.
        frozen_layers: Transformer layers kept frozen, together with the convolutions, the feature projection and the
            position convolution below them; −1 freezes all.
        spec_augment: mask stretches of the features in training, as the pretrained model's configuration says.
        layer_drop: probability of skipping a Transformer layer in training.
        config: the model's configuration as plain data; if given, the weights are not read from ``source`` but left
            for a checkpoint to fill in. Checkpoints use it, so that they need no access to ``source``.

    Raises:
        FaceDiffError: if ``source`` cannot be read.
        MissingExtraError: if transformers is not installed.
    """

    def __init__(
        self,
        *,
        dim: int,
        source: str = "facebook/hubert-base-ls960",
        frozen_layers: int = 2,
        spec_augment: bool = False,
        layer_drop: float = 0.0,
        config: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.hubert = load_hubert(source, config)
        self.hubert.config.apply_spec_augment = spec_augment
        self.hubert.config.layerdrop = layer_drop
        self._freeze(frozen_layers)
        self.out = nn.Linear(self.hubert.config.hidden_size, dim)

    def checkpoint_init_args(self) -> dict[str, Any]:
        """What a checkpoint stores in place of a look at ``source``: the configuration as plain data."""
        return {"config": self.hubert.config.to_dict()}

    def _freeze(self, frozen_layers: int) -> None:
        encoder = self.hubert.encoder
        count = len(encoder.layers) if frozen_layers < 0 else frozen_layers
        frozen: list[nn.Module] = [self.hubert.feature_extractor, self.hubert.feature_projection]
        if count:
            frozen += [encoder.pos_conv_embed, *encoder.layers[:count]]
            if not getattr(self.hubert.config, "do_stable_layer_norm", False) or count >= len(encoder.layers):
                frozen.append(encoder.layer_norm)
        for module in frozen:
            module.requires_grad_(False)
        # Else transformers marks what enters the convolutions as differentiable and training goes back through them.
        self.hubert.feature_extractor._freeze_parameters()
        # The embedding that SpecAugment writes over masked steps is of no use without SpecAugment.
        mask = getattr(self.hubert, "masked_spec_embed", None)
        if mask is not None and not self.hubert.config.apply_spec_augment:
            mask.requires_grad_(False)

    def forward(
        self,
        audio: Float[Tensor, "batch samples"],
        audio_lengths: Int[Tensor, " batch"],
        frame_lengths: Int[Tensor, " batch"],
    ) -> Float[Tensor, "batch frames dim"]:
        """Encode; see :class:`AudioEncoder`."""
        audio = standardise(audio, audio_lengths)
        parts: dict[int, Tensor] = {}
        for length in sorted(set(audio_lengths.tolist())):
            rows = (audio_lengths == length).nonzero().flatten()
            shortage = max(0, 400 - length - 2 * EDGE)
            wave = nn.functional.pad(audio[rows, :length], (EDGE, EDGE + shortage))
            hidden = self.hubert(wave).last_hidden_state
            parts.update(zip(rows.tolist(), hidden, strict=True))
        steps = torch.tensor([parts[i].shape[0] for i in range(len(audio))], device=audio.device)
        features = nn.utils.rnn.pad_sequence([parts[i] for i in range(len(audio))], batch_first=True)
        return interpolate_frames(self.out(features), steps, frame_lengths)


def load_hubert(source: str, config: dict[str, Any] | None) -> HubertModel:
    """A HuBERT from a directory, from the hub, or from a plain configuration without weights."""
    try:
        from transformers import HubertConfig, HubertModel
        from transformers.utils import logging
    except ImportError as error:
        raise MissingExtraError("transformers", "train", "the hubert audio encoder") from error
    if config is not None:
        return HubertModel(HubertConfig.from_dict(config))
    # A path that does not exist would be taken for a name on the hub and fail with a puzzling message.
    if (source.startswith((".", "/", "~")) or source.count("/") > 1) and not Path(source).expanduser().is_dir():
        raise FaceDiffError(
            f"audio_encoder.source: no directory {source}; expected one with config.json and model.safetensors, "
            f"or a name on the Hugging Face hub such as facebook/hubert-base-ls960"
        )
    bar = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        model, info = HubertModel.from_pretrained(
            os.path.expanduser(source), use_safetensors=None, output_loading_info=True, dtype=torch.float32
        )
    except Exception as error:  # a broken file makes safetensors, pickle and transformers raise anything
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FaceDiffError(
            f'audio_encoder.source: cannot load HuBERT from "{source}" ({reason}); give a directory '
            f"that holds config.json and model.safetensors, or go online once to fetch it"
        ) from error
    finally:
        if bar:
            logging.enable_progress_bar()
    # The mask embedding is absent from checkpoints that were fine-tuned without SpecAugment; it has no other use.
    missing = sorted(set(info["missing_keys"]) - {"masked_spec_embed"})
    if missing:
        raise FaceDiffError(
            f'audio_encoder.source: "{source}" holds no complete HuBERT ({len(missing)} weights are missing, '
            f"the first is {missing[0]}); its config.json and model.safetensors must belong together"
        )
    # from_pretrained leaves evaluation mode on, and Lightning trains modules in the mode that it finds them in.
    return model.train()
